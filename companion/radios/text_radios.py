r"""Modules that print a line a measurement: Makerfabs UWB, u-blox direction finding, SX1280.

And any other one: `lines` is a regular expression with named groups, called by quantity and unit as
`companion.radios.fields` has them: `(?P<emitter>\w+) at (?P<range_m>[\d.]+)`.

Sources: Makerfabs/MaUWB_DW3000-with-STM32-AT-Command (AT manual 1.0.8); u-blox XPLR-AOA user guide
UBX-21004616; jgromes/RadioLib `SX128x_Ranging`, StuartsProjects/SX12XX-LoRa examples 54.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import AngleFrame, RadioKind, RadioReading
from companion.radios.fields import FieldDecoder, columns, complain_of, number

SLOTS = 8
SLOTS_OF_FIRMWARE = (4, SLOTS)
RAW24 = 2**24
BANDWIDTHS_KHZ = (406.25, 812.5, 1625.0)
SX1280_M_PER_STEP_KHZ = 150.0 / 4.096
"""Metres of one step of the ranging register, times the bandwidth in kHz."""


class MakerfabsOptions(Params, frozen=True):
    """Who of the two is hidden."""

    hidden: Literal["anchor", "tag"] = "anchor"
    """What the emitter is: the vehicle carries the other one."""
    slot: Annotated[int, msgspec.Meta(ge=0, lt=SLOTS)] = 0
    """With `hidden: tag`, the slot of the anchor on the vehicle."""


class MakerfabsAtDecoder(FieldDecoder):
    """`AT+RANGE=` reports of Makerfabs' AT firmware."""

    Options = MakerfabsOptions
    _REPORT = re.compile(
        r"AT\+RANGE=tid:([0-9]{1,5}), *mask:([0-9A-Fa-f]{1,2}), *seq:([0-9]{1,3}), *(.*)"
    )
    _LIST = re.compile(r"(range|rssi|ancid):\(([^()]*)\)")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        assert isinstance(self.options, MakerfabsOptions)
        self._hidden, self._slot = self.options.hidden, self.options.slot

    def hello(self) -> bytes:
        """Reports are off after a reset."""
        return b"AT+SETRPT=1\r\n"

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One report: what each slot that answered says, in centimetres; 0 is no answer."""
        found = self._REPORT.search(line)
        if not found:
            return self.passed_over(line)
        lists = {name: columns(cells) for name, cells in self._LIST.findall(found[4])}
        ranges = [number(cell) for cell in lists.get("range", [])]
        names = [number(cell) for cell in lists.get("ancid", map(str, range(SLOTS)))]
        is_whole = len(ranges) in SLOTS_OF_FIRMWARE and len(names) >= len(ranges)
        if not is_whole or None in ranges or None in names:
            return self.refused("torn report")
        mask = int(found[2], 16)
        self.counts.frames += 1
        readings = []
        for slot, (range_cm, name) in enumerate(zip(ranges, names, strict=False)):
            if not mask >> slot & 1 or not range_cm or name is None or name < 0.0:
                continue
            if self._hidden == "tag" and slot != self._slot:
                continue
            emitter = int(found[1]) if self._hidden == "tag" else int(name)
            readings.append(RadioReading(emitter, range_m=range_cm / 100.0))
        if not readings:
            self.counts.refuse("no slot answered")
        return readings


class UudfOptions(Params, frozen=True):
    """What is told of a direction."""

    as_arcsines: bool = False
    """Both angles as a two-axis array says them, for `antenna.kind: two_axis`: a board that looks
    down, whose azimuth about its own upright alone says little."""


class UudfDecoder(FieldDecoder):
    """`+UUDF` events of u-blox' direction finding: azimuth and elevation about the board."""

    Options = UudfOptions
    options: UudfOptions
    _EVENT = re.compile(r"\+UUDF:(.*)")
    FEWEST_FIELDS, MOST_FIELDS = 9, 10

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """One event; the board's milliseconds start again where it says `+STARTUP`."""
        found = self._EVENT.search(line)
        if not found:
            return self.passed_over(line)
        cells = columns(found[1])
        if not self.FEWEST_FIELDS <= len(cells) <= self.MOST_FIELDS:
            return self.refused("torn event")
        azimuth_deg, elevation_deg, milliseconds = map(number, (cells[2], cells[3], cells[8]))
        is_tag = re.fullmatch(r"[0-9A-Fa-f]{12}", cells[0])
        if not is_tag or azimuth_deg is None or elevation_deg is None or milliseconds is None:
            return self.refused("torn event")
        if abs(azimuth_deg) > 90.0 or abs(elevation_deg) > 90.0:
            return self.refused("angle is out of bounds")
        return self.understood(
            RadioReading(
                emitter=cells[0].upper(),
                device_time_s=milliseconds / 1000.0,
                azimuth_rad=self._across_rad(azimuth_deg, elevation_deg),
                elevation_rad=math.radians(elevation_deg),
                frame=AngleFrame.ARRAY if self.options.as_arcsines else AngleFrame.DEVICE,
            )
        )

    def _across_rad(self, azimuth_deg: float, elevation_deg: float) -> float:
        """The azimuth, or the arcsine of the direction's component to the side."""
        azimuth_rad = math.radians(azimuth_deg)
        if not self.options.as_arcsines:
            return azimuth_rad
        return math.asin(math.sin(azimuth_rad) * math.cos(math.radians(elevation_deg)))


