"""Child processes that never outlive this one, free UDP ports for them, and a clock they share.

Theory of operation of the clock of a simulated flight, which waits for each of its processes.
`time.monotonic` is the same for all processes of a machine. One of them, the pacer, keeps in a file
which flight time belongs to a monotonic time, and the rate from there; it updates both whenever it
wakes up, and every process derives the flight time from them. The others note in the file when they
last woke up.

Flight time runs at `speed` while every process keeps up. As soon as one is overdue, by `LEEWAY_S`
of flight, it stands still: for the pacer because it sees the delay, for the others because what it
wrote is valid for no longer than that. So a process that waits for the processor loses no more of
the flight than the leeway. If this happens repeatedly, the machine is too slow for `speed`: the
pacer halves it, down to real time.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

from companion.errors import CompanionError
from companion.io.shell import Clock

HOST = "127.0.0.1"
START_S = 900.0
"""Real time in which a process must have started: the first one compiles for a minute of processor
time, and on a busy machine gets an eighth of a core."""
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


VARIABLE = "COMPANION_SHARED_CLOCK"
"""Environment variable by which a child process finds the clock: its number and the file."""
LEEWAY_S = 0.2
"""Seconds of flight that a process may be overdue: two of them, one after the other, stay within
the 0.5 s after which PX4 leaves OFFBOARD (it needs setpoints at 2 Hz)."""
WINDOW_S = 2.0
"""Real time over which the speed is judged: one stall of half a second does not change it."""
MIN_SHARE = 0.75
"""Share of `speed` below which the rate that was reached is nearer to half of it."""
ASLEEP_AFTER_S = 5.0
"""Real time after which a process that does not wake up has ended, and is not waited for."""
PEERS = 2
_ANCHOR = struct.Struct("<5d")
"""Monotonic time, flight time, rate, speed; their sum shows that all is from one write."""
_WOKEN = struct.Struct(f"<{PEERS}d")


class SharedClock(Clock):
    """Clock of every process but the pacer, at its speed; `number` is its slot in the file."""

    def __init__(self, path: Path, number: int) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _ANCHOR.size + _WOKEN.size)
        self._number = number
        super().__init__()

    def restart(self) -> None:
        """Start again at zero."""
        self._zero_s, self._latest_s = self._flight_s(time.monotonic()), 0.0

    def now_s(self) -> float:
        """Return the flight seconds since this clock was started; never decreases."""
        wall_s = time.monotonic()
        struct.pack_into("<d", self._memory, _ANCHOR.size + 8 * self._number, wall_s)
        return self._counted_s(self._flight_s(wall_s))

    def delay_s(self, until_s: float) -> float:
        """Wall seconds until this clock may show `until_s`, at most the leeway.

        The process is not noted as awake by this, only by reading the time.
        """
        left_s = until_s - (self._flight_s(time.monotonic()) - self._zero_s)
        return min(max(0.0, left_s), LEEWAY_S / 2.0) / self.speed

    def _counted_s(self, flight_s: float) -> float:
        self._latest_s = max(self._latest_s, flight_s - self._zero_s)
        return self._latest_s

    def _flight_s(self, wall_s: float) -> float:
        """Return the flight time from the pacer's last entry, which is valid for the leeway."""
        since_s, flight_s, rate, self.speed = self._anchor()
        return flight_s + rate * min(max(0.0, wall_s - since_s), LEEWAY_S / self.speed)

    def _anchor(self) -> tuple[float, float, float, float]:
        while True:  # writing takes the pacer no time
            since_s, flight_s, rate, speed, total = _ANCHOR.unpack_from(self._memory)
            if since_s + flight_s + rate + speed == total:
                return since_s, flight_s, rate, speed


class Pacer(SharedClock):
    """Clock of the process that starts the others; it creates the file at `path`.

    `speed` is lowered to what the machine keeps up with, but not below real time.
    """

    def __init__(self, path: Path, speed: float) -> None:
        self._path = path
        path.write_bytes(_anchored(time.monotonic(), 0.0, 0.0, speed) + bytes(_WOKEN.size))
        self._is_behind = False
        super().__init__(path, PEERS)

    @property
    def pace(self) -> str:
        """Return the text of the speed that the machine keeps up with."""
        return f"{'less than ' if self._is_behind else ''}{self.speed:g}x"

    def environment(self, number: int) -> dict[str, str]:
        """Return the environment variable that gives a child process this clock as `number`."""
        return {VARIABLE: f"{number}:{self._path}"}

    def restart(self) -> None:
        """Start again at zero, and assess the speed from now on."""
        super().restart()
        self._judged_s = (time.monotonic(), self._zero_s)

    def now_s(self) -> float:
        """Return the flight seconds since this clock was started; updates its entry in the file."""
        wall_s = time.monotonic()
        flight_s = self._flight_s(wall_s)
        self._judge(wall_s, flight_s)
        woken_s = _WOKEN.unpack_from(self._memory, _ANCHOR.size)
        asleep_s = [wall_s - at_s for at_s in woken_s if at_s > wall_s - ASLEEP_AFTER_S]
        is_overdue = max(asleep_s, default=0.0) > LEEWAY_S / self.speed
        rate = 0.0 if is_overdue else self.speed
        self._memory[: _ANCHOR.size] = _anchored(wall_s, flight_s, rate, self.speed)
        return self._counted_s(flight_s)

    def exclude_others(self) -> None:
        """Exclude all other processes from the waiting until they wake up again."""
        _WOKEN.pack_into(self._memory, _ANCHOR.size, *[0.0] * PEERS)

    def _judge(self, wall_s: float, flight_s: float) -> None:
        since_s, from_s = self._judged_s
        if wall_s - since_s < WINDOW_S:
            return
        if flight_s - from_s < MIN_SHARE * self.speed * (wall_s - since_s):
            slower = max(min(1.0, self.speed), self.speed / 2.0)
            self.speed, self._is_behind = slower, slower == self.speed
        self._judged_s = (wall_s, flight_s)


def _anchored(wall_s: float, flight_s: float, rate: float, speed: float) -> bytes:
    return _ANCHOR.pack(wall_s, flight_s, rate, speed, wall_s + flight_s + rate + speed)


def clock_of(speed: float) -> Clock:
    """Return the clock that the parent process shares with this one, or a new one at `speed`."""
    number, _, path = os.environ.get(VARIABLE, "").partition(":")
    return SharedClock(Path(path), int(number)) if path else Clock(speed)
