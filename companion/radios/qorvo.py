"""Qorvo's ultra-wideband kits: the CLI of QM33 and DW3xxx, and the `JS` frames of PDoA kits.

Sources: Qorvo's SDK developer manual and DWM3001CDK developer guide as users quote them, and their
captures; README of uwb-qorvo-tools, `run_fira_twr`. No format has a checksum. Angles are those of
pairs of antennas, so arcsines, with the device's own sign.
"""

from __future__ import annotations

import math
import re
from typing import Annotated

import msgspec

from companion.radios.decoder import AngleFrame, RadioReading
from companion.radios.fields import FieldDecoder, dbm, is_overflow, number

MAX_RECORD_BYTES = 8192
PER_M = 100.0
MAX_ANGLE_DEG = 90.0

RECORD = "SESSION_INFO_NTF:"
ANY_RECORD = "SESSION_"
CONTINUED = (" ", "\t", "[")
"""First characters of a line that continues a record."""
MEASUREMENT = re.compile(r"\[mac_address=((?:[^\[\]]|\[\w*\])*)\]")
"""Measurement from bracket to bracket; names of values have units in brackets, too."""
ADDRESS = re.compile(r"0x[0-9a-fA-F]{1,16}")
FAILURES = {
    "TX_FAILED",
    "RX_TIMEOUT",
    "RX_PHY_DEC_FAILED",
    "RX_PHY_TOA_FAILED",
    "RX_PHY_STS_FAILED",
    "RX_MAC_DEC_FAILED",
    "RX_MAC_IE_DEC_FAILED",
    "RX_MAC_IE_MISSING",
}


TOOL_LINE = re.compile(
    r" *(# Measurement [0-9]{1,3}|status|mac address|distance|AoA (?:azimuth|az\. FOM)"
    r"|AoA elev(?:ation|\. FOM)|rssi): *(\S*) ?(\S*).*"
)
"""Key, value and unit of a line that Qorvo's `run_fira_twr` prints of a measurement."""


class BlockResult(msgspec.Struct, frozen=True):
    """One device in a block of ranging, as firmware before 2024 prints it."""

    address: Annotated[str, msgspec.Meta(pattern="^0x[0-9a-fA-F]{1,16}$")] = msgspec.field(
        name="Addr"
    )
    status: str = msgspec.field(name="Status")
    distance_cm: float | None = msgspec.field(name="D_cm", default=None)
    phase_deg: float = msgspec.field(name="LPDoA_deg", default=0.0)
    azimuth_deg: float = msgspec.field(name="LAoA_deg", default=0.0)


class Block(msgspec.Struct, frozen=True):
    """Block of ranging, on one line."""

    results: list[BlockResult]


BLOCK = re.compile(r'\{"Block":')
BLOCKS = msgspec.json.Decoder(Block)


