"""Files read or replaced as a whole, names of flight files, and threads that write output.

`WriterThread` empties a bounded queue. A full one (a disk, a terminal or a pipe that hangs) loses
items, which are counted, and never raises or blocks the caller.

An appended record is written whole or not at all: a partial write is cut back. At half its cap a
file becomes `NAME.old.SUFFIX`, replacing the previous one; a reader joins that with the new one.

Of several contents waiting to replace one file only the newest is written, so that a slow disk
costs history and never memory. A failure is counted, reported once, and retried only with the next.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import math
import os
import queue
import stat
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from select import select
from typing import BinaryIO, Generic, TypeVar

from companion.errors import CompanionError, ConfigError

T = TypeVar("T")
OnDamage = Callable[[int], None]
"""Called with each damaged position of a log: a byte, a record or a line of it."""


def plain(value: object) -> object:
    """Return `value` in JSON's own types: NaN and infinity become None, enums their value.

    Dataclasses become objects, arrays lists, and anything that JSON has no type for its text.
    """
    if isinstance(value, Enum):
        return plain(value.value)
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "tolist"):  # numpy's scalars and arrays, without importing numpy
        return plain(value.tolist())
    return str(value)


_LINES = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=plain)


def json_line(value: object) -> bytes:
    """Return `plain(value)` as one line of ASCII JSON, without the newline."""
    try:  # most values are plain already, down to every number
        return _LINES.encode(value).encode("ascii")
    except (ValueError, TypeError):
        return _LINES.encode(plain(value)).encode("ascii")


MAX_PIPED_BYTES = 100_000_000
"""Size from which a pipe counts as endless; chosen: in memory, a tenth of a Raspberry Pi's 1 GB."""
MAX_SILENCE_S = 60.0
"""Longest wait for a pipe's next bytes; chosen: its program may ask for a passphrase first."""
_AT_ONCE = os.O_NONBLOCK | os.O_NOCTTY


def open_file(path: Path) -> BinaryIO:
    """Open an input file that is read whole.

    A pipe with a writer, as of a process substitution, is read to its end first. Raises an
    `OSError` also for a pipe without one, or that stays silent, and for a device.
    """
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _AT_ONCE))  # noqa: SIM115
    mode = os.fstat(file.fileno()).st_mode
    if stat.S_ISREG(mode):
        return file
    with file:
        content = file.raw.read(MAX_BATCH)  # None: nothing yet, of a writer or a line
        if stat.S_ISCHR(mode) and content == b"":
            return io.BytesIO()  # the null device
        if not stat.S_ISFIFO(mode):
            raise OSError(errno.EINVAL, "a device; give a file")
        if content == b"":
            raise OSError(errno.EPIPE, "a pipe that nothing is written to; give a file")
        whole = bytearray(content or b"")
        while select([file], [], [], MAX_SILENCE_S)[0]:
            if not (more := file.raw.read(MAX_BATCH)):
                return io.BytesIO(whole)
            whole += more
            if len(whole) > MAX_PIPED_BYTES:
                raise OSError(errno.EFBIG, "a pipe without an end; save it as a file")
        raise OSError(errno.ETIMEDOUT, "a pipe that was silent for a minute; give a file")


def read_bytes(path: Path) -> bytes:
    """Return the content of a file; raises the errors of `open_file`."""
    with open_file(path) as file:
        return file.read()


