"""Processes of a mission: each ends with this one, whatever ends it."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from companion.errors import CompanionError

LOGS = "*/events.jsonl"
STOP_S = 5.0
"""Real time that a process may take to end after SIGTERM."""


class Child:
    """One process with its own session, whose output goes to a file.

    Args:
        name: What people call it.
        arguments: The module and its arguments, run with this interpreter.
        log: Where its output goes.
    """

    def __init__(self, name: str, arguments: Sequence[str], log: Path) -> None:
        self.name = name
        self._arguments = [sys.executable, *arguments]
        self._log = log
        self._has_begun = False
        self._file: TextIO | None = None
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it, or start it again.

        Raises:
            CompanionError: It cannot be started.
        """
        # what an earlier mission left there was said by another one
        self._file = self._log.open("a" if self._has_begun else "w", encoding="utf-8")
        self._has_begun = True
        try:
            self._process = subprocess.Popen(
                self._arguments,
                stdin=subprocess.PIPE,
                stdout=self._file,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        except OSError as error:
            raise CompanionError(f"{self.name} cannot be started ({error.strerror})") from error

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def first_words(self) -> str:
        """The first line of its output; empty: it has said nothing yet."""
        return next(iter(self._lines()), "")

    @property
    def last_words(self) -> str:
        """The last line of its output."""
        return next(iter(self._lines()[::-1]), "")

    def _lines(self) -> list[str]:
        try:
            return self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return []

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        process = self._process
        if process is not None and process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                process.stdin.write(f"{line}\n")
                process.stdin.flush()

    def signal(self, number: int) -> None:
        """Send it a signal; nothing happens to one that ended."""
        if self._process is not None and self._process.poll() is None:
            os.kill(self._process.pid, number)

    def stop(self) -> None:
        """End it, at the latest by force; a second call does nothing."""
        process, self._process = self._process, None
        if process is not None:
            if process.poll() is None:
                process.terminate()
            try:
                process.communicate(timeout=STOP_S)
            except (subprocess.TimeoutExpired, ValueError):
                process.kill()
                process.wait()
        if self._file is not None:
            self._file.close()


class EventTail:
    """Reads the companion's event log while it is being written.

    Args:
        root: Where the companion makes the folder of its flight.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._seen = set(root.glob(LOGS))
        """What an earlier mission may have left there, and what was read."""
        self._path: Path | None = None
        self._offset = 0
        self._rest = b""

    def look_for_flight(self) -> bool:
        """Whether a flight that was not there before has begun; it is the one that is read."""
        for path in sorted(self._root.glob(LOGS)):
            if path not in self._seen:
                self._seen.add(path)
                self._path, self._offset, self._rest = path, 0, b""
                return True
        return False

    @property
    def flight(self) -> Path | None:
        """The folder of the flight."""
        return None if self._path is None else self._path.parent

    def take(self) -> list[dict[str, Any]]:
        """The events since the last call; a line that is not whole yet waits."""
        if self._path is None:
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines if line]