class QorvoCliDecoder(FieldDecoder):
    """Decoder of SESSION_INFO_NTF records, of two or more lines each, and of older JSON blocks.

    It also reads the output of the SDK's tool `run_fira_twr`, a key on each line.
    """

    longest_line = MAX_RECORD_BYTES

    def begin(self) -> None:
        """Begin without a partial record."""
        super().begin()
        self._record = ""
        self._tool: dict[str, tuple[str, str]] | None = None

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the measurements of a record that a line ends or breaks off."""
        if found := BLOCK.search(line):
            return self._block(line[found.start() :])
        if not self._record and (found := TOOL_LINE.fullmatch(line)):
            return self._of_tool(line, *found.groups())
        readings: list[RadioReading] = []
        if self._record and not line.strip():
            return readings
        is_new = ANY_RECORD in line
        if self._record and (is_new or not line.startswith(CONTINUED)):
            readings = self._ended()
        if RECORD in line:
            line = line[line.rindex(RECORD) :]
        elif is_new or not self._record:
            return readings + self.passed_over(line)
        self._record += line
        if "}" in line or len(self._record) > MAX_RECORD_BYTES:
            readings += self._ended()
        return readings

    def _of_tool(self, line: str, key: str, value: str, unit: str) -> list[RadioReading]:
        """Return the measurement that a line ends; an angle without a merit is not measured."""
        if key.startswith("#"):
            self._tool = {}
            return self.no_reading()
        if self._tool is None:
            return self.passed_over(line)
        self._tool[key] = value, unit
        if key != "rssi":
            return []
        given, self._tool = self._tool, None
        address = given.get("mac address", ("", ""))[0].split(":")
        if "." in address[0]:
            address = address[0].split(".")[::-1]
        status, (distance, of_length) = (
            given.get("status", ("",))[0],
            given.get("distance", ("", "")),
        )
        values = {
            "status": "SUCCESS" if status == "Ok" else status,
            f"distance[{of_length}]": distance,
            "RSSI[dBm]": value,
        }
        for angle, merit, name in (("azimuth", "az.", "loc_az"), ("elevation", "elev.", "loc_el")):
            if number(given.get(f"AoA {merit} FOM", ("",))[0]):
                values[name] = given.get(f"AoA {angle}", ("",))[0]
        reading = self._checked("0x" + "".join(address), values)
        return [] if reading is None else [reading]

    def _block(self, text: str) -> list[RadioReading]:
        """Return the measurements of a block; without an angle all its angles are exactly 0."""
        try:
            block = BLOCKS.decode(text.strip())
        except (msgspec.MsgspecError, RecursionError):
            return self.refused("torn block")
        self.counts.frames += 1
        readings = []
        for result in block.results:
            values = {"status": "SUCCESS" if result.status == "Ok" else result.status}
            if result.distance_cm is not None:
                values["distance[cm]"] = str(result.distance_cm)
            if result.phase_deg or result.azimuth_deg:
                values["loc_az"] = str(result.azimuth_deg)
            reading = self._checked(result.address, values)
            if reading is not None:
                readings.append(reading)
        return self.distinct(readings)

    def _ended(self) -> list[RadioReading]:
        """Return the complete measurements of the record."""
        record, self._record = self._record[:MAX_RECORD_BYTES], ""
        self.counts.frames += 1
        readings = (self._reading_of(found[1]) for found in MEASUREMENT.finditer(record))
        return self.distinct([reading for reading in readings if reading is not None])

    def _reading_of(self, text: str) -> RadioReading | None:
        address, *pairs = text.split(",")
        if not all("=" in pair for pair in pairs):
            self.counts.refuse("torn measurement")
            return None
        return self._checked(address, dict(pair.strip().partition("=")[::2] for pair in pairs))

    def _checked(self, address: str, values: dict[str, str]) -> RadioReading | None:
        status = values.get("status", "").strip('"')
        reason = None
        if not ADDRESS.fullmatch(address) or not status:
            reason = "torn measurement"
        elif status != "SUCCESS":
            reason = f"status {status}" if status in FAILURES else "status is no success"
        if reason is not None:
            self.counts.refuse(reason)
            return None
        return self._measured(int(address, 16), values)

    def _measured(self, address: int, values: dict[str, str]) -> RadioReading | None:
        """Return the measurement of a record; absent values are not measured, malformed refused."""
        there = {key: number(values[key]) for key in MEASURED_KEYS if key in values}
        distance_cm, azimuth_deg, elevation_deg = map(there.get, MEASURED_KEYS)
        if None in there.values():
            self.counts.refuse("torn measurement")
            return None
        if distance_cm is None and any(key.startswith("distance") for key in values):
            self.counts.refuse("distance is not in cm")
            return None
        if not there:
            self.counts.refuse("nothing measured")
            return None
        if is_overflow(distance_cm or 0.0):
            self.counts.refuse("distance with all bits set: nothing measured")
            return None
        if max(abs(azimuth_deg or 0.0), abs(elevation_deg or 0.0)) > MAX_ANGLE_DEG:
            self.counts.refuse("angle is out of bounds")
            return None
        return RadioReading(
            emitter=address,
            range_m=None if distance_cm is None else distance_cm / PER_M,
            azimuth_rad=None if azimuth_deg is None else math.radians(azimuth_deg),
            elevation_rad=None if elevation_deg is None else math.radians(elevation_deg),
            power_dbm=dbm(values.get("RSSI[dBm]")),
            frame=AngleFrame.ARRAY,
        )


MEASURED_KEYS = ("distance[cm]", "loc_az", "loc_el")


class Twr(msgspec.Struct, frozen=True):
    """A node's measurement of a tag; X, Y and Z are the tag's accelerometer."""

    name: Annotated[str, msgspec.Meta(pattern="^[0-9A-Fa-f]{1,16}$")] = msgspec.field(name="a16")
    range_cm: float = msgspec.field(name="D")
    right_cm: float = msgspec.field(name="Xcm", default=0.0)
    ahead_cm: float = msgspec.field(name="Ycm", default=0.0)


class JsFrame(msgspec.Struct, frozen=True):
    """Frame with measurements; the other kinds (SN, NewTag) have none."""

    twr: Twr | None = msgspec.field(name="TWR", default=None)


JS = re.compile(r"JS(?=[0-9A-Fa-f ]{4}\{)")
LENGTH_DIGITS = 4
SHORT_FORM = re.compile(r"AR([0-9A-F]{4})[0-9A-F]{2}([0-9A-F]{8})([0-9A-F]{8})$")
"""Address, number, X and Y in two's complement."""
FRAME = msgspec.json.Decoder(JsFrame)


