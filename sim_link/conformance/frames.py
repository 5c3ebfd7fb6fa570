"""Frames made by hand, right and wrong: the oracle for whoever reads frames.

Nothing here is shared with the codec under test but the CRC_EXTRA of each message. Source: MAVLink
guide, "Packet Serialization" and "Message Signing".
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
HEADER_LENGTH = {MAGIC_V1: 6, MAGIC_V2: 10}
CRC_LENGTH = 2
SIGNED = 0x01
SIGNATURE_LENGTH = 13
SIGNING_UNITS_PER_S = 100_000
"""Signing counts units of 10 microseconds since 2015."""


@dataclass(frozen=True, slots=True)
class FrameSpec:
    """What is unusual about a frame."""

    system_id: int = 255
    component_id: int = 190
    sequence: int = 0
    version: int = 2
    incompat: int = 0
    compat: int = 0
    trim: bool = True
    """Whether trailing zeros of the payload are cut (MAVLink 2 only)."""
    crc_change: int = 0
    """Exclusive-or of the CRC with this."""


def crc_x25(data: bytes) -> int:
    """CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        step = (byte ^ crc) & 0xFF
        step = (step ^ (step << 4)) & 0xFF
        crc = (crc >> 8) ^ (step << 8) ^ (step << 3) ^ (step >> 4)
    return crc & 0xFFFF


def payload_of(message: Message) -> bytes:
    """The message's payload in MAVLink 2, with all its trailing zeros."""
    frame = message.pack(mavlink.MAVLink(None, 1, 1))
    cut = frame[10 : 10 + frame[1]]
    full = type(message).unpacker.size
    return bytes(cut) + bytes(full - len(cut))


def base_length(message: Message) -> int:
    """Payload length in MAVLink 1: the fields before the extensions."""
    frame = message.pack(mavlink.MAVLink(None, 1, 1), force_mavlink1=True)
    return int(frame[1])


def build_frame(message: Message, spec: FrameSpec | None = None) -> bytes:
    """The frame of a message, made as `spec` says."""
    spec = spec or FrameSpec()
    payload = payload_of(message)
    if spec.version == 1:
        payload = payload[: base_length(message)]
    elif spec.trim:
        payload = payload.rstrip(b"\0") or payload[:1]
    return build_raw(message.get_msgId(), payload, type(message).crc_extra, spec)


def build_raw(message_id: int, payload: bytes, crc_extra: int, spec: FrameSpec) -> bytes:
    """A frame of any message id, known or not."""
    head = bytes((spec.sequence, spec.system_id, spec.component_id))
    if spec.version == 1:
        body = bytes((len(payload),)) + head + bytes((message_id,)) + payload
        magic = MAGIC_V1
    else:
        flags = bytes((len(payload), spec.incompat, spec.compat))
        body = flags + head + message_id.to_bytes(3, "little") + payload
        magic = MAGIC_V2
    crc = crc_x25(body + bytes((crc_extra,))) ^ spec.crc_change
    return bytes((magic,)) + body + crc.to_bytes(2, "little")


def sign(frame: bytes, key: bytes, link_id: int, timestamp: int) -> bytes:
    """A frame built with `incompat` 1, completed by its signature.

    Args:
        frame: Without signature.
        key: 32 bytes.
        link_id: Of the sender.
        timestamp: In units of 10 microseconds since 2015.
    """
    tail = bytes((link_id,)) + timestamp.to_bytes(6, "little")
    return frame + tail + hashlib.sha256(key + frame + tail).digest()[:6]


@dataclass(frozen=True, slots=True)
class Signature:
    """The signature block of a signed frame."""

    link_id: int
    timestamp: int
    is_right: bool


def signature_of(frame: bytes, key: bytes) -> Signature | None:
    """What a frame is signed with; None if it is not signed."""
    if frame[0] != MAGIC_V2 or not frame[2] & SIGNED:
        return None
    body, block = frame[:-SIGNATURE_LENGTH], frame[-SIGNATURE_LENGTH:]
    expected = hashlib.sha256(key + body + block[:7]).digest()[:6]
    timestamp = int.from_bytes(block[1:7], "little")
    return Signature(block[0], timestamp, block[7:] == expected)


def cut(data: bytes) -> list[bytes]:
    """The frames that bytes consist of, by the lengths in their headers; the rest is left out."""
    frames = []
    start = 0
    while start + HEADER_LENGTH[MAGIC_V1] <= len(data):
        magic = data[start]
        if magic not in HEADER_LENGTH:
            start += 1
            continue
        end = start + HEADER_LENGTH[magic] + data[start + 1] + CRC_LENGTH
        if magic == MAGIC_V2 and data[start + 2] & SIGNED:
            end += SIGNATURE_LENGTH
        if end <= len(data):
            frames.append(data[start:end])
        start = end
    return frames
