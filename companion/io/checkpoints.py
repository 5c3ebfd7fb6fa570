"""Memory on disk: checkpoints of a mission, and range offsets of single radios between flights.

A checkpoint is one of two files that are written alternately, with a checksum:

    magic (4)  version (2)  zero (2)  length of the payload (4)  payload  CRC-32 of all before (4)

Little-endian; the payload is MessagePack. A file that is truncated, has a flipped bit (CRC-32
detects every burst of up to 32 bits), or is of another version is refused as a whole: a
partial memory is worse than none.

A checkpoint replaces the older of the two files (`files.write_bytes_atomic`, in a thread of its
own), so that neither a power cut nor a kill can lose both. A reader takes the newest valid one.

Range offsets are kept by serial number. A USB radio is recognised by its name in
`/dev/serial/by-id` on Linux, which has its maker and serial number; any other one by its address.
"""

from __future__ import annotations

import math
import os
import struct
import time
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from companion.domain import Autopilot
from companion.errors import CompanionError, ConfigError, decoding_problem
from companion.guidance.events import SessionMemory, VehicleMark
from companion.io.files import BackgroundReplacer, open_file, read_bytes, write_json_atomic

MAGIC = b"CkPt"
VERSION = 1
MAX_BYTES = 256 * 1024
_HEADER = struct.Struct("<4sHHI")
_CRC = struct.Struct("<I")
T = TypeVar("T")


class CheckpointError(Exception):
    """Bytes are not a checkpoint of this program; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A time that can be compared across restarts of the process and the computer."""

    unix_s: float
    """Wall-clock time, which may jump."""
    boot_id: str
    """Boot id of the running kernel; empty if the system does not provide one."""
    boot_s: float
    """Seconds since the computer's boot, including suspended time; never jumps."""


@dataclass(frozen=True, slots=True)
class MissionKey:
    """Mission that a memory belongs to; in any other it must not be used."""

    system_id: int
    autopilot: Autopilot
    fence: str
    """Digest of the limits."""
    mission: str
    """Digest of everything else that gives the memory its meaning."""
    autopilot_fence: str = ""
    """Digest of the autopilot's fence, where that is the one to keep."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A mission's memory with its mission and its time."""

    sequence: int
    """Number of the checkpoint, which increases across restarts, too."""
    saved: Moment
    key: MissionKey
    memory: SessionMemory
    vehicle: VehicleMark | None = None
    """Identity of the vehicle at that time."""


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of a checkpoint."""
    payload = msgspec.msgpack.encode(checkpoint, enc_hook=_plain)
    head = _HEADER.pack(MAGIC, VERSION, 0, len(payload)) + payload
    return head + _CRC.pack(zlib.crc32(head))


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Return the checkpoint in some bytes; after a `CheckpointError` none of it may be used."""
    if len(data) < _HEADER.size + _CRC.size or len(data) > MAX_BYTES:
        raise CheckpointError(f"{len(data)} bytes")
    magic, version, _, length = _HEADER.unpack_from(data)
    if magic != MAGIC or length != len(data) - _HEADER.size - _CRC.size:
        raise CheckpointError("cut off or overwritten")
    if _CRC.unpack_from(data, len(data) - _CRC.size)[0] != zlib.crc32(data[: -_CRC.size]):
        raise CheckpointError("damaged")
    if version != VERSION:
        raise CheckpointError(f"of version {version}; this is version {VERSION}")
    checkpoint = _decode(data[_HEADER.size : -_CRC.size], Checkpoint)
    problem = _problem(checkpoint)
    if problem is not None:
        raise CheckpointError(f"impossible: {problem}")
    return checkpoint


def encode_memory(memory: SessionMemory) -> bytes:
    """Return the bytes of a memory alone, for the log of inputs."""
    return msgspec.msgpack.encode(memory, enc_hook=_plain)


def decode_memory(data: bytes) -> SessionMemory:
    """Return the memory that `encode_memory` encoded, bit for bit; or raise a `CheckpointError`."""
    return _decode(data, SessionMemory)


def _decode(payload: bytes, kind: type[T]) -> T:
    try:
        return msgspec.msgpack.decode(payload, type=kind, strict=True)
    except (msgspec.MsgspecError, RecursionError, ValueError, OverflowError) as error:
        raise CheckpointError(f"of another version ({decoding_problem(error)})") from None


def age_s(then: Moment, now: Moment) -> float | None:
    """Return the seconds between two moments; None if no clock spans both.

    Under one kernel its own clock is exact. Otherwise the wall clock is used, unless it went back:
    computers without a battery-backed clock start in the past.
    """
    if then.boot_id and then.boot_id == now.boot_id:
        return now.boot_s - then.boot_s if now.boot_s >= then.boot_s else None
    passed_s = now.unix_s - then.unix_s
    return passed_s if passed_s >= 0.0 else None


def _plain(value: object) -> object:
    """Return a numpy scalar as Python's own type; raise `TypeError` for others."""
    if isinstance(value, float | int):
        return float(value) if isinstance(value, float) else int(value)
    raise TypeError(f"a checkpoint holds no {type(value).__name__}")


