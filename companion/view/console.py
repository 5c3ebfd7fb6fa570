"""The flight as log lines on standard error, without ever waiting for their reader.

A terminal that was stopped (Ctrl-S), a pipe that nobody reads and a journal daemon that hangs all
block a write for good. Lines therefore go through a bounded queue to a daemon thread; what does
not fit is counted, and told with the next line that does.

Where the output is no terminal, the flight is a line now and then.
"""

from __future__ import annotations

import io
import logging
import math
import os
import queue
import threading
from contextlib import suppress
from typing import TextIO

from companion.guidance.authority.state_machine import HAS_VEHICLE, Phase
from companion.guidance.session import GuidanceStatus
from companion.link.endpoint import CompanionEndpoint
from companion.link.recorders import Journal

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


log = logging.getLogger("companion.view")

PERIOD_S = 15.0
"""Seconds of the flight between two lines."""
TOLD_PHASES = HAS_VEHICLE | {Phase.LAUNCHING}
"""On the ground whatever happens has a text of its own, and a log must not grow for nothing."""


def plain_line(status: GuidanceStatus) -> str:
    """A flight in one line."""
    line = f"{status.time_s:7.1f} s  {status.phase.value}, flown {status.distance_m:.0f} m"
    if status.estimate is not None:
        line += f", {status.estimate.state.value} R95 {status.estimate.r95_m:.1f} m"
    return line


class PlainView:
    """Logs the lines of one flight; a `companion.run.FlightView`."""

    def __init__(self) -> None:
        self._next_s = -math.inf

    def listen(self, journal: Journal) -> Journal:
        """Texts are log lines already."""
        return journal

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Log a line, if it is time."""
        if now_s < self._next_s or endpoint.session.phase not in TOLD_PHASES:
            return
        self._next_s = now_s + PERIOD_S
        log.info("%s", plain_line(endpoint.session.status(now_s)))

    def close(self) -> None:
        """There is nothing to close."""
