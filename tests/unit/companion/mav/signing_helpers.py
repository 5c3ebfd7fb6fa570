"""Helpers of the tests of signing: keys, and frames signed by the letter of the guide."""

from __future__ import annotations

import hashlib
from types import SimpleNamespace
from typing import Any

from pymavlink import mavutil

from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec, frame_crc, message_id
from companion.mav.dialect import Message, mavlink
from companion.mav.signing import (
    ONE_LINK_EACH,
    Signing,
    SigningKey,
    Stream,
)

SECRET = bytes(range(1, 33))
KEY = SigningKey(SECRET)
OTHER_KEY = SigningKey(bytes(range(2, 34)))
NOW = 37_000_000_000_000
MAX_AHEAD = 6_000_000
"""A minute."""


def heartbeat(mark: int = 1) -> Message:
    return mavlink.MAVLink_heartbeat_message(2, 12, 0, mark, 4, 3)


def unsigned(mark: int = 1, system: int = 255, component: int = 190) -> bytes:
    return MavCodec(system, component).encode(heartbeat(mark))


def signed(
    timestamp: int,
    key: SigningKey = KEY,
    *,
    link_id: int = 3,
    system: int = 255,
    component: int = 190,
    message: Message | None = None,
) -> bytes:
    """A frame that `key` signs with exactly this timestamp, by the letter of the guide."""
    frame = bytearray(MavCodec(system, component).encode(message or heartbeat()))
    frame[2] |= 1
    crc = frame_crc(bytes(frame), CRC_EXTRA_BY_ID[message_id(bytes(frame))])
    frame[-2:] = crc.to_bytes(2, "little")
    frame += bytes((link_id,)) + timestamp.to_bytes(6, "little")
    return bytes(frame) + hashlib.sha256(key.secret + bytes(frame)).digest()[:6]


def receiver(timestamp: int = NOW) -> Signing:
    return Signing(KEY, timestamp)


def pymavlink_end(
    secret: bytes = SECRET, timestamp: int = NOW, *, link_id: int = 0
) -> mavlink.MAVLink:
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    mavfile: Any = SimpleNamespace(mav=mav)
    mavutil.mavfile.setup_signing(mavfile, secret, True, None, timestamp, link_id)  # type: ignore[no-untyped-call]
    return mav


def companion(
    timestamp: int = NOW, streams: dict[Stream, int] | None = None, *, clock: int | None = None
) -> Signing:
    return Signing(KEY, timestamp, streams, ONE_LINK_EACH, stored_clock=clock)
