"""Checkpoints on disk: two files by turns, so that one whole one is there at any moment.

A checkpoint replaces the older of the two (`files.write_bytes_atomic`, in a thread of its own), so
that neither a power cut nor a kill can cost both. A reader takes the newest that is whole.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from companion.io.background_replace import BackgroundReplacer
from companion.io.checkpoint import (
    MAX_BYTES,
    Checkpoint,
    CheckpointError,
    Moment,
    decode_checkpoint,
    encode_checkpoint,
)

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
MODE = 0o600
"""It says where the vehicle was."""


def present_moment() -> Moment:
    """Now, for comparison across restarts."""
    boot_id = ""
    with suppress(OSError):
        boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return Moment(time.time(), boot_id, time.clock_gettime(clock))


@dataclass(frozen=True, slots=True)
class Found:
    """What an earlier process left behind."""

    has_files: bool
    """Whether there was anything, readable or not: then an earlier run did not end in order."""
    checkpoint: Checkpoint | None
    """The newest whole one."""
    problems: tuple[str, ...] = ()
    """Of files that could not be used, a line each."""


class CheckpointStore:
    """The two files of one vehicle's link.

    Args:
        directory: The state directory; made when something is saved.
        name: Of the files, without suffix; see `lock.lock_name`.
    """

    def __init__(self, directory: Path, name: str) -> None:
        self.paths = tuple(directory / f"{name}.checkpoint-{number}" for number in (0, 1))
        self._writer: BackgroundReplacer | None = None

    def load(self) -> Found:
        """What is there; never raises."""
        found: list[Checkpoint] = []
        problems: list[str] = []
        has_files = False
        for path in self.paths:
            try:
                with path.open("rb") as file:
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
        return Found(has_files, newest, tuple(problems))

    @property
    def writer(self) -> BackgroundReplacer | None:
        """Who writes, once something was saved."""
        return self._writer

    def save(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint in place of the older one, soon; never waits and never raises."""
        if self._writer is None:
            self._begin()
        if self._writer is not None:
            path = self.paths[checkpoint.sequence % 2]
            self._writer.replace(path, encode_checkpoint(checkpoint))

    def discard(self) -> None:
        """Delete both, because the mission ended in order; `close` comes first."""
        for path in self.paths:
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def close(self, timeout_s: float) -> None:
        """Write what waits, for so long at most."""
        if self._writer is not None:
            self._writer.close(timeout_s)

    def _begin(self) -> None:
        directory = self.paths[0].parent
        with suppress(OSError):  # the writer tells what is wrong, once
            directory.mkdir(parents=True, exist_ok=True)
        self._sweep(directory)
        self._writer = BackgroundReplacer("write checkpoint", MODE)

    def _sweep(self, directory: Path) -> None:
        """Delete what a killed writer left half-done."""
        for path in self.paths:
            with suppress(OSError):
                for leftover in directory.glob(f".{path.name}.*.tmp"):
                    if leftover.name != f".{path.name}.{os.getpid()}.tmp":
                        leftover.unlink(missing_ok=True)
