"""Lines for people on standard error, without ever making the flight wait for its reader.

A terminal that was stopped (Ctrl-S), a pipe that nobody reads and a journal daemon that hangs all
block a write for good. Lines therefore go through a bounded queue to a daemon thread; what does
not fit is counted, and told with the next line that does.
"""

from __future__ import annotations

import io
import logging
import os
import queue
import threading
from contextlib import suppress
from typing import TextIO

MAX_QUEUED = 1000
CLOSE_TIMEOUT_S = 0.3


class ConsoleHandler(logging.Handler):
    """Hands log lines to a writer thread.

    Args:
        stream: Where the lines go. One with a descriptor is written past its own buffer, whose
            lock a writer that hangs would otherwise keep through the end of the process.
    """

    def __init__(self, stream: TextIO | io.TextIOBase) -> None:
        super().__init__()
        self.dropped = 0
        self._told = 0
        self._stream = stream
        try:
            self._fd: int | None = stream.fileno()
        except (io.UnsupportedOperation, ValueError, AttributeError):
            self._fd = None
        self._queue: queue.Queue[str | None] = queue.Queue(MAX_QUEUED)
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a line; counted instead if the queue is full."""
        try:
            line = self.format(record)
            if self.dropped > self._told:
                line = f"({self.dropped - self._told} lines were lost here)\n{line}"
            self._queue.put_nowait(line)
            self._told = self.dropped
        except queue.Full:
            self.dropped += 1
        except Exception:  # the same as the standard handlers: a bad record is no reason to fall
            self.handleError(record)

    def close(self) -> None:
        """Write what is queued, for a moment at most."""
        with suppress(queue.Full):
            self._queue.put_nowait(None)
        self._thread.join(CLOSE_TIMEOUT_S)
        super().close()

    def _run(self) -> None:
        while True:
            line = self._queue.get()
            if line is None:
                return
            with suppress(OSError, ValueError):  # nobody reads: then there is nobody to tell
                self._write(f"{line}\n")

    def _write(self, text: str) -> None:
        if self._fd is None:
            self._stream.write(text)
            self._stream.flush()
            return
        data = text.encode("utf-8", errors="backslashreplace")
        while data:
            data = data[os.write(self._fd, data) :]
