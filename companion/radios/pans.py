"""Decawave PANS on a DWM1001: the lines of its shell, and the answers of its TLV interface.

Over TLV a tag reports nothing by itself. It is queried at most as often as it ranges, and answers
with its last measurement: an answer that is equal to the millimetre is a repetition.

Sources: Decawave's host API (`dwm_api`); the shell's lines as users print them. Both have the
ranges of a tag to its anchors, so the vehicle carries the tag and the hidden one an anchor. The
tag's own position, also reported, is in the anchors' frame and not used here.
"""

from __future__ import annotations

import re
from struct import Struct

from companion.domain import Params
from companion.radios.decoder import FrameDecoder, Poll, RadioKind, RadioReading
from companion.radios.fields import FieldDecoder

PROMPT = re.compile(r"^(?:dwm> ?)+")
NUMBER = r"-?[0-9]{1,7}(?:\.[0-9]{1,4})?"
WHERE = rf"(?:{NUMBER}|-?nan|-?inf)"
"""A coordinate; a tag without a position prints nan, and its ranges are good."""
ANCHOR = re.compile(rf",AN[0-9]{{1,2}},([0-9A-F]{{4}}),{WHERE},{WHERE},{WHERE},({NUMBER})", re.I)
PLACE = re.compile(rf",POS(?:,{WHERE}){{3}},[0-9]{{1,3}}", re.I)
DISTANCES = re.compile(r"DIST,([0-9]{1,2})(,.*)?$")
BRACKETED = re.compile(rf"([0-9A-F]{{4}})\[{WHERE},{WHERE},{WHERE}\]=({NUMBER})", re.I)
BESIDE = re.compile(rf"le_us=[0-9]+|est\[{WHERE},{WHERE},{WHERE},[0-9]{{1,3}}\]")
PLACE_LINE = re.compile(rf"POS(?:,{WHERE}){{3}},[0-9]{{1,3}}$")


class PansOptions(Params, frozen=True):
    """Options for opening the shell."""

    send_lec: bool = False
    """Open the shell and switch its lines on; where they flow already, this would stop them."""


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
        if PLACE_LINE.match(text):
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
    return anchors if at == len(text) or PLACE.fullmatch(text, at) else None


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
PLACE_TAG, PLACE_VALUE_BYTES = 0x41, 13
ANCHORS_TAG, TAGS_TAG = 0x49, 0x48
RECORDS = {ANCHORS_TAG: Struct("<HIB12xB"), TAGS_TAG: Struct("<QIB")}
"""Address, millimetres, quality; of an anchor its place, and that one's quality."""
MOST_QUALITY = 100


LOC_GET = b"\x0c\x00"
"""`dwm_loc_get`: the tag's position and the distances of its anchors."""
MOST_HZ = 10.0
"""A tag ranges no faster."""


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
        if data[end] == PLACE_TAG and data[end + 1] == PLACE_VALUE_BYTES:
            end += 2 + PLACE_VALUE_BYTES
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
        if frame[at : at + 1] == bytes([PLACE_TAG]):
            at += 2 + PLACE_VALUE_BYTES
        if at == len(frame):
            return []
        if frame == self._last:
            self.counts.refuse("seen before")
            return []
        digits = 4 if frame[at] == ANCHORS_TAG else 16
        records = list(RECORDS[frame[at]].iter_unpack(frame[at + 3 :]))
        if any(max(qualities) > MOST_QUALITY for _, _, *qualities in records):
            return None
        self._last = frame
        return [
            RadioReading(
                emitter=f"{address:0{digits}X}",
                range_m=distance_mm / 1000.0,
                quality=quality / MOST_QUALITY,
            )
            for address, distance_mm, quality, *_ in records
        ]


DEFAULTS = {"range_sigma_m": 0.15}
PANS = RadioKind(
    name="pans",
    decoder=PansDecoder,
    title="Decawave DWM1001 PANS, its shell",
    gives="range",
    emitter="a DWM1001 anchor",
    transport="serial:115200",
    defaults=DEFAULTS,
)
PANS_TLV = RadioKind(
    name="pans_tlv",
    decoder=PansTlvDecoder,
    title="Decawave DWM1001 PANS, TLV answers",
    gives="range",
    emitter="a DWM1001 anchor",
    transport="serial:115200",
    poll=Poll("", 1.0 / MOST_HZ, LOC_GET),
    defaults=DEFAULTS,
)