class PdoaJsDecoder(FieldDecoder):
    """Decoder of frames of `JS`, a length in four hexadecimal digits, and JSON."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the measurements of all frames in a line: a torn one has no end of its own."""
        if found := SHORT_FORM.match(line.strip()):
            right_cm, ahead_cm = (_signed(int(text, 16)) for text in found.group(2, 3))
            range_cm = math.hypot(right_cm, ahead_cm)
            return self.understood(_reading_at(found[1], range_cm, right_cm, ahead_cm))
        before, *frames = JS.split(line)
        if before.strip():
            self.passed_over(before)
        return [reading for text in frames for reading in self._read(text)]

    def _read(self, text: str) -> list[RadioReading]:
        """Read a frame by its length; if that is wrong, up to the last brace."""
        digits, body = text[:LENGTH_DIGITS], text[LENGTH_DIGITS:]
        length = int(digits, 16) if " " not in digits else 0
        for end in (length, body.rfind("}") + 1):
            try:
                frame = FRAME.decode(body[:end])
            except (msgspec.MsgspecError, RecursionError):
                continue
            if frame.twr is None:
                self.counts.frames += 1
                return []
            twr = frame.twr
            if is_overflow(twr.range_cm):
                return self.refused("distance with all bits set: nothing measured")
            if not twr.range_cm.is_integer():
                return self.refused("distance is not a whole number of centimetres")
            return self.understood(_reading_at(twr.name, twr.range_cm, twr.right_cm, twr.ahead_cm))
        return self.refused("torn frame")


def _reading_at(name: str, range_cm: float, right_cm: float, ahead_cm: float) -> RadioReading:
    """Return the reading of a position on the node's plane; without a position, no bearing."""
    has_bearing = right_cm != 0.0 or ahead_cm != 0.0
    return RadioReading(
        emitter=name.upper(),
        range_m=range_cm / PER_M,
        azimuth_rad=math.atan2(right_cm, ahead_cm) if has_bearing else None,
        frame=AngleFrame.ARRAY,
    )


def _signed(raw: int) -> float:
    return float(raw - 2**32 if raw >= 2**31 else raw)
