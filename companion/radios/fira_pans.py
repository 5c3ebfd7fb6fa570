"""Ultra-wideband devices of the FiRa consortium's protocol, and those with Decawave's PANS.

FiRa: UCI notifications, and the frames of NXP's SR150 as PX4 reads them. Layouts:
github.com/google/pica `src/uci_packets.pdl`, and PX4's `uwb_sr150` driver; little-endian. Neither
has a checksum, so all numbers of a message must be consistent. Angles are Q9.7 degrees with the
device's sign, each of its own pair of antennas, so arcsines; a figure of merit of 0 means no angle.
PX4 negates those of its frames, and so does `sr150`.

PANS on a DWM1001: the lines of its shell, and the answers of its TLV interface. Over TLV a tag
reports nothing by itself. It is queried at most as often as it ranges, and answers with its last
measurement: an answer that is equal to the millimetre is a repetition.

Sources: Decawave's host API (`dwm_api`); the shell's lines as users print them. Both have the
ranges of a tag to its anchors, so the vehicle carries the tag and the hidden one an anchor. The
tag's own position, also reported, is in the anchors' frame and not used here.
"""

from __future__ import annotations

import math
import re
from struct import Struct

from companion.domain import Params
from companion.radios.decoder import AngleFrame, FrameDecoder, RadioReading
from companion.radios.fields import FieldDecoder

PER_RAD = 128.0 * 180.0 / math.pi
PER_M = 100.0
NO_DISTANCE = 0xFFFF
"""Value for no distance, by FiRa's specification."""
OK, OK_NEGATIVE_DISTANCE = 0x00, 0x1B
STATUS_WORDS = {0x20: "transmission failed", 0x21: "no answer (timeout)"}
LINE_OF_SIGHT = {0: True, 1: False}
UNKNOWN_SIGHT = 255
SIGHTS = (*LINE_OF_SIGHT, UNKNOWN_SIGHT)


def angle_rad(raw: int, merit: int) -> float | None:
    """Return the angle of Q9.7 degrees; None if it was not measured."""
    return raw / PER_RAD if merit else None


def quality_of(*merits: int) -> float | None:
    """Return the worst quality of the measured angles, figures of merit 0 to 100; None: none."""
    there = [merit for merit in merits if merit]
    return min(1.0, min(there) / 100.0) if there else None


def range_of(centimetres: int, status: int) -> float | None:
    """Return the range in metres, None: not measured; negative ones have their own status."""
    if centimetres == NO_DISTANCE:
        return None
    if status == OK_NEGATIVE_DISTANCE:
        return (centimetres - 0x10000 if centimetres >= 0x8000 else -centimetres) / PER_M
    return centimetres / PER_M


PACKET_HEADER = 4
LAST_PACKET, MORE_FOLLOWS = 0x62, 0x72
"""First byte of SESSION_INFO notifications, without and with a continuation packet."""
MAX_PACKETS = 32
SESSION_INFO = Struct("<IIBIBBB8xB")
"""Sequence, session, reserved, interval, type, reserved, address mode, number of measurements."""
KIND_AT, ADDRESS_AT = 13, 15
TWO_WAY, ONE_WAY_ANGLE = 1, 3
KINDS = {0: "one-way", 1: "two-way", 2: "downlink TDoA", 3: "one-way, angle only"}
ADDRESSES = (0, 1)
"""Short and extended."""
TWO_WAY_RECORDS = (Struct("<HBBHhBhB"), Struct("<QBBHhBhB"))
"""Address, status, line of sight, distance, azimuth, its merit, elevation, its merit."""
TWO_WAY_BYTES = 31
ANGLE_RECORDS = (Struct("<HBB3xhBhB"), Struct("<QBB3xhBhB"))
"""Address, status, line of sight, azimuth, its merit, elevation, its merit."""


SR150_FRAME = Struct("<B2x12x2xHBHBhh4x4sB")
"""0x8E, peer, status, distance, line of sight, azimuth, elevation, four merits, 0x1B."""
SR150_END = 0x1B


class FiraDecoder(FrameDecoder):
    """Common part of both formats' decoders."""

    def reading_of(self, mac: int, status: int, sight: int, *rest: int) -> list[RadioReading]:
        """Return at most one reading: distance, azimuth, elevation, each angle with its merit."""
        distance, azimuth, azimuth_merit, elevation, elevation_merit = rest
        if status not in (OK, OK_NEGATIVE_DISTANCE):
            self.counts.refuse(f"status {STATUS_WORDS.get(status, f'0x{status:02x}')}")
            return []
        range_m = range_of(distance, status)
        azimuth_rad = angle_rad(azimuth, azimuth_merit)
        elevation_rad = angle_rad(elevation, elevation_merit)
        if range_m is None and azimuth_rad is None and elevation_rad is None:
            self.counts.refuse("nothing measured")
            return []
        reading = RadioReading(
            emitter=mac,
            range_m=range_m,
            azimuth_rad=azimuth_rad,
            elevation_rad=elevation_rad,
            frame=AngleFrame.ARRAY,
            quality=quality_of(azimuth_merit, elevation_merit),
            line_of_sight=LINE_OF_SIGHT.get(sight),
        )
        return [reading]


