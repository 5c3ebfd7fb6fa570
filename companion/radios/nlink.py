"""Nooploop NLink: the binary frames of LinkTrack, LinkTrack AOA and the IoT series.

Layouts: github.com/nooploop-dev/nlink_unpack and nlink_parser. Little-endian; a frame ends with the
low 8 bits of the sum of all bytes before it. Its length must fit the number of its elements as
well, because one sum in 256 is right by chance, and because bytes that are not a frame are then
rejected without waiting.

Angles are the device's: of two antennas, so arcsines, and counter-clockwise, to our knowledge, so
that `bearing_sign` is -1. Frames with measurements of other nodes, or with nothing that a range can
be made of, are counted and skipped; so are those of TOFSense lasers (0x57), byte by byte.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from struct import Struct

from companion.domain import Params, Positive
from companion.radios.decoder import AngleFrame, FrameDecoder, RadioReading

SHORTEST, LONGEST = 12, 2048
"""Bytes of a frame that has a length field."""
PER_S = PER_M = 1000.0
DBM = -0.5
"""Signals are in steps of half a dBm, without their sign."""
NO_DISTANCE = "no distance"
PER_RAD = 18_000.0 / math.pi
LOS_GAP_DB = 6.0
"""Largest gap of the first path to the whole signal in line of sight (DW1000 user manual)."""

U16, U32 = Struct("<H"), Struct("<I")
RANGED = Struct("<BBHbBB")
"""Role, id, distance (24 bits in two), first path, received."""
RANGED_AND_DATED = Struct("<BBHbBB6x")
RANGED_WIDE = Struct("<BIHbBB")
WITH_ANGLE = Struct("<BBHbhBB2x")
"""Role, id, distance, angle, first path, received."""
IOT_PEER = Struct("<IHbhhBBB")
"""Id, distance, azimuth, elevation, first path, received, length of the data that follow."""
TAG_DISTANCES = Struct("<" + 8 * "Hb")


class NlinkOptions(Params, frozen=True):
    """Properties of the signals that the frames lack."""

    nlos_gap_db: Positive | None = None
    """Excess of the received power over the first path above which it is not in line of sight;
    null: not judged."""
    behind_fp_dbm: float | None = None
    """First path's power below which a signal is from behind, and its angle dropped."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Offsets of the used fields from a frame's first byte."""

    header: int
    """Bytes before the repeated element."""
    element: Struct | None = None
    """Record of one node; None if the frame has no ranges and is skipped."""
    element_bytes: int = 0
    """Size of an element; 0: sizes vary, and only the length is known."""
    time_at: int = 0
    """Milliseconds of the device's own clock."""


VARIABLE: Mapping[int, Layout] = {
    0x02: Layout(11),
    0x03: Layout(27, None, 20),
    0x04: Layout(119, RANGED_AND_DATED, 13, time_at=102),
    0x05: Layout(21, RANGED, 7, time_at=6),
    0x06: Layout(21),
    0x07: Layout(21, WITH_ANGLE, 11, time_at=6),
    0x08: Layout(24, RANGED_WIDE, 10, time_at=9),
    0x09: Layout(14),
    0x0B: Layout(SHORTEST),
}
"""Layouts by function mark; the number of elements is the last byte of the header."""
SKIPPED = {
    0x00: "AnchorFrame0: other nodes' ranges",
    0x02: "NodeFrame0: no ranges",
    0x03: "NodeFrame1: no ranges",
    0x06: "NodeFrame4: other nodes' ranges",
    0x09: "NodeFrame6: no ranges",
    0x0B: "NodeFrame7: its layout is not published; choose AOA_NodeFrame0 in NAssistant",
}
ANCHOR_FRAME_BYTES, ANCHOR_FRAME_END = 896, 0xEE
TAG_FRAME_BYTES, TAG_FRAME_DISTANCES_AT, TAG_FRAME_TIME_AT = 128, 22, 108
IOT_HEADER, IOT_TIME_AT = 14, 8


