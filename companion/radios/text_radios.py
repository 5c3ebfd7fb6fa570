r"""Modules that print a line per measurement: Makerfabs, TREK1000, SX1280, u-blox and Silabs AoA.

Any other module can be read by `lines`, a regular expression with named groups, called by quantity
and unit as in `companion.radios.fields`: `(?P<emitter>\w+) at (?P<range_m>[\d.]+)`.

Sources: Makerfabs/MaUWB_DW3000-with-STM32-AT-Command (AT manual 1.0.8); Decawave TREK1000 user
manual, report of ranges over USB; u-blox XPLR-AOA user guide UBX-21004616; jgromes/RadioLib
`SX128x_Ranging`, StuartsProjects/SX12XX-LoRa examples 54; SiliconLabs/gecko_sdk
`app/bluetooth/common_host/aoa_util`, its JSON of an angle.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal

import msgspec

from companion.domain import Params
from companion.errors import ConfigError
from companion.radios.decoder import AngleFrame, RadioReading
from companion.radios.fields import (
    NOT_VALID,
    FieldDecoder,
    columns,
    dbm,
    is_marked_invalid,
    is_overflow,
    number,
    problem_of,
    problem_of_spans,
)

SLOTS = 8
SLOTS_OF_FIRMWARE = (4, SLOTS)
RAW24 = 2**24
BANDWIDTHS_KHZ = (406.25, 812.5, 1625.0)
SX1280_M_PER_STEP_KHZ = 150.0 / 4.096
"""Metres of one step of the ranging register, times the bandwidth in kHz."""


class SlotOptions(Params, frozen=True):
    """Selects whether the tag or the anchor is the hidden emitter."""

    hidden: Literal["anchor", "tag"] = "anchor"
    """Role of the emitter; the vehicle carries the other one."""
    slot: Annotated[int, msgspec.Meta(ge=0, lt=SLOTS)] = 0
    """Slot or number of the anchor on the vehicle, with `hidden: tag`."""


class SlotDecoder(FieldDecoder):
    """Base of reports that have a range of one tag to each of several anchors."""

    Options = SlotOptions
    options: SlotOptions

    def read_slots(
        self, tag: int, slots: Iterable[tuple[int, float, int, float | None]], nothing: str
    ) -> list[RadioReading]:
        """Return the readings of answered slots (slot, metres, anchor, dBm), or count `nothing`."""
        self.counts.frames += 1
        options, readings = self.options, []
        for slot, range_m, anchor, power_dbm in slots:
            if options.hidden == "anchor" or slot == options.slot:
                emitter = anchor if options.hidden == "anchor" else tag
                readings.append(RadioReading(emitter, range_m=range_m, power_dbm=power_dbm))
        if not readings:
            self.counts.refuse(nothing)
        return self.distinct(readings)


class MakerfabsAtDecoder(SlotDecoder):
    """Decoder of `AT+RANGE=` reports of Makerfabs' AT firmware."""

    _REPORT = re.compile(
        r"AT\+RANGE=tid: *([0-9]{1,5}), *mask: *([0-9A-Fa-f]{1,2}), *seq: *([0-9]{1,3}), *(.*)"
    )
    _LIST = re.compile(r"(range|rssi|ancid): *\(([^()]*)\)")

    def hello(self) -> bytes:
        """Switch reports on, which are off after a reset."""
        return b"AT+SETRPT=1\r\n"

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return one reading per slot that answered, from centimetres; 0 means no answer."""
        found = self._REPORT.search(line)
        if not found:
            return self.passed_over(line)
        lists = {name: columns(cells) for name, cells in self._LIST.findall(found[4])}
        ranges = [number(cell) for cell in lists.get("range", [])]
        if any(value is not None and not value.is_integer() for value in ranges):
            return self.refused("range is not a whole number of centimetres")
        powers = {slot: dbm(cell) for slot, cell in enumerate(lists.get("rssi", []))}
        names = [number(cell) for cell in lists.get("ancid", map(str, range(SLOTS)))]
        is_whole = len(ranges) in SLOTS_OF_FIRMWARE and len(names) >= len(ranges)
        if not is_whole or None in ranges or None in names:
            return self.refused("torn report")
        mask = int(found[2], 16)
        answered = [
            (slot, range_cm / 100.0, int(name), powers.get(slot))
            for slot, (range_cm, name) in enumerate(zip(ranges, names, strict=False))
            if mask >> slot & 1
            and range_cm
            and not is_overflow(range_cm)
            and name is not None
            and name >= 0.0
        ]
        return self.read_slots(int(found[1]), answered, "no slot answered")


class TrekDecoder(SlotDecoder):
    """Decoder of `mc` reports: four ranges in hexadecimal mm, and a mask; not of `mr` and `ma`.

    Clones print seven or eight, and a time without leading zeros.
    """

    _REPORT = re.compile(
        r"mc ([0-9a-f]{2})((?: {1,2}[0-9a-f]{8}){4}(?:(?: {1,2}[0-9a-f]{8}){3,4})?)"
        r" [0-9a-f]{4} [0-9a-f]{2} [0-9a-f]{1,8} [at]([0-9]):[0-9]",
        re.IGNORECASE,
    )
    _OTHERS = re.compile(r"m[ra] [0-9a-f]{2}(?: [0-9a-f]{8}){4} ", re.IGNORECASE)

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings of one report."""
        found = self._REPORT.search(line)
        if not found:
            return self.no_reading() if self._OTHERS.search(line) else self.passed_over(line)
        mask = int(found[1], 16)
        answered = [
            (slot, int(text, 16) / 1000.0, slot, None)
            for slot, text in enumerate(found[2].split())
            if mask >> slot & 1
        ]
        return self.read_slots(int(found[3]), answered, "no anchor answered")


