"""Codec of one link: bytes to frames, frames to messages, and back.

Theory of operation of frames. A link delivers chunks of bytes: whole frames and junk in a datagram,
arbitrary pieces of them in a stream. A candidate starts at a magic byte (0xFD for MAVLink 2, 0xFE
for 1). It is a frame only if its CRC-16/MCRF4XX over everything between the magic and the CRC, plus
the message's CRC_EXTRA, matches; otherwise exactly one byte is discarded and the search continues,
so a wrong length byte never swallows the good frame behind it (pymavlink's own parser loses it). A
MAVLink 2 frame with an unknown incompatibility flag is dropped whole, as the protocol requires,
once its CRC has verified it.

A message that is not in the dialect cannot be verified. For a router it is taken as a frame, but
kept separately, if it ends where the data ends or a frame begins and no good frame lies within it.
The end of a datagram ends every candidate; a stream keeps at most one unfinished frame (280 bytes).

Theory of operation of messages. The sequence number is set here (`pack` does not advance it), and
signatures are verified here, before pymavlink sees a frame. No input from a peer raises an
exception. Plain messages, those without arrays and texts, which streams consist of, are also packed
and unpacked here: by a precompiled layout and one attribute getter, because pymavlink's general
path takes most of the time of a link. The others are left to pymavlink, and a test compares both
for every message of the dialect.

Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

from fastcrc import crc16

from companion.errors import LocalProtocolError
from companion.mav.dialect import Message, mavlink

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
HEADER_LENGTH = {MAGIC_V1: 6, MAGIC_V2: 10}
CRC_LENGTH = 2
SIGNATURE_LENGTH = 13
INCOMPAT_SIGNED = 0x01
HEADER_LENGTH_V2 = HEADER_LENGTH[MAGIC_V2]
SHORTEST_V2 = HEADER_LENGTH_V2 + CRC_LENGTH
_TAIL_BY_FLAGS = {0: CRC_LENGTH, INCOMPAT_SIGNED: CRC_LENGTH + SIGNATURE_LENGTH}
"""Bytes behind the payload by incompatibility flags; other flags are unknown."""
MAGIC = re.compile(bytes((ord("["), MAGIC_V2, MAGIC_V1, ord("]"))))


CRC_EXTRA_BY_ID = {
    number: message_class.crc_extra for number, message_class in mavlink.mavlink_map.items()
}
"""CRC_EXTRA of every message of the dialect."""


@dataclass(slots=True)
class FrameCounters:
    """Counters since the splitter was created."""

    good: int = 0
    bad_crc: int = 0
    """Candidates of a known message with a wrong CRC, including junk that resembles one."""
    unknown: int = 0
    """Candidates with a message id that is not in the dialect."""
    incompatible: int = 0
    """Frames with an unknown incompatibility flag."""
    junk_bytes: int = 0


class FrameSplitter:
    """Splitter of a stream or datagrams into CRC-checked frames; may keep unknown messages."""

    def __init__(self, crc_extra_by_id: Mapping[int, int], *, keeps_unknown: bool = False) -> None:
        self.counters = FrameCounters()
        self._crc_extra_by_id = crc_extra_by_id
        self._keeps_unknown = keeps_unknown
        self._pending = b""
        self._unknown: list[bytes] = []

    def split(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        """Return the frames completed by `data`; plain frames of MAVLink 2 are done first."""
        size = len(data)
        if is_datagram and size >= SHORTEST_V2 and data[0] == MAGIC_V2 and not self._pending:
            crc_extra = self._crc_extra_by_id.get(data[7] | data[8] << 8 | data[9] << 16)
            at, tail = HEADER_LENGTH_V2 + data[1], _TAIL_BY_FLAGS.get(data[2])
            if crc_extra is not None and tail is not None and size == at + tail:
                crc = crc16.mcrf4xx(data[1:at] + bytes((crc_extra,)))
                if crc == data[at] | data[at + 1] << 8:
                    self.counters.good += 1
                    return [data]
        return self._split(data, is_datagram=is_datagram)

    def _split(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        buffer = self._pending + data
        frames: list[bytes] = []
        taken: list[tuple[int, int]] = []
        guesses: list[tuple[int, int]] = []
        start = 0
        while True:
            magic = MAGIC.search(buffer, start)
            candidate = len(buffer) if magic is None else magic.start()
            self.counters.junk_bytes += candidate - start
            start = candidate
            if magic is None:
                break
            end = frame_end(buffer, start)
            if end > len(buffer) and not is_datagram:
                break
            frame = buffer[start:end]
            if end <= len(buffer) and self._is_valid(frame):
                taken.append((start, end))
                if frame[0] == MAGIC_V2 and frame[2] & ~INCOMPAT_SIGNED:
                    self.counters.incompatible += 1
                else:
                    frames.append(frame)
                start = end
                continue
            if self._keeps_unknown and end <= len(buffer):
                guesses.append((start, end))
            self.counters.junk_bytes += 1
            start += 1
        if guesses:
            start = max(start, self._keep_unknown(buffer, guesses, taken))
        self._pending = buffer[start:]  # empty after a datagram
        self.counters.good += len(frames)
        return frames

    def take_unknown(self) -> list[bytes]:
        """Return unverified frames of unknown messages since the last call."""
        unknown, self._unknown = self._unknown, []
        return unknown

    def _keep_unknown(
        self, buffer: bytes, guesses: list[tuple[int, int]], taken: list[tuple[int, int]]
    ) -> int:
        """Keep those candidates that are likely frames; return the end of the last one."""
        free_from = guesses[0][0]
        good_ends = [end for _, end in taken]
        for start, end in guesses:
            if message_id(buffer[start:end]) in self._crc_extra_by_id:
                # a wrong CRC, or bytes inside of a kept frame that resemble a known message
                self.counters.bad_crc -= start < free_from
                continue
            ends_well = end == len(buffer) or buffer[end] in HEADER_LENGTH
            next_good = bisect_right(good_ends, start)
            is_free = start >= free_from and not (
                next_good < len(taken) and taken[next_good][0] < end
            )
            if ends_well and is_free:
                self._unknown.append(buffer[start:end])
                free_from = end
        return free_from

    def _is_valid(self, frame: bytes) -> bool:
        crc_extra = self._crc_extra_by_id.get(message_id(frame))
        if crc_extra is None:
            self.counters.unknown += 1
            return False
        if has_good_crc(frame, crc_extra):
            return True
        self.counters.bad_crc += 1
        return False


def frame_end(buffer: bytes, start: int) -> int:
    """Return the end of the frame at the magic byte `start`, by its header; may exceed `buffer`."""
    magic = buffer[start]
    header_end = start + HEADER_LENGTH[magic]
    if header_end > len(buffer):
        return header_end
    end = header_end + buffer[start + 1] + CRC_LENGTH
    if magic == MAGIC_V2 and buffer[start + 2] & INCOMPAT_SIGNED:
        end += SIGNATURE_LENGTH
    return end


def message_id(frame: bytes) -> int:
    """Return the message id in a frame's header."""
    if frame[0] == MAGIC_V1:
        return frame[5]
    return frame[7] | frame[8] << 8 | frame[9] << 16


