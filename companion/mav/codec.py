"""Codec of one link: bytes to messages and back.

Framing, the CRC check and the sequence number are done here (`pack` does not advance it, and
pymavlink's own parser loses the good frame behind a truncated one), and so are signatures: a frame
is verified before pymavlink sees it. No input from a peer raises an exception.

Plain messages, those without arrays and texts, which streams consist of, are also packed and
unpacked here: by a precompiled layout and one attribute getter, because pymavlink's general path
takes most of the time of a link. The others are left to pymavlink, and a test compares both for
every message of the dialect.

Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

from fastcrc import crc16

from companion.errors import LocalProtocolError
from companion.mav.dialect import Message, mavlink
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2, FrameSplitter
from companion.mav.signing import LinkSigning

_HEADER = struct.Struct("<BBBBBBBHB")
_CRC = struct.Struct("<H")
_HEADER_SIZE = HEADER_LENGTH[MAGIC_V2]


class _Layout(NamedTuple):
    """Layout of a plain message on the wire."""

    message_class: type[Message]
    fields: struct.Struct
    values_of: Callable[[Any], tuple[float, ...]]
    """Getter of the fields' values in wire order."""
    order: tuple[int, ...] | None
    """Wire indices of the constructor's arguments; None: the same order."""
    crc_extra: bytes


@lru_cache(maxsize=1024)
def _layout_of(number: int) -> _Layout | None:
    """Return the layout of a message id; None if it is unknown or not plain."""
    kind = mavlink.mavlink_map.get(number)
    if kind is None or any(kind.array_lengths) or len(kind.ordered_fieldnames) < 2:
        return None
    order = tuple(kind.orders)
    return _Layout(
        kind,
        kind.unpacker,
        attrgetter(*kind.ordered_fieldnames),
        None if order == tuple(range(len(order))) else order,
        bytes((kind.crc_extra,)),
    )


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
    if len(frame) < _HEADER_SIZE + CRC_LENGTH or frame[0] != MAGIC_V2 or frame[2]:
        return None
    _, length, _, compat_flags, sequence, system_id, component_id, low, high = _HEADER.unpack_from(
        frame
    )
    number = low | high << 16
    layout = _layout_of(number)
    end = _HEADER_SIZE + length
    if layout is None or len(frame) != end + CRC_LENGTH:
        return None
    (crc,) = _CRC.unpack_from(frame, end)
    if crc16.mcrf4xx(frame[1:end] + layout.crc_extra) != crc:
        return None
    size = layout.fields.size
    payload = frame[_HEADER_SIZE:end].ljust(size, b"\0")
    values = layout.fields.unpack_from(payload)
    order = layout.order
    message = layout.message_class(*(values if order is None else [values[n] for n in order]))
    message._msgbuf = bytearray(frame)
    message._payload = message._msgbuf[6:-CRC_LENGTH]  # as in pymavlink
    message._crc = crc
    header = message._header  # created by the constructor with the message id
    header.mlen, header.compat_flags, header.seq = length, compat_flags, sequence
    header.srcSystem, header.srcComponent = system_id, component_id
    return message


CRC_EXTRA_BY_ID = {
    number: message_class.crc_extra for number, message_class in mavlink.mavlink_map.items()
}

MAX_MAVLINK1_ID = 255


class MavCodec:
    """Codec with one identity (ids 1 to 255) for one link, with `signing` if any."""

    def __init__(
        self, system_id: int, component_id: int, signing: LinkSigning | None = None
    ) -> None:
        self.system_id = system_id
        self.component_id = component_id
        self.signing = signing
        """May be replaced when a key is set up or removed."""
        self.splitter = FrameSplitter(CRC_EXTRA_BY_ID)
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