class FiraUciDecoder(FiraDecoder):
    """Decoder of SESSION_INFO notifications of any number of packets; other packets are skipped."""

    start = re.compile(rb"[\x62\x72](?:\x00\x00|\x00?\Z)")

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size of all packets of a notification; 0: not one; None: incomplete."""
        end = at
        for _ in range(MAX_PACKETS):
            if len(data) < end + PACKET_HEADER:
                return None
            first, opcode, reserved, length = data[end : end + PACKET_HEADER]
            if first not in (LAST_PACKET, MORE_FOLLOWS) or opcode or reserved or not length:
                return 0
            begin, end = end + PACKET_HEADER, end + PACKET_HEADER + length
            if begin == at + PACKET_HEADER and not self._is_likely(data[begin:end]):
                return 0
            if first == LAST_PACKET:
                return end - at
        return 0

    @staticmethod
    def _is_likely(payload: bytes) -> bool:
        """Return True if the first packet's payload so far can be a notification's."""
        return (len(payload) <= KIND_AT or payload[KIND_AT] in KINDS) and (
            len(payload) <= ADDRESS_AT or payload[ADDRESS_AT] in ADDRESSES
        )

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return the readings of all measurements of a notification; None: not one."""
        payload = _payload_of(frame)
        if len(payload) < SESSION_INFO.size:
            return None
        *_, kind, _, address, count = SESSION_INFO.unpack_from(payload)
        if kind not in KINDS or address not in ADDRESSES:
            return None
        if kind not in (TWO_WAY, ONE_WAY_ANGLE):
            self.counts.refuse(f"ranging is {KINDS[kind]}")
            return []
        is_two_way = kind == TWO_WAY
        record = (TWO_WAY_RECORDS if is_two_way else ANGLE_RECORDS)[address]
        size = TWO_WAY_BYTES if is_two_way else record.size
        end = SESSION_INFO.size + count * size
        if len(payload) < end:
            return None
        readings = []
        for start in range(SESSION_INFO.size, end, size):
            mac, status, sight, *rest = record.unpack_from(payload, start)
            distance = () if is_two_way else (NO_DISTANCE,)
            readings += self.reading_of(mac, status, sight, *distance, *rest)
        return readings


def _payload_of(frame: bytes) -> bytes:
    """Return the payload of all packets of a notification."""
    payload, at = b"", 0
    while at < len(frame):
        end = at + PACKET_HEADER + frame[at + 3]
        payload += frame[at + PACKET_HEADER : end]
        at = end
    return payload


class Sr150Decoder(FiraDecoder):
    """Decoder of one frame per peer.

    Without a checksum, both ends and all bounded fields must fit.
    """

    start = re.compile(b"\x8e")

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size, the same for all frames."""
        return SR150_FRAME.size

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return the reading of a frame's peer."""
        *_, peer, status, distance, sight, azimuth, elevation, merits, end = SR150_FRAME.unpack(
            frame
        )
        if end != SR150_END or sight not in SIGHTS or max(merits) > 100:
            return None
        return self.reading_of(
            peer, status, sight, distance, azimuth, merits[0], elevation, merits[1]
        )


PROMPT = re.compile(r"^(?:dwm> ?)+")
NUMBER = r"-?[0-9]{1,7}(?:\.[0-9]{1,4})?"
WHERE = rf"(?:{NUMBER}|-?nan|-?inf)"
"""Pattern of a coordinate; a tag without a position prints nan, but its ranges are valid."""
RANGE = r"-?[0-9]{1,7}\.[0-9]{2,4}"
"""Pattern of a range, always with its decimals: `3` or `3.1` is the rest of a torn line."""
ANCHOR = re.compile(rf",AN[0-9]{{1,2}},([0-9A-F]{{4}}),{WHERE},{WHERE},{WHERE},({RANGE})", re.I)
POSITION = re.compile(rf",POS(?:,{WHERE}){{3}},[0-9]{{1,3}}", re.I)
DISTANCES = re.compile(r"DIST,([0-9]{1,2})(,.*)?$")
BRACKETED = re.compile(rf"([0-9A-F]{{4}})\[{WHERE},{WHERE},{WHERE}\]=({RANGE})", re.I)
BESIDE = re.compile(rf"le_us=[0-9]+|est\[{WHERE},{WHERE},{WHERE},[0-9]{{1,3}}\]")
POSITION_LINE = re.compile(rf"POS(?:,{WHERE}){{3}},[0-9]{{1,3}}$")


