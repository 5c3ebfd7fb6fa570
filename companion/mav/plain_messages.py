"""Packing and unpacking of plain messages: those whose fields are numbers, one by one.

pymavlink's generated classes do this in a general way that takes most of the time of a link; for
messages without arrays and texts, which is what streams are made of, a precompiled layout and one
attribute getter do the same. Whatever is not plain is left to pymavlink, and a test compares both
for every message of the dialect.

Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

from fastcrc import crc16

from companion.mav.dialect import Message, mavlink
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, MAGIC_V2

_HEADER = struct.Struct("<BBBBBBBHB")
_CRC = struct.Struct("<H")
_HEADER_SIZE = HEADER_LENGTH[MAGIC_V2]


class _Layout(NamedTuple):
    """How a plain message lies on the wire."""

    message_class: type[Message]
    fields: struct.Struct
    values_of: Callable[[Any], tuple[float, ...]]
    """The fields' values in the order of the wire."""
    order: tuple[int, ...] | None
    """Places on the wire in the constructor's order; None: the same."""
    crc_extra: bytes


@lru_cache(maxsize=1024)
def _layout_of(number: int) -> _Layout | None:
    """The layout of a message id; None if it is unknown or not plain."""
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
    """The unsigned MAVLink 2 frame of a plain message; None if it is not plain.

    Raises:
        struct.error: A field does not fit its type on the wire.
    """
    number = message.get_msgId()  # not `id`, which is a field of some
    layout = _layout_of(number)
    if layout is None or type(message) is not layout.message_class:
        return None  # a class of somebody's own may pack itself differently
    payload = layout.fields.pack(*layout.values_of(message))
    payload = payload.rstrip(b"\0") or payload[:1]
    header = _HEADER.pack(
        MAGIC_V2,
        len(payload),
        0,
        0,
        sequence,
        system_id,
        component_id,
        number & 0xFFFF,
        number >> 16,
    )
    crc = crc16.mcrf4xx(header[1:] + payload + layout.crc_extra)
    return header + payload + _CRC.pack(crc)


def unpack_plain(frame: bytes) -> Message | None:
    """The message of an unsigned MAVLink 2 frame; None if it is not plain, or not all right."""
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
    message._payload = message._msgbuf[6:-CRC_LENGTH]  # as pymavlink has it
    message._crc = crc
    header = message._header  # the constructor made it, with the number in it
    header.mlen, header.compat_flags, header.seq = length, compat_flags, sequence
    header.srcSystem, header.srcComponent = system_id, component_id
    return message