class NlinkDecoder(FrameDecoder):
    """Decoder of the ranges and angles that a node measured itself."""

    Options = NlinkOptions
    options: NlinkOptions
    start = re.compile(rb"\x55(?:[\x00-\x09\x0b]|\Z)|\x6a(?:\x00|\Z)")

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the frame's length; 0: not a frame; None: incomplete."""
        if len(data) < at + 2:
            return None
        mark = data[at + 1]
        if data[at] == 0x55 and mark == 0x00:
            return ANCHOR_FRAME_BYTES
        if data[at] == 0x55 and mark == 0x01:
            return TAG_FRAME_BYTES
        if len(data) < at + 4:
            return None
        size = U16.unpack_from(data, at + 2)[0]
        layout = VARIABLE[mark] if data[at] == 0x55 else Layout(IOT_HEADER)
        if not max(SHORTEST, layout.header + 1) <= size <= LONGEST:
            return 0
        if layout.element_bytes:
            if len(data) < at + layout.header:
                return None
            count = data[at + layout.header - 1]
            if size != layout.header + count * layout.element_bytes + 1:
                return 0
        return int(size)

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return the node's own measurements; None if the checksum is wrong."""
        mark = frame[1]
        is_iot = frame[0] != 0x55
        if mark == 0x00 and not is_iot:
            if frame[-1] != ANCHOR_FRAME_END:
                return None
        elif sum(frame[:-1]) & 0xFF != frame[-1]:
            self.counts.bad_checksum += 1
            return None
        if is_iot:
            return self._iot(frame)
        if mark in SKIPPED:
            self.counts.refuse(SKIPPED[mark])
            return []
        if mark == 0x01:
            return self._tag_frame(frame)
        layout = VARIABLE[mark]
        assert layout.element is not None
        return self._nodes(frame, layout, layout.element)

    def _nodes(self, frame: bytes, layout: Layout, element: Struct) -> list[RadioReading]:
        """Return one reading per element, each a node."""
        time_s = U32.unpack_from(frame, layout.time_at)[0] / PER_S
        has_angle = element is WITH_ANGLE
        readings = []
        for fields in element.iter_unpack(frame[layout.header : -1]):
            ident, low, high = fields[1:4]
            if high < 0 or not (low or high):
                self.counts.refuse(NO_DISTANCE)
                continue
            fp, rx = fields[-2:]
            readings.append(
                RadioReading(
                    emitter=ident,
                    device_time_s=time_s,
                    range_m=(high << 16 | low) / PER_M,
                    azimuth_rad=self._azimuth_rad(fields[4], fp) if has_angle else None,
                    frame=AngleFrame.ARRAY,
                    line_of_sight=self._is_in_sight(fp, rx),
                    power_dbm=rx * DBM or None,
                )
            )
        return readings

    def _tag_frame(self, frame: bytes) -> list[RadioReading]:
        """Return eight distances, each indexed by an anchor's id; the frame has nothing else."""
        time_s = U32.unpack_from(frame, TAG_FRAME_TIME_AT)[0] / PER_S
        halves = TAG_DISTANCES.unpack_from(frame, TAG_FRAME_DISTANCES_AT)
        return [
            RadioReading(emitter=ident, device_time_s=time_s, range_m=(high << 16 | low) / PER_M)
            for ident, (low, high) in enumerate(zip(halves[::2], halves[1::2], strict=True))
            if high >= 0 and (low or high)
        ]

    def _iot(self, frame: bytes) -> list[RadioReading] | None:
        """Return peers with both angles, skipping user data; None if they do not fill the frame."""
        time_s = U32.unpack_from(frame, IOT_TIME_AT)[0] / PER_S
        readings, at, end = [], IOT_HEADER, len(frame) - 1
        for _ in range(frame[IOT_HEADER - 1]):
            if at + IOT_PEER.size > end:
                return None
            ident, low, high, azimuth, elevation, fp, rx, data = IOT_PEER.unpack_from(frame, at)
            at += IOT_PEER.size + (data & 0x0F)
            if high < 0 or not (low or high):
                self.counts.refuse(NO_DISTANCE)
                continue
            azimuth_rad = self._azimuth_rad(azimuth, fp)
            readings.append(
                RadioReading(
                    emitter=ident,
                    device_time_s=time_s,
                    range_m=(high << 16 | low) / PER_M,
                    azimuth_rad=azimuth_rad,
                    elevation_rad=None if azimuth_rad is None else elevation / PER_RAD,
                    power_dbm=rx * DBM or None,
                    frame=AngleFrame.ARRAY,
                )
            )
        return readings if at == end else None

    def _azimuth_rad(self, raw: int, fp: int) -> float | None:
        """Return the azimuth; None if the signal is from behind."""
        least_dbm = self.options.behind_fp_dbm
        if least_dbm is not None and fp * DBM < least_dbm:
            self.counts.refuse("from behind: angle dropped")
            return None
        return raw / PER_RAD

    def _is_in_sight(self, fp: int, rx: int) -> bool | None:
        """Return True for line of sight, by the first path's share of the signal; None: unknown."""
        most_db = self.options.nlos_gap_db
        if most_db is None:
            return None
        gap_db = (rx - fp) * DBM
        if gap_db > most_db:
            return False
        return True if gap_db < LOS_GAP_DB else None
