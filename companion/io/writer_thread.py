"""A bounded queue that a daemon thread empties, so that the caller never waits.

A full queue (a disk, a terminal or a pipe that hangs) loses items, which are counted, and never
raises or blocks the caller.
"""

from __future__ import annotations

import queue
import threading
import time
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_BATCH = 1024
"""Limit of a batch: a second of the busiest autopilot link, 405 frames, fits."""
CLOSE_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class WriterHealth:
    """State of one writer, or of several together."""

    queued: int
    dropped: int
    """Items lost so far, to a full queue or a failed write."""
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
        if self.overflowed == 1 and not self._is_closed:
            self.note_overflow()
        return False

    def finish(self) -> None:
        """Ask the thread to write what is queued and end; does not wait, see `close`."""
        if self._is_closed:
            return
        self._is_closed = True
        self._is_ending.set()
        self._queue.put(None)

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write what is queued within `timeout_s`; return True if all of it was written."""
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
