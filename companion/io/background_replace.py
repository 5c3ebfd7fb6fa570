"""Whole files that are replaced without ever making the caller wait.

Each replacement is atomic (see `files.write_bytes_atomic`) and runs in a daemon thread. Of what
waits for one file only the newest content is written, so that a slow disk costs history and never
memory. A failure is counted, told once and tried again only with the next content.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from companion.errors import CompanionError
from companion.io.background_file import CLOSE_TIMEOUT_S
from companion.io.files import write_bytes_atomic

logger = logging.getLogger("companion.io")


class BackgroundReplacer:
    """Replaces files from one thread.

    Args:
        name: Of the thread.
        mode: Who may read and write the files, less the umask.
    """

    def __init__(self, name: str, mode: int = 0o666) -> None:
        self.written = 0
        self.failed = 0
        self.overtaken = 0
        """Contents that never reached the disk, because newer ones came first."""
        self._mode = mode
        self._waiting: dict[Path, bytes] = {}
        self._changed = threading.Condition()
        self._is_closed = False
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether there still is somebody to write."""
        return self._thread.is_alive()

    @property
    def silent_s(self) -> float:
        """How long the disk has not answered; 0 while nothing is being written."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def replace(self, path: Path, content: bytes) -> None:
        """Give a file a new content, soon; after `close` it is counted as failed."""
        with self._changed:
            if self._is_closed:
                self.failed += 1
                return
            self.overtaken += path in self._waiting
            self._waiting[path] = content
            self._changed.notify()

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> None:
        """Write what waits, for so long at most, and end."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if not self._waiting:
                    return
                path = next(iter(self._waiting))
                content = self._waiting.pop(path)
            self._busy_since_s = time.monotonic()
            self._write(path, content)
            self._busy_since_s = None

    def _write(self, path: Path, content: bytes) -> None:
        try:
            write_bytes_atomic(path, content, self._mode)
        except CompanionError as error:
            self.failed += 1
            if self.failed == 1:
                logger.warning("%s", error)
        else:
            self.written += 1