class UudfOptions(Params, frozen=True):
    """Quality options of a direction."""

    as_arcsines: bool = False
    """True: both angles become those of a two-axis array, for `antenna.kind: two_axis`; of a board
    that looks down the azimuth about its own upright alone has little information."""


class UudfDecoder(FieldDecoder):
    """Decoder of u-blox' `+UUDF` events: azimuth and elevation about the board."""

    Options = UudfOptions
    options: UudfOptions
    _EVENT = re.compile(r"\+UUDF:(.*)")
    MIN_FIELDS, MAX_FIELDS = 9, 10

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of an event; the board's milliseconds restart at `+STARTUP`."""
        found = self._EVENT.search(line)
        if not found:
            return self.passed_over(line)
        cells = columns(found[1])
        if not self.MIN_FIELDS <= len(cells) <= self.MAX_FIELDS:
            return self.refused("torn event")
        azimuth_deg, elevation_deg, milliseconds = map(number, (cells[2], cells[3], cells[8]))
        is_tag = re.fullmatch(r"[0-9A-Fa-f]{12}", cells[0])
        if not is_tag or azimuth_deg is None or elevation_deg is None or milliseconds is None:
            return self.refused("torn event")
        if abs(azimuth_deg) > 90.0 or abs(elevation_deg) > 90.0:
            return self.refused("angle is out of bounds")
        if not (azimuth_deg.is_integer() and elevation_deg.is_integer()):
            return self.refused("angle is not a whole number of degrees")
        return self.understood(
            RadioReading(
                emitter=cells[0].upper(),
                device_time_s=milliseconds / 1000.0,
                azimuth_rad=self._across_rad(azimuth_deg, elevation_deg),
                elevation_rad=math.radians(elevation_deg),
                power_dbm=dbm(cells[1]),
                frame=AngleFrame.ARRAY if self.options.as_arcsines else AngleFrame.DEVICE,
            )
        )

    def _across_rad(self, azimuth_deg: float, elevation_deg: float) -> float:
        """Return the azimuth, or the arcsine of the direction's component to the side."""
        azimuth_rad = math.radians(azimuth_deg)
        if not self.options.as_arcsines:
            return azimuth_rad
        return math.asin(math.sin(azimuth_rad) * math.cos(math.radians(elevation_deg)))


class Sx1280Options(Params, frozen=True):
    """Selects how the range is computed."""

    bandwidth_khz: Annotated[float, msgspec.Meta(gt=0.0)] | None = None
    """Bandwidth of the ranging exchange, 406.25, 812.5 or 1625: then the register is read instead
    of the printed metres, which are rounded, and wrong below zero."""