def header_of(frame: bytes) -> tuple[int, tuple[int, int], int]:
    """Return sequence number, sender's system and component id, and message id of a frame."""
    if frame[0] == MAGIC_V1:
        return frame[2], (frame[3], frame[4]), frame[5]
    return frame[4], (frame[5], frame[6]), frame[7] | frame[8] << 8 | frame[9] << 16


def sender_of(frame: bytes) -> tuple[int, int]:
    """Return the sender's system and component id in a frame's header."""
    at = 3 if frame[0] == MAGIC_V1 else 5
    return (frame[at], frame[at + 1])


def frame_crc(frame: bytes, crc_extra: int) -> int:
    """Return the CRC that a frame must have, from its header and payload."""
    end = HEADER_LENGTH[frame[0]] + frame[1]
    return crc16.mcrf4xx(frame[1:end] + bytes((crc_extra,)))


def has_good_crc(frame: bytes, crc_extra: int) -> bool:
    """Return True if a whole frame has the right CRC."""
    end = HEADER_LENGTH[frame[0]] + frame[1]
    return frame_crc(frame, crc_extra) == frame[end] | frame[end + 1] << 8


def without_signature(frame: bytes, crc_extra: int | None) -> bytes:
    """Return the frame unsigned, for logs: a signature must not be stored (developer guide).

    Without a CRC_EXTRA its length and flag stay, which the CRC covers, and the signature is
    blanked.
    """
    if frame[0] != MAGIC_V2 or not frame[2] & INCOMPAT_SIGNED:
        return frame
    end = HEADER_LENGTH[MAGIC_V2] + frame[1]
    if crc_extra is None:
        return frame[: end + CRC_LENGTH] + bytes(SIGNATURE_LENGTH)
    unsigned = frame[:2] + bytes((frame[2] & ~INCOMPAT_SIGNED,)) + frame[3:end]
    return unsigned + frame_crc(unsigned, crc_extra).to_bytes(CRC_LENGTH, "little")