def _problem(checkpoint: Checkpoint) -> str | None:
    saved, key = checkpoint.saved, checkpoint.key
    if not (math.isfinite(saved.unix_s) and math.isfinite(saved.boot_s)):
        return "a time that is not a number"
    if checkpoint.vehicle is not None and not math.isfinite(checkpoint.vehicle.boot_s):
        return "a boot clock that is not a number"
    if checkpoint.sequence < 0 or not 1 <= key.system_id <= 255:
        return "an impossible sequence or system id"
    return checkpoint.memory.problem


_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MODE = 0o600
"""Mode of the file, which reveals the vehicle's position."""


def present_moment() -> Moment:
    """Return the current time, for comparison across restarts."""
    boot_id = ""
    with suppress(OSError):
        boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return Moment(time.time(), boot_id, time.clock_gettime(clock))


@dataclass(frozen=True, slots=True)
class StoredCheckpoints:
    """Checkpoint that an earlier process left behind."""

    has_files: bool
    """True if there were any files, readable or not: an earlier run ended uncleanly."""
    checkpoint: Checkpoint | None
    problems: tuple[str, ...] = ()
    """Problems of files that could not be used, a line each."""


class CheckpointStore:
    """Checkpoint files of one vehicle link; their directory is created on the first save."""

    def __init__(self, directory: Path, name: str) -> None:
        self.paths = tuple(directory / f"{name}.checkpoint-{number}" for number in (0, 1))
        self.writer: BackgroundReplacer | None = None
        """Writer thread; None until something is saved."""

    def load(self) -> StoredCheckpoints:
        """Return the newest valid checkpoint; never raises."""
        found: list[Checkpoint] = []
        problems: list[str] = []
        has_files = False
        for path in self.paths:
            try:
                with open_file(path) as file:
                    has_files = True
                    found.append(decode_checkpoint(file.read(MAX_BYTES + 1)))
            except FileNotFoundError:
                continue
            except OSError as error:
                has_files = True
                problems.append(f"{path}: cannot be read ({error.strerror})")
            except CheckpointError as error:
                problems.append(f"{path}: {error}")
        newest = max(found, key=lambda checkpoint: checkpoint.sequence, default=None)
        return StoredCheckpoints(has_files, newest, tuple(problems))

    def save(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint in place of the older one, soon; never waits and never raises."""
        if self.writer is None:
            self._begin()
        if self.writer is not None:
            path = self.paths[checkpoint.sequence % 2]
            self.writer.replace(path, encode_checkpoint(checkpoint))

    def discard(self) -> None:
        """Delete both files, because the mission ended in order; nothing is saved after it."""
        if self.writer is not None:
            self.writer.is_wanted = False
        for path in self.paths:
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def close(self, timeout_s: float) -> None:
        """Write everything queued within `timeout_s`."""
        if self.writer is not None:
            self.writer.close(timeout_s)

    def _begin(self) -> None:
        directory = self.paths[0].parent
        with suppress(OSError):  # the writer warns, once
            directory.mkdir(parents=True, exist_ok=True)
        for path in self.paths:
            with suppress(OSError):
                for leftover in directory.glob(f".{path.name}.*.tmp"):
                    if leftover.name != f".{path.name}.{os.getpid()}.tmp":
                        leftover.unlink(missing_ok=True)
        self.writer = BackgroundReplacer("write checkpoint", MODE)


FILE = "radio-offsets.json"
BY_ID = Path("/dev/serial/by-id")


class KeptOffset(msgspec.Struct, frozen=True, kw_only=True):
    """Range offset that a calibration next to the antenna found."""

    range_offset_m: float
    scatter_m: float
    ranges: int
    unix_s: float


def radio_key(name: str, url: str, by_id: Path = BY_ID) -> str:
    """Return name and serial number of a radio; without a serial number, name and address."""
    device = url.removeprefix("serial:").partition(":")[0]
    try:
        links = sorted(by_id.iterdir())
    except OSError:
        links = []
    if device.startswith("/"):
        real = os.path.realpath(device)
        for link in links:
            if os.path.realpath(link) == real:
                return f"{name} {link.name}"
    return f"{name} {url}"


def kept_offsets(directory: Path) -> dict[str, KeptOffset]:
    """Return all kept offsets; a `ConfigError` names a file that cannot be read."""
    path = directory / FILE
    try:
        return msgspec.json.decode(read_bytes(path), type=dict[str, KeptOffset])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path}: {decoding_problem(error)}; delete it and calibrate again"
        ) from None


def keep_offset(directory: Path, key: str, offset: KeptOffset) -> Path:
    """Add or replace a radio's offset; return the file. `CompanionError`: it cannot be kept."""
    offsets: Mapping[str, KeptOffset] = {**kept_offsets(directory), key: offset}
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CompanionError(f"{directory}: cannot be created ({error.strerror})") from None
    path = directory / FILE
    write_json_atomic(path, {name: msgspec.structs.asdict(each) for name, each in offsets.items()})
    return path
