"""Log lines on standard error, without ever waiting for their reader.

A stopped terminal (Ctrl-S), a pipe without a reader and a journal daemon that hangs all block a
write for good. Lines therefore go through a bounded queue to a daemon thread; lines that do not fit
are counted, and reported with the next line that does.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from contextlib import suppress
from typing import TextIO

from companion.errors import printable
from companion.io.files import WriterThread
from companion.io.links.link import NOTICE

MAX_QUEUED = 1000
CLOSE_TIMEOUT_S = 0.3


class _LineWriter(WriterThread[str]):
    """Writes lines bypassing the stream's buffer, whose lock a hanging writer would keep."""

    def __init__(self, stream: TextIO | io.TextIOBase) -> None:
        self._stream = stream
        try:
            self._fd: int | None = stream.fileno()
        except (io.UnsupportedOperation, ValueError, AttributeError):
            self._fd = None
        super().__init__("console", MAX_QUEUED)

    def write_batch(self, batch: list[str]) -> None:
        """Write lines, and drop those that the stream refuses."""
        for line in batch:
            with suppress(OSError, ValueError):  # without a reader the line is lost
                self._write(f"{line}\n")

    def _write(self, text: str) -> None:
        if self._fd is None:
            self._stream.write(text)
            self._stream.flush()
            return
        data = text.encode("utf-8", errors="backslashreplace")
        while data:
            data = data[os.write(self._fd, data) :]


class ConsoleHandler(logging.Handler):
    """Passes log lines to a writer thread."""

    def __init__(self, stream: TextIO | io.TextIOBase) -> None:
        super().__init__()
        self.writer = _LineWriter(stream)
        self._reported = 0
        """Number of lost lines that the log has mentioned."""

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a line; count it instead if the queue is full."""
        try:
            line = printable(self.format(record))
            dropped = self.writer.dropped
            if dropped > self._reported:
                line = f"({dropped - self._reported} lines were lost here)\n{line}"
            if self.writer.append(line):
                self._reported = dropped
        except Exception:  # like the standard handlers: a bad record must not end the flight
            self.handleError(record)

    def close(self) -> None:
        """Write queued lines, for a moment at most."""
        self.writer.close(CLOSE_TIMEOUT_S)
        super().close()


def set_up_logging(*, quiet: bool, stream: io.TextIOBase | None = None) -> None:
    """Configure our own loggers only: libraries stay silent."""
    logger = logging.getLogger("companion")
    handler = ConsoleHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger.handlers = [handler]
    logger.setLevel(NOTICE if quiet else logging.INFO)
    logger.propagate = False
