"""Helpers of the tests of framing: frames of both versions, and splitters."""

from __future__ import annotations

import math

from companion.mav.codec import CRC_EXTRA_BY_ID, FrameSplitter, MavCodec, frame_crc, message_id
from companion.mav.dialect import MAVLink_radio_ranging_message, mavlink


def heartbeat(mark: int = 1) -> bytes:
    return MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, mark, 4, 3))


def position(time_boot_ms: int = 1) -> bytes:
    return MavCodec(1, 1).encode(
        mavlink.MAVLink_local_position_ned_message(time_boot_ms, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3)
    )


def ranging() -> bytes:
    return MavCodec(1, 1).encode(
        MAVLink_radio_ranging_message(9, 80.0, 3.0, math.nan, 0.1, 0.0, 0.1, 7, 100, 5)
    )


def heartbeat_v1(mark: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    message = mavlink.MAVLink_heartbeat_message(2, 12, 0, mark, 4, 3)
    return bytes(message.pack(mav, force_mavlink1=True))


def with_header(frame: bytes, index: int, value: int) -> bytes:
    """The frame with one header byte changed and the CRC right again."""
    changed = bytearray(frame)
    changed[index] = value
    changed[-2:] = frame_crc(bytes(changed), CRC_EXTRA_BY_ID[message_id(frame)]).to_bytes(
        2, "little"
    )
    return bytes(changed)


def splitter() -> FrameSplitter:
    return FrameSplitter(CRC_EXTRA_BY_ID)


def in_datagram(data: bytes) -> list[bytes]:
    return splitter().split(data, is_datagram=True)


GOOD = (heartbeat(), position(), ranging(), heartbeat_v1())


def unknown(frame: bytes | None = None, number: int = 54321) -> bytes:
    changed = bytearray(frame or position())
    changed[7:10] = number.to_bytes(3, "little")
    return bytes(changed)
