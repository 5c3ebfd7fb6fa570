"""More radios that print: TREK1000 and clones, Bluetooth channel sounding, Silicon Labs' angles.

Sources: Decawave TREK1000 user manual, report of ranges over USB; nrfconnect/sdk-nrf
`samples/bluetooth/channel_sounding`; zephyr, the same; SiliconLabs/gecko_sdk `aoa_util`,
its JSON of an angle.
"""

from __future__ import annotations

import json
import math
import re
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.radios.decoder import RadioKind, RadioReading
from companion.radios.fields import FieldDecoder, number

TREK_SLOTS = 4


class TrekOptions(Params, frozen=True):
    """Which of the two is hidden."""

    hidden: Literal["anchor", "tag"] = "anchor"
    """What the emitter is: the vehicle carries the other one."""
    slot: Annotated[int, msgspec.Meta(ge=0, lt=TREK_SLOTS)] = 0
    """With `hidden: tag`, the number of the anchor on the vehicle."""


class TrekDecoder(FieldDecoder):
    """`mc` reports: four ranges in hexadecimal millimetres, and a mask of those that are valid.

    `mr` reports are the same before a correction, `ma` reports are between anchors.
    """

    Options = TrekOptions
    options: TrekOptions
    _REPORT = re.compile(
        r"mc ([0-9a-f]{2})((?: [0-9a-f]{8}){4})"
        r" [0-9a-f]{4} [0-9a-f]{2} [0-9a-f]{8} [at]([0-9]):[0-9]"
    )
    _OTHERS = re.compile(r"m[ra] [0-9a-f]{2}(?: [0-9a-f]{8}){4} ")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One report."""
        found = self._REPORT.search(line)
        if not found:
            if self._OTHERS.search(line):
                self.counts.frames += 1
                return []
            return self.passed_over(line)
        self.counts.frames += 1
        mask, options = int(found[1], 16), self.options
        readings = []
        for slot, text in enumerate(found[2].split()):
            if mask >> slot & 1 and (options.hidden == "anchor" or slot == options.slot):
                emitter = slot if options.hidden == "anchor" else int(found[3])
                readings.append(RadioReading(emitter, range_m=int(text, 16) / 1000.0))
        if not readings:
            self.counts.refuse("no anchor answered")
        return readings


class ChannelSoundingDecoder(FieldDecoder):
    """Distances of Nordic's and Zephyr's samples by phases; by round trips they are metres off."""

    _NORDIC = re.compile(
        r"istance estimates on antenna path ([0-9]): ifft: (-?[0-9.]{1,12}|nan), phase_slope:"
    )
    _ZEPHYR = re.compile(r"Phase-Based Ranging method: (-?[0-9.]{1,12}|nan) meters")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One estimate; further antenna paths measure the same exchange."""
        if found := self._NORDIC.search(line):
            if found[1] != "0":
                self.counts.frames += 1
                return []
            text = found[2]
        elif found := self._ZEPHYR.search(line):
            text = found[1]
        else:
            return self.passed_over(line)
        range_m = number(text)
        if range_m is None:
            return self.refused("no distance by phases")
        return self.understood(RadioReading(range_m=range_m))


class SilabsAoaDecoder(FieldDecoder):
    """Angles as Silicon Labs' locators publish them, in degrees, each JSON object over its lines.

    The tag is named by the topic before the object, as `mosquitto_sub -v` prints it. The distance
    is a guess by power, and is not read.
    """

    _TAG = re.compile(r"/ble-[a-z]{1,4}-([0-9A-Fa-f]{12})")
    longest_object = 2048

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._tag: str | None = None
        self._object = ""

    def reset(self) -> None:
        """Forget the object that was begun as well."""
        super().reset()
        self._tag, self._object = None, ""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """A line that begins, goes on with or ends an object."""
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


TREK1000 = RadioKind(
    name="trek1000",
    decoder=TrekDecoder,
    title="Decawave TREK1000 and clones, mc reports",
    gives="range",
    emitter="a TREK1000 anchor, or a tag with `hidden: tag`",
    transport="serial:115200",
    defaults={"range_sigma_m": 0.3},
)
CHANNEL_SOUNDING = RadioKind(
    name="channel_sounding",
    decoder=ChannelSoundingDecoder,
    title="Bluetooth channel sounding, lines of Nordic's and Zephyr's samples",
    gives="range",
    emitter="a Bluetooth device that reflects channel sounding",
    transport="serial:115200",
    needs_emitter=True,
    defaults={"range_sigma_m": 0.5},
)
SILABS_AOA = RadioKind(
    name="silabs_aoa",
    decoder=SilabsAoaDecoder,
    title="Silicon Labs direction finding, JSON by MQTT",
    gives="azimuth, elevation",
    emitter="a Bluetooth tag that sends direction finding advertisements",
    transport="exec",
    defaults={"bearing_sigma_deg": 5.0, "elevation_sigma_deg": 5.0},
)
