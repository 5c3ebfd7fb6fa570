"""Another content in the same frame: ids, sequence number and, with the key, the signature stay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec
from companion.mav.dialect import mavlink
from companion.mav.framing import (
    CRC_LENGTH,
    HEADER_LENGTH,
    INCOMPAT_SIGNED,
    MAGIC_V1,
    MAGIC_V2,
    SIGNATURE_LENGTH,
    frame_crc,
    message_id,
)
from companion.mav.signing import HASH_LENGTH, SigningKey, is_signed

_READER = MavCodec(9, 9)


def rewritten(frame: bytes, change: Callable[[Any], None], key: SigningKey | None) -> bytes:
    """The frame after a change of its fields; as it was if nobody may or can read it.

    Args:
        frame: One whole frame.
        change: Sets fields of the message.
        key: Signs the frame anew where it was signed; without it such a frame stays as it is.
    """
    if is_signed(frame) and key is None:
        return frame
    message = _READER.decode_frame(frame)
    if message is None:
        return frame
    change(message)
    mav = mavlink.MAVLink(
        None, srcSystem=message.get_srcSystem(), srcComponent=message.get_srcComponent()
    )
    mav.seq = message.get_seq()
    packed: bytes = message.pack(mav, force_mavlink1=frame[0] == MAGIC_V1)
    return packed if not is_signed(frame) or key is None else _signed_as(packed, frame, key)


def _signed_as(packed: bytes, model: bytes, key: SigningKey) -> bytes:
    """`packed` with the link id and timestamp of `model`'s signature."""
    end = HEADER_LENGTH[MAGIC_V2] + packed[1]
    head = packed[:2] + bytes((packed[2] | INCOMPAT_SIGNED,)) + packed[3:end]
    head += frame_crc(head, CRC_EXTRA_BY_ID[message_id(packed)]).to_bytes(CRC_LENGTH, "little")
    head += model[-SIGNATURE_LENGTH:-HASH_LENGTH]
    return head + key.signature_of(head)