def read_file(path: Path) -> bytes:
    """Return the content of a file; raises a `ConfigError` if it cannot be read."""
    try:
        return read_bytes(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error


def write_json_atomic(path: Path, value: object) -> None:
    """Replace a JSON file as a whole; see `write_bytes_atomic`."""
    write_text_atomic(path, json.dumps(plain(value), allow_nan=False, indent=2) + "\n")


def write_text_atomic(path: Path, text: str, mode: int = 0o666) -> None:
    """Replace a text file as a whole; see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode(), mode)


def write_bytes_atomic(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file as a whole: after a power cut there is either the old or the new content.

    `mode` is its permission bits before the umask; a device or a pipe is written to. Raises a
    `CompanionError` if it cannot be written; an old file is still there then.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        if str(path.parent) in ("/dev", "/dev/fd") or (path.exists() and not path.is_file()):
            path.write_bytes(content)
            return
        temporary.unlink(missing_ok=True)
        with open(temporary, "wb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        text = f"{path}: cannot be written ({error.strerror}); check the disk and its permissions"
        raise CompanionError(text) from error
    finally:
        with suppress(OSError):  # on a disk that went read-only the temporary file stays
            temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Check before long work that its output can be written; raises a `CompanionError` if not."""
    if path.is_dir() or not path.name:
        raise CompanionError(f"{path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise CompanionError(f"{path}: there is no folder {path.parent}")
    is_device = str(path.parent) in ("/dev", "/dev/fd") or (path.exists() and not path.is_file())
    if not os.access(path if is_device else path.parent, os.W_OK):
        raise CompanionError(f"{path}: cannot be written; check its permissions")


TLOG, MCAP, EVENTS, INPUTS = "flight.tlog", "flight.mcap", "events.jsonl", "flight.inputs"
FLIGHT, RESULT, REPORT = "flight.json", "result.json", "report.html"

MAX_BATCH = 1024
"""Limit of a batch; a second of the busiest autopilot link has 405 frames."""
CLOSE_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class WriterHealth:
    """State of one writer, or of several together."""

    queued: int
    dropped: int
    bytes_kept: int
    """Bytes on disk, older parts included."""
    silent_s: float
    """Time for which the disk has not answered; 0 while nothing is being written."""
    is_alive: bool


class WriterThread(Generic[T]):
    """The queue and its thread; a subclass writes the items in `write_batch`.

    A subclass must be fully constructed before it calls this constructor, which starts the thread.
    Items are written `gather_s` later, many at a time.
    """

    def __init__(self, name: str, max_queued: int, gather_s: float = 0.0) -> None:
        self.bytes_kept = 0
        self.overflowed = 0
        self.failed = 0
        self.lost_since_s: float | None = None
        """Monotonic time of the first loss."""
        self._gather_s = gather_s
        self._max_queued = max_queued
        self._queue: queue.SimpleQueue[T | None] = queue.SimpleQueue()
        self._is_closed = False
        self._is_ending = threading.Event()
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def write_batch(self, batch: list[T]) -> None:
        """Write some items; runs on the thread and must not raise."""
        raise NotImplementedError

    def end(self) -> None:
        """Release resources; called last on the thread."""

    def note_overflow(self) -> None:
        """Report the first item that is lost to a full queue."""

    @property
    def dropped(self) -> int:
        """Number of items lost so far, to a full queue or a failed write."""
        return self.overflowed + self.failed

    @property
    def health(self) -> WriterHealth:
        """Return the state of the writer without waiting for the thread."""
        since_s = self._busy_since_s
        return WriterHealth(
            queued=self._queue.qsize(),
            dropped=self.dropped,
            bytes_kept=self.bytes_kept,
            silent_s=0.0 if since_s is None else time.monotonic() - since_s,
            is_alive=self._thread.is_alive(),
        )

    def append(self, item: T) -> bool:
        """Queue an item and return True; it is counted as lost if the queue is full or closed."""
        if not self._is_closed and self._queue.qsize() < self._max_queued:
            self._queue.put(item)
            return True
        self.overflowed += 1
        self.lost_since_s = self.lost_since_s or time.monotonic()
        if self.overflowed == 1 and not self._is_closed:
            self.note_overflow()
        return False

    def finish(self) -> None:
        """Ask the thread to write everything queued and end, without waiting; see `close`."""
        if not self._is_closed:
            self._is_closed = True
            self._is_ending.set()
            self._queue.put(None)

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write everything queued within `timeout_s`; return True on success."""
        self.finish()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        is_last = False
        while not is_last:
            batch, is_last = self._next_batch()
            self._busy_since_s = time.monotonic()
            if batch:
                self.write_batch(batch)
            if is_last:
                self.end()
            self._busy_since_s = None

    def _next_batch(self) -> tuple[list[T], bool]:
        """Wait for items; return them, and True if the end was requested."""
        batch: list[T] = []
        item = self._queue.get()
        if self._gather_s and self._queue.qsize() < MAX_BATCH:
            self._is_ending.wait(self._gather_s)
        while item is not None:
            batch.append(item)
            if len(batch) == MAX_BATCH or self._queue.empty():
                return batch, False
            item = self._queue.get()
        return batch, True


logger = logging.getLogger("companion.io")

MAX_QUEUED = 10_000
SYNC_PERIOD_S = 1.0
GATHER_S = SYNC_PERIOD_S
"""Time for which records are gathered: their thread seldom interrupts the control tick."""
_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC


class BackgroundFile(WriterThread[bytes]):
    """Append-only file with a writer thread; an existing file is continued.

    `max_bytes` caps the file and its older part together; None means no cap. Raises a
    `CompanionError` if the file cannot be opened.
    """

    def __init__(self, path: Path, max_bytes: int | None = None) -> None:
        self.path = path
        self.older_path = path.with_name(f"{path.stem}.old{path.suffix}")
        self._part_bytes = None if max_bytes is None else max(1, max_bytes // 2)
        self._has_warned = False
        self._older_bytes = 0
        self._synced_s = time.monotonic()
        try:
            self._fd = os.open(path, _FLAGS, 0o644)
            self._bytes = os.fstat(self._fd).st_size
        except OSError as error:
            raise CompanionError(
                f"{path}: cannot be opened ({error.strerror}); choose another log.directory"
            ) from error
        super().__init__(f"write {path.name}", MAX_QUEUED, GATHER_S)
        self.bytes_kept = self._bytes

    def note_overflow(self) -> None:
        """Report that the disk is too slow."""
        logger.warning("%s: the disk is too slow, records are lost", self.path)

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write everything queued within `timeout_s`, then close; return True on success."""
        is_written = super().close(timeout_s)
        if not is_written:
            logger.warning("%s: the disk hangs, the end of the log is lost", self.path)
        return is_written

    def write_batch(self, batch: list[bytes]) -> None:
        """Write a batch of records, and sync the file to disk periodically."""
        self._write(batch)
        self.bytes_kept = self._bytes + self._older_bytes
        if time.monotonic() - self._synced_s >= SYNC_PERIOD_S:
            self._sync()

    def end(self) -> None:
        """Sync the file to disk and close it."""
        self._sync()
        os.close(self._fd)

    def _sync(self) -> None:
        with suppress(OSError):  # pipes and devices cannot be synced
            os.fsync(self._fd)
        self._synced_s = time.monotonic()

    def _write(self, batch: list[bytes]) -> None:
        joined = b"".join(batch)
        if not joined or (self._has_room(len(joined)) and self._write_whole(joined)):
            return
        # The part is full, or a write failed: save what can be saved.
        for record in batch:
            if not self._has_room(len(record)):
                self._begin_new_part()
            if not (self._has_room(len(record)) and self._write_whole(record)):
                self.failed += 1
                self.lost_since_s = self.lost_since_s or time.monotonic()

    def _has_room(self, size: int) -> bool:
        return self._part_bytes is None or self._bytes + size <= self._part_bytes

    def _begin_new_part(self) -> None:
        """Rename the full file and begin a new one; if renaming fails, the file stays full."""
        try:
            if self.path.exists():  # not after an earlier attempt that got no further
                self.path.replace(self.older_path)
            descriptor = os.open(self.path, _FLAGS, 0o644)
        except OSError as error:
            self._warn(error)
            return
        os.close(self._fd)
        self._fd, self._older_bytes, self._bytes = descriptor, self._bytes, 0

    def _write_whole(self, data: bytes) -> bool:
        """Return True if all of `data` was written; otherwise the file is left as it was."""
        done = 0
        try:
            while done < len(data):
                done += os.write(self._fd, data[done:])
        except OSError as error:
            if done:
                with suppress(OSError):
                    os.ftruncate(self._fd, os.fstat(self._fd).st_size - done)
            self._warn(error)
            return False
        self._bytes += len(data)
        return True

    def _warn(self, error: OSError) -> None:
        if not self._has_warned:
            self._has_warned = True
            logger.warning("%s: cannot be written (%s), records are lost", self.path, error)


class BackgroundReplacer(WriterThread[Path]):
    """Replaces files from one thread; `mode` is their permission bits before the umask."""

    def __init__(self, name: str, mode: int = 0o666) -> None:
        self.written = 0
        self.overtaken = 0
        """Contents that never reached the disk, because newer ones came first."""
        self.is_wanted = True
        """False: a file that is still being written is deleted as soon as the disk lets it."""
        self._path: Path | None = None
        """File that is being written."""
        self._mode = mode
        self._waiting: dict[Path, bytes] = {}
        self._lock = threading.Lock()
        super().__init__(name, MAX_QUEUED)

    def replace(self, path: Path, content: bytes) -> None:
        """Replace the content of a file soon; after `close` it is counted as lost."""
        with self._lock:
            is_first = path not in self._waiting
            self._waiting[path] = content
        if is_first:
            self.append(path)
        else:
            self.overtaken += 1

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write everything queued within `timeout_s`; a loss is reported."""
        is_written = super().close(timeout_s)
        if not is_written and self.is_wanted and self._path is not None:
            logger.warning("%s: the disk hangs, its last content may be lost", self._path)
        return is_written

    def write_batch(self, batch: list[Path]) -> None:
        """Write the newest content of each file in the batch."""
        for path in batch:
            with self._lock:
                content = self._waiting.pop(path)
            self._path = path
            try:
                write_bytes_atomic(path, content, self._mode)
            except CompanionError as error:
                self.failed += 1
                if self.failed == 1:
                    logger.warning("%s", error)
            else:
                self.written += 1
            if not self.is_wanted:
                with suppress(OSError):
                    path.unlink(missing_ok=True)