_HEADER = struct.Struct("<BBBBBBBHB")
_CRC = struct.Struct("<H")


class _Layout(NamedTuple):
    """Layout of a plain message on the wire."""

    message_class: type[Message]
    fields: struct.Struct
    values_of: Callable[[Any], tuple[float, ...]]
    """Getter of the fields' values in wire order."""
    attributes: Mapping[str, object]
    """Attributes that the constructor sets in every message of the class."""
    crc_extra: bytes


@lru_cache(maxsize=1024)
def _layout_of(number: int) -> _Layout | None:
    """Return the layout of a message id; None if it is unknown or not plain."""
    kind = mavlink.mavlink_map.get(number)
    if kind is None or any(kind.array_lengths) or len(kind.ordered_fieldnames) < 2:
        return None
    attributes = {
        "_fieldnames": kind.fieldnames,
        "_instance_field": kind.instance_field,
        "_instance_offset": kind.instance_offset,
    }
    values_of = attrgetter(*kind.ordered_fieldnames)
    return _Layout(kind, kind.unpacker, values_of, attributes, bytes((kind.crc_extra,)))


def pack_plain(message: Message, sequence: int, system_id: int, component_id: int) -> bytes | None:
    """Return the unsigned MAVLink 2 frame of a plain message whose fields fit; None: not plain."""
    number = message.get_msgId()  # not `id`, which is a field of some messages
    layout = _layout_of(number)
    if layout is None or type(message) is not layout.message_class:
        return None  # a derived class may pack itself differently
    payload = layout.fields.pack(*layout.values_of(message))
    payload = payload.rstrip(b"\0") or payload[:1]
    identity = (sequence, system_id, component_id)
    header = _HEADER.pack(MAGIC_V2, len(payload), 0, 0, *identity, number & 0xFFFF, number >> 16)
    crc = crc16.mcrf4xx(header[1:] + payload + layout.crc_extra)
    return header + payload + _CRC.pack(crc)


def unpack_plain(frame: bytes) -> Message | None:
    """Return the message of an unsigned MAVLink 2 frame; None if it is not plain, or invalid."""
    if len(frame) < HEADER_LENGTH_V2 + CRC_LENGTH or frame[0] != MAGIC_V2 or frame[2]:
        return None
    _, length, _, compat_flags, sequence, system_id, component_id, low, high = _HEADER.unpack_from(
        frame
    )
    number = low | high << 16
    layout = _layout_of(number)
    end = HEADER_LENGTH_V2 + length
    if layout is None or len(frame) != end + CRC_LENGTH:
        return None
    (crc,) = _CRC.unpack_from(frame, end)
    if crc16.mcrf4xx(frame[1:end] + layout.crc_extra) != crc:
        return None
    kind, payload = layout.message_class, frame[HEADER_LENGTH_V2:end]
    values = layout.fields.unpack_from(payload.ljust(layout.fields.size, b"\0"))
    message = kind.__new__(kind)  # its constructor takes the fields in another order
    Message.__init__(message, number, kind.msgname)
    vars(message).update(layout.attributes)
    vars(message).update(zip(kind.ordered_fieldnames, values, strict=True))
    message._msgbuf = bytearray(frame)
    message._payload = message._msgbuf[6:-CRC_LENGTH]  # as in pymavlink
    message._crc = crc
    header = message._header
    header.mlen, header.compat_flags, header.seq = length, compat_flags, sequence
    header.srcSystem, header.srcComponent = system_id, component_id
    return message


