"""RADIO_RANGING as JSON, one object a line, for any radio with a program to print it.

Names and units are those of the message (docs/wire.md): metres, radians, microseconds; received
power is `power_dbm`. Absent or null values were not measured. Unknown keys are ignored, so a line
may carry more for its log.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

import msgspec

from companion.domain import NonNegative, Params
from companion.radios.decoder import (
    AngleFrame,
    LineDecoder,
    RadioKind,
    RadioReading,
    is_power_only,
)
from companion.radios.fields import NOT_VALID, says_invalid

MOST_BEARING_RAD = 2.0 * math.pi + 1e-6
MOST_ELEVATION_RAD = 0.5 * math.pi + 1e-6
MOST_SIGMA_RAD = math.pi / math.sqrt(3.0) + 1e-6
"""Standard deviation of an angle that may be anywhere on the circle."""
UNITS = re.compile(
    r'"(?:\w{0,20}units?|units?_\w{0,20}|uom)"\s*:\s*(?:"(?!(?:m|rad|us|dBm)?")|\{)', re.IGNORECASE
)
"""Key that names a unit which is none of RADIO_RANGING's."""
IDENTITY = re.compile(
    r'"((?:anchor|tag|beacon|node|device|emitter|peer|responder)(?:_?(?:id|name))?|id|uid|bssid'
    r'|mac(?:_?addr(?:ess)?)?|addr(?:ess)?|dev_?(?:eui|addr))"\s*:',
    re.IGNORECASE,
)
"""Key by which other programs name an emitter: without `emitter_id` all would be one."""
RECORD_SEPARATOR = "\x1e"
"""Before each text of a JSON sequence (RFC 8142)."""

EmitterId = Annotated[int, msgspec.Meta(ge=0, le=65_535)]
EmitterName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class Line(msgspec.Struct, frozen=True):
    """Keys of a line that are used."""

    emitter_id: EmitterId | EmitterName | None = None
    time_usec: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] | None = None
    range: float | None = None
    range_std: NonNegative | None = None
    bearing: float | None = None
    bearing_std: NonNegative | None = None
    elevation: float | None = None
    elevation_std: NonNegative | None = None
    power_dbm: float | None = None
    quality: Annotated[int, msgspec.Meta(ge=0, le=100)] | None = None
    body_frame: bool | None = None
    array_angle: bool | None = None
    line_of_sight: bool | None = None

    azimuth: Any = msgspec.UNSET
    distance: Any = msgspec.UNSET
    range_m: Any = msgspec.UNSET
    range_mm: Any = msgspec.UNSET
    bearing_deg: Any = msgspec.UNSET
    elevation_deg: Any = msgspec.UNSET


FOREIGN = {
    "azimuth": "bearing",
    "bearing_deg": "bearing",
    "distance": "range",
    "range_m": "range",
    "range_mm": "range",
    "elevation_deg": "elevation",
}
"""Keys of other formats by what they stand for here; the line's other keys are in other units."""
STRANGE_SHARE = 20
"""Angles are refused until so many good lines came for each angle beyond a turn: one torn digit
does not end a stream, degrees do."""
RULES = {
    "emitter_id": "emitter_id must be 0 to 65535, or a name in quotes",
    "time_usec": "time_usec must be whole microseconds, not negative",
    "range": "range must be a number of metres",
    "range_std": "range_std must be a number of metres, not negative",
    "bearing": "bearing must be a number of radians",
    "bearing_std": "bearing_std must be a number of radians, not negative",
    "elevation": "elevation must be a number of radians",
    "elevation_std": "elevation_std must be a number of radians, not negative",
    "power_dbm": "power_dbm must be a number of dBm",
    "quality": "quality must be a whole number from 0 to 100",
    "body_frame": "body_frame must be true or false",
    "array_angle": "array_angle must be true or false",
    "line_of_sight": "line_of_sight must be true, false or null",
}
FIELD = re.compile(r"\$\.(\w+)")
"""Path of a faulty value in msgspec's error: made of our own names, never of the line's."""

DECODER = msgspec.json.Decoder(Line)


