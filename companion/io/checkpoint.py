"""A mission's memory as bytes that show when they are not what was written.

    magic (4)  version (2)  zero (2)  length of the payload (4)  payload  CRC-32 of all before (4)

Little-endian; the payload is MessagePack. A file that was cut off, holds a bit that flipped (CRC-32
finds every error of up to 32 neighbouring bits), or comes from another version is refused as a
whole: half a memory is worse than none. This module knows neither files nor clocks.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

import msgspec

from companion.domain import Autopilot
from companion.guidance.memory import SessionMemory

MAGIC = b"CkPt"
VERSION = 1
MAX_BYTES = 256 * 1024
_HEADER = struct.Struct("<4sHHI")
_CRC = struct.Struct("<I")


class CheckpointError(Exception):
    """Bytes that are no checkpoint of ours; the message says why, in words."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A time that can be compared across restarts of the process, and of the computer."""

    unix_s: float
    """Wall clock, which may jump."""
    boot_id: str
    """Of the running kernel; empty where the system does not tell."""
    boot_s: float
    """Seconds since it started, suspended ones included; never jumps, ends with the kernel."""


@dataclass(frozen=True, slots=True)
class MissionKey:
    """What a memory belongs to: for any other it means nothing."""

    system_id: int
    autopilot: Autopilot
    fence: str
    """Digest of the limits."""
    mission: str
    """Digest of everything else that gives the memory its meaning."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A mission's memory, whose it is, and when it was."""

    sequence: int
    """Larger in each that follows, across restarts, too."""
    saved: Moment
    key: MissionKey
    memory: SessionMemory


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """The bytes of a checkpoint."""
    payload = msgspec.msgpack.encode(checkpoint, enc_hook=_plain)
    head = _HEADER.pack(MAGIC, VERSION, 0, len(payload)) + payload
    return head + _CRC.pack(zlib.crc32(head))


def decode_checkpoint(data: bytes) -> Checkpoint:
    """The checkpoint in some bytes.

    Raises:
        CheckpointError: There is none; nothing of it may be used.
    """
    if len(data) < _HEADER.size + _CRC.size or len(data) > MAX_BYTES:
        raise CheckpointError(f"{len(data)} bytes")
    magic, version, _, length = _HEADER.unpack_from(data)
    if magic != MAGIC or length != len(data) - _HEADER.size - _CRC.size:
        raise CheckpointError("cut off or overwritten")
    if _CRC.unpack_from(data, len(data) - _CRC.size)[0] != zlib.crc32(data[: -_CRC.size]):
        raise CheckpointError("damaged")
    if version != VERSION:
        raise CheckpointError(f"of version {version}; this is version {VERSION}")
    try:
        checkpoint = msgspec.msgpack.decode(
            data[_HEADER.size : -_CRC.size], type=Checkpoint, strict=True
        )
    except (msgspec.MsgspecError, RecursionError, ValueError, OverflowError) as error:
        raise CheckpointError(f"of another version ({' '.join(str(error).split())})") from None
    problem = _problem(checkpoint)
    if problem is not None:
        raise CheckpointError(f"impossible: {problem}")
    return checkpoint


def encode_memory(memory: SessionMemory) -> bytes:
    """A memory alone, for the log of inputs."""
    return msgspec.msgpack.encode(memory, enc_hook=_plain)


def decode_memory(data: bytes) -> SessionMemory:
    """The memory that `encode_memory` made bytes of, the same to the last bit.

    Raises:
        CheckpointError: It is none.
    """
    try:
        return msgspec.msgpack.decode(data, type=SessionMemory, strict=True)
    except (msgspec.MsgspecError, RecursionError, ValueError, OverflowError) as error:
        raise CheckpointError(f"of another version ({' '.join(str(error).split())})") from None


def age_s(then: Moment, now: Moment) -> float | None:
    """Seconds between two moments; None where no clock tells.

    Under one kernel its own clock is exact. Otherwise the wall clock is believed, unless it went
    back: computers without a clock of their own start in the past.
    """
    if then.boot_id and then.boot_id == now.boot_id:
        return now.boot_s - then.boot_s if now.boot_s >= then.boot_s else None
    passed_s = now.unix_s - then.unix_s
    return passed_s if passed_s >= 0.0 else None


def _plain(value: object) -> object:
    """A numpy scalar, which arithmetic leaves here and there, as Python's own."""
    if isinstance(value, float | int):
        return float(value) if isinstance(value, float) else int(value)
    raise TypeError(f"a checkpoint holds no {type(value).__name__}")


def _problem(checkpoint: Checkpoint) -> str | None:
    saved, key = checkpoint.saved, checkpoint.key
    if not (math.isfinite(saved.unix_s) and math.isfinite(saved.boot_s)):
        return "a time that is no number"
    if checkpoint.sequence < 0 or not 1 <= key.system_id <= 255:
        return "an impossible sequence or system id"
    return checkpoint.memory.problem