class PansOptions(Params, frozen=True):
    """Options for opening the shell."""

    send_lec: bool = False
    """True: open the shell and switch its lines on; that stops lines that flow already."""


class PansDecoder(FieldDecoder):
    """Decoder of `lec` and `les` lines."""

    Options = PansOptions
    options: PansOptions

    def hello(self) -> bytes:
        """Return two newlines, which open the shell within a second, and the command `lec`."""
        return b"\r\rlec\r" if self.options.send_lec else b""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return a range per anchor, if the line is whole."""
        text = PROMPT.sub("", line.strip())
        if found := DISTANCES.match(text):
            return self._ranges(_counted(found[2] or "", int(found[1])))
        if BRACKETED.match(text):
            return self._ranges(_bracketed(text))
        if POSITION_LINE.match(text):
            self.counts.frames += 1
            return []
        return self.passed_over(line)

    def _ranges(self, anchors: list[tuple[str, str]] | None) -> list[RadioReading]:
        if anchors is None:
            return self.refused("torn line")
        self.counts.frames += 1
        return self.distinct(
            [RadioReading(emitter=name.upper(), range_m=float(text)) for name, text in anchors]
        )


def _counted(text: str, count: int) -> list[tuple[str, str]] | None:
    """Return `count` anchors, perhaps followed by a position; None if there are more or fewer."""
    anchors, at = [], 0
    for _ in range(count):
        found = ANCHOR.match(text, at)
        if not found:
            return None
        anchors.append((found[1], found[2]))
        at = found.end()
    return anchors if at == len(text) or POSITION.fullmatch(text, at) else None


def _bracketed(text: str) -> list[tuple[str, str]] | None:
    """Return the anchors before the trailing words; None if there is anything else."""
    anchors = []
    for word in text.split():
        if found := BRACKETED.fullmatch(word):
            anchors.append((found[1], found[2]))
        elif not BESIDE.fullmatch(word):
            return None
    return anchors


STATUS_BYTES = 3
"""Length of a reply's status: type 0x40, length 1, and the error code, 0 for success."""
ERRORS = {
    1: "unknown command",
    2: "internal error",
    3: "wrong parameter",
    4: "busy",
    5: "not permitted",
}
POSITION_TAG, POSITION_VALUE_BYTES = 0x41, 13
ANCHORS_TAG, TAGS_TAG = 0x49, 0x48
RECORDS = {ANCHORS_TAG: Struct("<HIB12xB"), TAGS_TAG: Struct("<QIB")}
"""Address, millimetres, quality; of an anchor its position, and that one's quality."""
MAX_QUALITY = 100


class PansTlvDecoder(FrameDecoder):
    """Decoder of answers to `dwm_loc_get`, one by one."""

    start = re.compile(rb"\x40(?:\x01|\Z)")

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self._last = b""

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size of the status, and of the answer that follows it."""
        if len(data) < at + STATUS_BYTES:
            return None
        if data[at + 2]:
            return STATUS_BYTES if data[at + 2] in ERRORS else 0
        end = at + STATUS_BYTES
        if len(data) < end + 2:
            return None
        if data[end] == POSITION_TAG and data[end + 1] == POSITION_VALUE_BYTES:
            end += 2 + POSITION_VALUE_BYTES
        if len(data) < end + 3:
            return None
        record = RECORDS.get(data[end])
        if record is None:
            return end - at
        length, count = data[end + 1], data[end + 2]
        return end - at + 2 + length if length == 1 + count * record.size else 0

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return a range per neighbour."""
        if frame[2]:
            self.counts.refuse(f"answer: {ERRORS[frame[2]]}")
            return []
        at = STATUS_BYTES
        if frame[at : at + 1] == bytes([POSITION_TAG]):
            at += 2 + POSITION_VALUE_BYTES
        if at == len(frame):
            return []
        if frame == self._last:
            self.counts.refuse("seen before")
            return []
        digits = 4 if frame[at] == ANCHORS_TAG else 16
        records = list(RECORDS[frame[at]].iter_unpack(frame[at + 3 :]))
        if any(max(qualities) > MAX_QUALITY for _, _, *qualities in records):
            return None
        self._last = frame
        return [
            RadioReading(
                emitter=f"{address:0{digits}X}",
                range_m=distance_mm / 1000.0,
                quality=quality / MAX_QUALITY,
            )
            for address, distance_mm, quality, *_ in records
        ]
