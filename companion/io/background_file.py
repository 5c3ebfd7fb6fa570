"""A file that is appended to without ever making the caller wait.

Records go through a bounded queue to a daemon thread. A full queue (a stalled disk) and a failed
write (a full one) cost records, which are counted, and never an exception or a pause of the
caller. A record is written whole or not at all: after a partial write the file is cut back, so
that one bad moment does not spoil what is recorded after it.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from contextlib import suppress
from pathlib import Path

from companion.errors import CompanionError

logger = logging.getLogger("companion.io")

MAX_QUEUED = 10_000
MAX_BATCH = 256
SYNC_PERIOD_S = 1.0
CLOSE_TIMEOUT_S = 1.0


class BackgroundFile:
    """An append-only file with a writer thread.

    Args:
        path: The file; its directory exists.

    Raises:
        CompanionError: It cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._queue: queue.Queue[bytes | None] = queue.Queue(MAX_QUEUED)
        self._overflowed = 0
        self._failed = 0
        self._has_warned = False
        self._is_closed = False
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise CompanionError(
                f"{path}: cannot be opened ({error.strerror}); choose another place for the log"
            ) from error
        self._thread = threading.Thread(target=self._run, name=f"write {path.name}", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Records lost so far, to a full queue or a failed write."""
        return self._overflowed + self._failed

    def append(self, record: bytes) -> None:
        """Queue a record; counted instead if the queue is full or the file closed."""
        if self._is_closed:
            self._overflowed += 1
            return
        try:
            self._queue.put_nowait(record)
        except queue.Full:
            self._overflowed += 1
            if self._overflowed == 1:
                logger.warning("%s: the disk is too slow, records are lost", self.path)

    def close(self) -> None:
        """Write what is queued, for one second at most, and close; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        deadline_s = time.monotonic() + CLOSE_TIMEOUT_S
        with suppress(queue.Full):
            self._queue.put(None, timeout=CLOSE_TIMEOUT_S)
        self._thread.join(max(0.0, deadline_s - time.monotonic()))
        if self._thread.is_alive():
            logger.warning("%s: the disk hangs, the end of the log is lost", self.path)

    def _run(self) -> None:
        synced_s = time.monotonic()
        is_last = False
        while not is_last:
            batch, is_last = self._next_batch()
            self._write(batch)
            if is_last or time.monotonic() - synced_s >= SYNC_PERIOD_S:
                with suppress(OSError):  # pipes and devices cannot be synced
                    os.fsync(self._fd)
                synced_s = time.monotonic()
        os.close(self._fd)

    def _next_batch(self) -> tuple[list[bytes], bool]:
        """At least one record, waiting for it, and whether the file is to be closed after it."""
        batch: list[bytes] = []
        item = self._queue.get()
        while item is not None:
            batch.append(item)
            if len(batch) == MAX_BATCH:
                return batch, False
            try:
                item = self._queue.get_nowait()
            except queue.Empty:
                return batch, False
        return batch, True

    def _write(self, batch: list[bytes]) -> None:
        joined = b"".join(batch)
        if not joined or self._write_whole(joined):
            return
        # Something is wrong with the disk: save of the batch what can be saved.
        for record in batch:
            if not self._write_whole(record):
                self._failed += 1

    def _write_whole(self, data: bytes) -> bool:
        """Whether all of `data` was written; the file is as before if not."""
        done = 0
        try:
            while done < len(data):
                done += os.write(self._fd, data[done:])
        except OSError as error:
            if done:
                with suppress(OSError):
                    os.ftruncate(self._fd, os.fstat(self._fd).st_size - done)
            if not self._has_warned:
                self._has_warned = True
                logger.warning("%s: cannot be written (%s), records are lost", self.path, error)
            return False
        return True


class BackgroundLog:
    """What the flight's logs share: a file that never makes the caller wait.

    Args:
        path: The file; its directory exists. An existing one is continued.

    Raises:
        CompanionError: The file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = BackgroundFile(path)

    @property
    def dropped(self) -> int:
        """Entries lost to a slow or full disk."""
        return self._file.dropped

    def close(self) -> None:
        """Write what is queued, for one second at most, and close."""
        self._file.close()