class Sx1280Options(Params, frozen=True):
    """What the range is worked out from."""

    bandwidth_khz: Annotated[float, msgspec.Meta(gt=0.0)] | None = None
    """Of the ranging exchange, 406.25, 812.5 or 1625: then the register is read instead of the
    printed metres, which are rounded, and wrong below zero."""


class Sx1280Decoder(FieldDecoder):
    """Semtech SX1280 ranging as RadioLib's and SX12XX-LoRa's examples print it."""

    Options = Sx1280Options
    _RADIOLIB = re.compile(
        r"\[SX128[0-9]\] Distance:\s*(-?[0-9]{1,9}\.?[0-9]*) meters(?: \(raw\))?$"
    )
    _FAILED = re.compile(r"\[SX128[0-9]\] Ranging \.\.\. (timed out|failed)")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        assert isinstance(self.options, Sx1280Options)
        self._bandwidth_khz = self.options.bandwidth_khz
        if self._bandwidth_khz not in (None, *BANDWIDTHS_KHZ):
            raise ConfigError("sx1280: bandwidth_khz: there are 406.25, 812.5 and 1625")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """A line of either library."""
        if found := self._RADIOLIB.search(line.rstrip()):
            return self.understood(RadioReading(range_m=number(found[1])))
        if found := self._FAILED.search(line):
            return self.refused(found[1])
        cells = columns(line)
        if "NotValid" in cells:
            return self.refused("not valid")
        if "Valid" in cells:
            return self._valid(cells)
        return self.passed_over(line)

    def _valid(self, cells: list[str]) -> list[RadioReading]:
        after = dict(pairwise(cells))
        register = after.get("RAW", after.get("Register", ""))
        printed = number(after.get("Distance", "").removesuffix("m"))
        if not re.fullmatch(r"[0-9A-Fa-f]{1,6}", register) or printed is None:
            return self.refused("torn line")
        raw = int(register, 16)
        if self._bandwidth_khz is not None:
            signed = raw - RAW24 if raw >= RAW24 // 2 else raw
            return self.understood(
                RadioReading(range_m=signed * SX1280_M_PER_STEP_KHZ / self._bandwidth_khz)
            )
        if raw >= RAW24 // 2:
            return self.refused("below zero: set bandwidth_khz")
        return self.understood(RadioReading(range_m=printed))


class LinesOptions(Params, frozen=True):
    """How a line is read."""

    pattern: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    """A regular expression of Python's `re`, searched for in each line."""
    frame: Literal["device", "array", "nose", "north"] = "device"
    """What the zero of the angles is."""
    hello: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """What to send once the line is open; a line end is added."""
    request: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """What to ask every `poll_s`, of a module that only answers; a line end is added."""


class LinesDecoder(FieldDecoder):
    """Lines that an expression of the user's own matches; all others are passed over."""

    Options = LinesOptions
    options: LinesOptions
    longest_line = 1024
    """An expression that goes back and forth takes its time over long ones."""

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        assert isinstance(self.options, LinesOptions)
        self._frame = AngleFrame(self.options.frame)
        self._pattern = _compiled(self.options.pattern)

    def hello(self) -> bytes:
        """As configured."""
        return _ended(self.options.hello)

    def request(self) -> bytes:
        """As configured."""
        return _ended(self.options.request)

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """What the groups of the first match say; a group that took no part is not measured."""
        found = self._pattern.search(line)
        if found is None:
            return self.passed_over(line)
        return self.read_fields(found.groupdict(), self._frame)


def _ended(text: str) -> bytes:
    return text.encode() + b"\r\n" if text else b""


def _compiled(pattern: str) -> re.Pattern[str]:
    if not pattern:
        raise ConfigError(
            r"lines: pattern: an expression, such as `(?P<emitter>\w+) (?P<range_m>[\d.]+)`"
        )
    try:
        compiled = re.compile(pattern)
    except (re.error, RecursionError, OverflowError) as error:
        raise ConfigError(f"lines: pattern: {error}") from None
    problem = complain_of(list(compiled.groupindex))
    if problem is not None:
        raise ConfigError(f"lines: pattern: {problem}")
    return compiled


MAKERFABS_AT = RadioKind(
    name="makerfabs_at",
    decoder=MakerfabsAtDecoder,
    title="Makerfabs MaUWB_DW3000 with AT firmware",
    gives="range",
    emitter="a Makerfabs anchor, or a tag with `hidden: tag`",
    transport="serial:115200",
    defaults={"range_sigma_m": 0.5},
)
UUDF = RadioKind(
    name="uudf",
    decoder=UudfDecoder,
    title="u-blox direction finding, C209 and ANNA-B4 (+UUDF)",
    gives="azimuth, elevation",
    emitter="a Bluetooth tag that sends direction finding advertisements",
    transport="serial:115200",
    clock_wrap_s=2**32 / 1000.0,
    defaults={"bearing_sigma_deg": 5.0, "elevation_sigma_deg": 5.0},
)
SX1280 = RadioKind(
    name="sx1280",
    decoder=Sx1280Decoder,
    title="Semtech SX1280 ranging, lines of RadioLib and SX12XX-LoRa",
    gives="range",
    emitter="an SX1280 in the slave role",
    transport="serial:115200",
    needs_emitter=True,
    defaults={"range_sigma_m": 3.0},
)
LINES = RadioKind(
    name="lines",
    decoder=LinesDecoder,
    title="any text: a regular expression of your own",
    gives="what its groups are called",
    emitter="whatever the radio needs",
    transport="serial:115200",
)
