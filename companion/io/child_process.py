"""Child processes that never outlive this one, and free UDP ports for them."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

from companion.errors import CompanionError

HOST = "127.0.0.1"
START_S = 900.0
"""Real time that a process that lives may take to start: the first one of all compiles for a minute
of processor time, and has an eighth of a core where twelve others want two."""
STOP_S = 5.0
"""Real time that a process may take to end after SIGTERM."""


def free_udp_port() -> int:
    """Return a UDP port of this machine that is free at the moment."""
    return free_udp_ports(1)[0]


def free_udp_ports(count: int) -> list[int]:
    """Return `count` different free UDP ports; each stays taken until all are found."""
    with contextlib.ExitStack() as stack:
        probes = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            for _ in range(count)
        ]
        for probe in probes:
            probe.bind((HOST, 0))
        return [int(probe.getsockname()[1]) for probe in probes]


class ChildProcess:
    """A module run by this interpreter that ends with this process; its output goes to `log`.

    Its standard input is a pipe from this process, and it stops when the pipe closes, so that not
    even a kill -9 of the parent leaves it behind. It runs in a session of its own, so that a Ctrl-C
    at the terminal reaches only the parent, which then stops it in order. `env` is added to the
    environment.
    """

    def __init__(
        self, name: str, arguments: Sequence[str], log: Path, env: Mapping[str, str] | None = None
    ) -> None:
        self.name = name
        self._arguments = [sys.executable, *arguments]
        self._log = log
        self._env = {**os.environ, **(env or {})}
        self._has_begun = False
        self._file: TextIO | None = None
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the process, or start it again; raises a `CompanionError` if that fails."""
        # what an earlier mission left there is not this one's output
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
                env=self._env,
            )
        except OSError as error:
            raise CompanionError(f"{self.name} cannot be started ({error.strerror})") from error

    @property
    def is_alive(self) -> bool:
        """Return True while the process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def first_words(self) -> str:
        """Return the first line of its output; empty if there is none yet."""
        return next(iter(self._lines()), "")

    @property
    def last_words(self) -> str:
        """Return the last line of its output."""
        return next(iter(self._lines()[::-1]), "")

    def _lines(self) -> list[str]:
        try:
            return self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return []

    def write_line(self, line: str) -> None:
        """Write a line to its standard input."""
        process = self._process
        if process is not None and process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                process.stdin.write(f"{line}\n")
                process.stdin.flush()

    def signal(self, number: int) -> None:
        """Send a signal to the process; does nothing if it has ended."""
        if self._process is not None and self._process.poll() is None:
            os.kill(self._process.pid, number)

    def end(self, timeout_s: float) -> int | None:
        """Send SIGTERM and return the exit code, or None if the process had to be killed."""
        process = self._process
        if process is None:
            return None
        process.terminate()
        try:
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return None

    def stop(self, timeout_s: float = STOP_S) -> None:
        """End the process, by force if it must; a second call does nothing."""
        process, self._process = self._process, None
        if process is not None:
            if process.poll() is None:
                process.terminate()
            try:
                process.communicate(timeout=timeout_s)
            except (subprocess.TimeoutExpired, ValueError):
                process.kill()
                process.wait()
        if self._file is not None:
            self._file.close()