class Sx1280Decoder(FieldDecoder):
    """Decoder of Semtech SX1280 ranging as RadioLib's and SX12XX-LoRa's examples print it."""

    Options = Sx1280Options
    options: Sx1280Options
    _RADIOLIB = re.compile(
        r"\[SX128[0-9]\] Distance:\s*(-?[0-9]{1,9}\.?[0-9]*) meters(?: \(raw\))?$"
    )
    _FAILED = re.compile(r"\[SX128[0-9]\] Ranging \.\.\. (timed out|failed)")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        if self.options.bandwidth_khz not in (None, *BANDWIDTHS_KHZ):
            raise ConfigError("sx1280: bandwidth_khz: there are 406.25, 812.5 and 1625")

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of a line of either library."""
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
        is_whole = "." in after.get("Distance", "")  # printed with one decimal
        if not re.fullmatch(r"[0-9A-Fa-f]{1,6}", register) or printed is None or not is_whole:
            return self.refused("torn line")
        raw, power_dbm = int(register, 16), dbm(after.get("RSSI", "").removesuffix("dBm"))
        if self.options.bandwidth_khz is not None:
            signed = raw - RAW24 if raw >= RAW24 // 2 else raw
            return self.understood(
                RadioReading(
                    range_m=signed * SX1280_M_PER_STEP_KHZ / self.options.bandwidth_khz,
                    power_dbm=power_dbm,
                )
            )
        if raw >= RAW24 // 2:
            return self.refused("below zero: set bandwidth_khz")
        return self.understood(RadioReading(range_m=printed, power_dbm=power_dbm))


class LinesOptions(Params, frozen=True):
    """Options for reading a line."""

    pattern: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    """Regular expression of Python's `re`, searched for in each line."""
    frame: Literal["device", "array", "nose", "north"] = "device"
    """Zero direction of the angles."""
    hello: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """Line sent once the line is open, without its line end."""
    request: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """Query, without line end, sent every `poll_s` to a module that answers only on request."""


class LinesDecoder(FieldDecoder):
    """Decoder of lines that a user's own expression matches; all others are skipped."""

    Options = LinesOptions
    options: LinesOptions
    has_stamps = True
    longest_line = 1024
    """Short, because an expression that backtracks is slow on long lines."""

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._frame = AngleFrame(self.options.frame)
        self._pattern = _compiled(self.options.pattern)

    def hello(self) -> bytes:
        """Return the configured greeting."""
        return _ended(self.options.hello)

    def request(self) -> bytes:
        """Return the configured query."""
        return _ended(self.options.request)

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the readings of all matches, which must name different emitters.

        A group that took no part is not measured.
        """
        matches = [match for match in self._pattern.finditer(line) if match[0]]
        if not matches:
            return self.passed_over(line)
        problem = next(filter(None, map(problem_of_spans, matches)), None)
        emitters = {match.groupdict().get("emitter") for match in matches}
        if problem is None and is_marked_invalid(line):
            problem = NOT_VALID
        if problem is None and len(emitters) < len(matches):
            problem = "several matches of one emitter in a line: make the expression longer"
        if problem is not None:
            return self.refused(problem)
        return [
            reading
            for match in matches
            for reading in self.read_fields(match.groupdict(), self._frame)
        ]


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
    problem = problem_of(list(compiled.groupindex))
    if problem is not None:
        raise ConfigError(f"lines: pattern: {problem}")
    return compiled


class SilabsAoaDecoder(FieldDecoder):
    """Decoder of angles as Silicon Labs' locators publish them: degrees, JSON over several lines.

    The tag is named by the topic before the object, as `mosquitto_sub -v` prints it, or on the line
    before. The distance is an estimate by power, and is not read.
    """

    _TAG = re.compile(r"\bangle/[^/\s]{1,64}/ble-[a-z]{1,4}-([0-9A-Fa-f]{12})")
    """Topic: the locator, and then the tag."""
    _TOPIC = re.compile(rf"{_TAG.pattern}\s*$")
    """Topic at the end of a line, without its object."""
    longest_object = 2048

    def begin(self) -> None:
        """Begin without a partial object."""
        super().begin()
        self._topic: str | None = None
        self._tag: str | None = None
        """Tag of the next object, and of the one that has begun."""
        self._has_topics = False
        self._object = ""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading that a line completes; it begins, continues or ends an object."""
        if topic := self._TOPIC.search(line):
            self._topic, self._has_topics, self._object = topic[1].upper(), True, ""
            return self.no_reading()
        before, brace, rest = line.rpartition("{")
        if brace:
            named = self._TAG.findall(line)
            self._tag = named[-1].upper() if named else None if before.strip() else self._topic
            self._has_topics = self._has_topics or bool(named)
            self._topic, self._object = None, "{" + rest
        elif self._object:
            self._object += line
        else:
            self._topic = None
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
        if "sequence" not in value:
            return self.refused("no sequence number: not a locator's degrees")
        if self._tag is None and self._has_topics:
            return self.refused("object without its topic")
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