class NdjsonDecoder(LineDecoder):
    """Decoder of one measurement a line, of any emitter."""

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._beyond_turn = 0

    def reset(self) -> None:
        """Forget the stream's unit of angles: another program may send next."""
        super().reset()
        self._beyond_turn = 0

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of a line; blank ones and comments have none."""
        text = line.strip(f"{RECORD_SEPARATOR} \t\r")
        if not text or text.startswith("#"):
            return []
        parsed = self._parsed(text)
        reason = parsed if isinstance(parsed, str) else self._wrong_with(parsed, text)
        if reason is not None:
            self.counts.refuse(reason)
            return []
        assert isinstance(parsed, Line)
        self.counts.frames += 1
        return [_reading_of(parsed)]

    def _wrong_with(self, line: Line, text: str) -> str | None:
        """Return the reason why a line cannot be used, or None.

        The unit of angles is the stream's: if any exceeds a turn, all are in degrees.
        """
        foreign = _foreign_key(line)
        if foreign is not None:
            return f"key `{foreign}` is of another format: companion radio list"
        if says_invalid(text):
            return NOT_VALID
        identity = None if '"emitter_id"' in text else IDENTITY.search(text)
        if identity is not None:
            return f"key `{identity[1].lower()}` may name the emitter: emitter_id does"
        if UNITS.search(text):
            return "key `unit` is none of m, rad, us, dBm: range is in metres"
        if (line.range, line.bearing, line.elevation, line.power_dbm) == (None,) * 4:
            what = "no range, bearing, elevation or power"
            return f"{what}: a power is power_dbm" if is_power_only(text) else what
        names = ("bearing", "elevation", "bearing_std", "elevation_std")
        bounds = (MOST_BEARING_RAD, MOST_ELEVATION_RAD, MOST_SIGMA_RAD, MOST_SIGMA_RAD)
        for name, most_rad in zip(names, bounds, strict=True):
            if abs(getattr(line, name) or 0.0) > most_rad:
                self._beyond_turn += 1
                return f"{name.removesuffix('_std')} is in radians"
        has_angle = line.bearing is not None or line.elevation is not None
        if has_angle and self._beyond_turn * STRANGE_SHARE > self.counts.frames:
            return "angles of this stream are in another unit: radians are needed"
        return None

    def _parsed(self, text: str) -> Line | str:
        """Return the parsed line, or the reason why it is invalid."""
        if "\N{REPLACEMENT CHARACTER}" in text:
            return "not UTF-8"
        try:
            return DECODER.decode(text)
        except msgspec.ValidationError as error:
            field = FIELD.search(str(error))
            return RULES.get(field[1], "not as agreed") if field else "not a JSON object"
        except (msgspec.DecodeError, RecursionError):
            return "not JSON"


def _foreign_key(line: Line) -> str | None:
    """Return the key of another format that stands for a missing quantity."""
    for key, name in FOREIGN.items():
        if getattr(line, key) is not msgspec.UNSET and getattr(line, name) is None:
            return key
    return None


def _reading_of(line: Line) -> RadioReading:
    frame = AngleFrame.NOSE if line.body_frame else AngleFrame.NORTH
    if line.array_angle:  # regardless of `body_frame`, as by the message's flags
        frame = AngleFrame.ARRAY
    return RadioReading(
        emitter=line.emitter_id,
        device_time_s=None if line.time_usec is None else line.time_usec / 1e6,
        range_m=line.range,
        range_sigma_m=line.range_std,
        azimuth_rad=line.bearing,
        azimuth_sigma_rad=line.bearing_std,
        elevation_rad=line.elevation,
        elevation_sigma_rad=line.elevation_std,
        power_dbm=line.power_dbm,
        frame=frame,
        quality=None if line.quality is None else line.quality / 100.0,
        line_of_sight=line.line_of_sight,
    )


NDJSON = RadioKind(
    name="ndjson",
    decoder=NdjsonDecoder,
    title="Any radio, by a program that prints JSON lines",
    gives="range, bearing, elevation, power",
    emitter="whatever that radio looks for",
    transport="udp",
)