MAX_MAVLINK1_ID = 255


class FrameSigning(Protocol):
    """Signing of one link's frames."""

    def accepts(self, frame: bytes) -> bool:
        """Return True if a received frame may be decoded."""

    def sign(self, frame: bytes, crc_extra_by_id: Mapping[int, int]) -> bytes:
        """Return the frame in the form sent on this link."""


class MavCodec:
    """Codec with one identity (ids 1 to 255) for one link, with `signing` if any."""

    def __init__(
        self,
        system_id: int,
        component_id: int,
        signing: FrameSigning | None = None,
        *,
        keeps_unknown: bool = False,
    ) -> None:
        self.system_id = system_id
        self.component_id = component_id
        self.signing = signing
        """May be replaced when a key is set up or removed."""
        self.splitter = FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=keeps_unknown)
        self.counters = self.splitter.counters
        self.undecodable = 0
        """Frames with a good CRC whose payload pymavlink rejected."""
        self.unproved = 0
        """Frames with a good CRC that signing rejected."""
        self._mav = mavlink.MAVLink(None)

    def unsigned_copy(self) -> MavCodec:
        """Return an unsigned codec of the same identity and sequence number."""
        other = MavCodec(self.system_id, self.component_id)
        other._mav.seq = self._mav.seq
        return other

    def encode(self, message: Message, *, is_mavlink1: bool = False) -> bytes:
        """Return the frame of `message`, with the next sequence number, signed if configured.

        MAVLink 1 is for peers without MAVLink 2. Raises `LocalProtocolError` if a field does not
        fit its type on the wire, or the frame has no form in MAVLink 1 (an id over 255, or a
        signature).
        """
        if is_mavlink1 and (message.get_msgId() > MAX_MAVLINK1_ID or self.signing is not None):
            raise LocalProtocolError(f"{message.get_type()} cannot be sent in MAVLink 1")
        mav, own = self._mav, (self.system_id, self.component_id)
        mav.srcSystem, mav.srcComponent = own
        try:
            frame = None if is_mavlink1 else pack_plain(message, mav.seq, *own)
            if frame is None:
                frame = bytes(message.pack(mav, force_mavlink1=is_mavlink1))
        except (
            Exception
        ) as error:  # struct.error, TypeError, OverflowError: always the caller's mistake
            raise LocalProtocolError(f"{message.get_type()} cannot be packed: {error}") from error
        mav.seq = (mav.seq + 1) % 256
        return frame if self.signing is None else self.signing.sign(frame, CRC_EXTRA_BY_ID)

    def decode(self, data: bytes, *, is_datagram: bool = True) -> list[Message]:
        """Return the messages completed by `data`; bad bytes are counted, never raised."""
        frames = self.splitter.split(data, is_datagram=is_datagram)
        messages = [self.decode_frame(frame) for frame in frames]
        return [message for message in messages if message is not None]

    def decode_frame(self, frame: bytes) -> Message | None:
        """Return the message of one whole frame; None, and counted, if it is rejected."""
        return self.decode_proved(frame) if self.proves(frame) else None

    def proves(self, frame: bytes) -> bool:
        """Return True if signing, if configured, accepts one whole frame; count rejections."""
        if self.signing is None or self.signing.accepts(frame):
            return True
        self.unproved += 1
        return False

    def decode_proved(self, frame: bytes) -> Message | None:
        """Return the message of an accepted frame; None, and counted, if it cannot be decoded."""
        message = unpack_plain(frame)
        if message is not None:
            return message
        try:
            return self._mav.decode(bytearray(frame))
        except Exception:  # MAVError, UnicodeDecodeError and others, by payload
            self.undecodable += 1
            return None
