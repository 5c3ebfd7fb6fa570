"""Silicon Labs' direction finding: angles as its locators publish them by MQTT.

Source: SiliconLabs/gecko_sdk `app/bluetooth/common_host/aoa_util`, its JSON of an angle.
"""

from __future__ import annotations

import json
import math
import re

from companion.domain import Params
from companion.radios.decoder import RadioReading
from companion.radios.fields import FieldDecoder, number


class SilabsAoaDecoder(FieldDecoder):
    """Decoder of angles as Silicon Labs' locators publish them: degrees, JSON over several lines.

    The tag is named by the topic before the object, as `mosquitto_sub -v` prints it. The distance
    is an estimate by power, and is not read.
    """

    _TAG = re.compile(r"/ble-[a-z]{1,4}-([0-9A-Fa-f]{12})")
    longest_object = 2048

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._tag: str | None = None
        self._object = ""

    def reset(self) -> None:
        """Forget a partial object as well."""
        super().reset()
        self._tag, self._object = None, ""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading that a line completes; it begins, continues or ends an object."""
        before, brace, rest = line.partition("{")
        if brace:
            named = self._TAG.findall(before)  # the locator, and then the tag
            self._tag, self._object = named[-1].upper() if named else None, "{" + rest
        elif self._object:
            self._object += line
        else:
            return self.passed_over(line)
        text, end, _ = self._object.partition("}")
        if not end:
            if len(self._object) > self.longest_object:
                self._object = ""
                return self.refused("object is too long")
            return []
        self._object = ""
        return self._read(text + end)

    def _read(self, text: str) -> list[RadioReading]:
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            return self.refused("not JSON")
        azimuth, elevation = _degrees(value, "azimuth"), _degrees(value, "elevation")
        if azimuth is None or elevation is None:
            return self.refused("no azimuth and elevation")
        if abs(azimuth) > 180.0 or abs(elevation) > 90.0:
            return self.refused("angle is out of bounds")
        sigmas = [_degrees(value, f"{name}_stdev") for name in ("azimuth", "elevation")]
        known = [math.radians(sigma) if sigma and 0.0 < sigma <= 90.0 else None for sigma in sigmas]
        return self.understood(
            RadioReading(
                emitter=self._tag,
                azimuth_rad=math.radians(azimuth),
                azimuth_sigma_rad=known[0],
                elevation_rad=math.radians(elevation),
                elevation_sigma_rad=known[1],
            )
        )


def _degrees(value: object, key: str) -> float | None:
    found = value.get(key) if isinstance(value, dict) else None
    if isinstance(found, bool) or not isinstance(found, int | float):
        return None
    return number(str(found))
