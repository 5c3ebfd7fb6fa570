"""One clock for the processes of a flight faster than real time; it slows where one cannot follow.

Theory of operation. `time.monotonic` is the same for all processes of a machine. One of them, the
pacer, keeps in a file which flight time belongs to a monotonic time, and the rate from there; it
renews both whenever it wakes up, and every process derives the flight time from them. The others
note in the file when they woke up last.

Flight time goes at `speed` only while every process keeps up. As soon as one is overdue, by
`LEEWAY_S` of flight, the rate is 1: of the pacer because what it wrote holds no longer than that,
of the others because the pacer sees it. So a process that waits for its turn loses no more of the
flight than in real time, plus the leeway. A machine on which this happens again and again is too
slow for `speed`: the pacer halves it, down to real time.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from pathlib import Path

from companion.io.shell import Clock

VARIABLE = "COMPANION_SHARED_CLOCK"
"""Environment variable by which a child process finds the clock: its number and the file."""
LEEWAY_S = 0.2
"""Seconds of flight that a process may be overdue: two of them, one after the other, stay within
the 0.5 s after which PX4 leaves OFFBOARD (it needs setpoints at 2 Hz)."""
WINDOW_S = 2.0
"""Real time over which the speed is judged: one stall of half a second does not change it."""
LEAST_SHARE = 0.75
"""Share of `speed` below which the rate that was reached is nearer to half of it."""
PEERS = 2
_ANCHOR = struct.Struct("<5d")
"""Monotonic time, flight time, rate, speed; and their sum, by which a reader sees that all of it
comes from one write."""
_WOKEN = struct.Struct(f"<{PEERS}d")


class SharedClock(Clock):
    """The clock as any process but the pacer has it; `number` is its place among them.

    `speed` is the pacer's present one.
    """

    def __init__(self, path: Path, number: int) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _ANCHOR.size + _WOKEN.size)
        self._number = number
        self._rate = 1.0
        super().__init__()

    def restart(self) -> None:
        """Count from now."""
        self._zero_s, self._latest_s = self._flight_s(time.monotonic()), 0.0

    def now_s(self) -> float:
        """Seconds of flight since this clock was started; never goes back."""
        wall_s = time.monotonic()
        struct.pack_into("<d", self._memory, _ANCHOR.size + 8 * self._number, wall_s)
        return self._counted_s(self._flight_s(wall_s))

    def delay_s(self, until_s: float) -> float:
        """Wall seconds until this clock shows `until_s`, at the present rate."""
        return max(0.0, (until_s - self.now_s()) / self._rate)

    def _counted_s(self, flight_s: float) -> float:
        self._latest_s = max(self._latest_s, flight_s - self._zero_s)
        return self._latest_s

    def _flight_s(self, wall_s: float) -> float:
        """Flight time by what the pacer wrote last, which goes on in real time after the leeway."""
        since_s, flight_s, self._rate, self.speed = self._anchor()
        passed_s, leeway_s = max(0.0, wall_s - since_s), LEEWAY_S / self.speed
        if passed_s <= leeway_s:
            return flight_s + passed_s * self._rate
        flight_s += leeway_s * self._rate
        self._rate = _floor(self.speed)
        return flight_s + (passed_s - leeway_s) * self._rate

    def _anchor(self) -> tuple[float, float, float, float]:
        while True:  # writing takes the pacer no time
            since_s, flight_s, rate, speed, total = _ANCHOR.unpack_from(self._memory)
            if since_s + flight_s + rate + speed == total:
                return since_s, flight_s, rate, speed


class Pacer(SharedClock):
    """The clock of the process that starts the others, and makes the file at `path`.

    `speed` is lowered to what the machine keeps up with, but not below 1.
    """

    def __init__(self, path: Path, speed: float) -> None:
        self._path = path
        path.write_bytes(_anchored(time.monotonic(), 0.0, 1.0, speed) + bytes(_WOKEN.size))
        super().__init__(path, PEERS)

    def environment(self, number: int) -> dict[str, str]:
        """The variable for the child process that is to have this clock as `number`."""
        return {VARIABLE: f"{number}:{self._path}"}

    def restart(self) -> None:
        """Count from now, and judge the speed from now."""
        super().restart()
        self._judged_s = (time.monotonic(), self._zero_s)

    def now_s(self) -> float:
        """Seconds of flight since this clock was started; renews what the others go by."""
        wall_s = time.monotonic()
        flight_s = self._flight_s(wall_s)
        self._judge(wall_s, flight_s)
        woken_s = _WOKEN.unpack_from(self._memory, _ANCHOR.size)
        is_overdue = any(0.0 < at_s < wall_s - LEEWAY_S / self.speed for at_s in woken_s)
        self._rate = _floor(self.speed) if is_overdue else self.speed
        anchor = _anchored(wall_s, flight_s, self._rate, self.speed)
        self._memory[: _ANCHOR.size] = anchor
        return self._counted_s(flight_s)

    def excuse(self) -> None:
        """Wait for no other process until it wakes up again."""
        _WOKEN.pack_into(self._memory, _ANCHOR.size, *[0.0] * PEERS)

    def _judge(self, wall_s: float, flight_s: float) -> None:
        since_s, from_s = self._judged_s
        if wall_s - since_s < WINDOW_S:
            return
        if flight_s - from_s < LEAST_SHARE * self.speed * (wall_s - since_s):
            self.speed = max(_floor(self.speed), self.speed / 2.0)
        self._judged_s = (wall_s, flight_s)


def _floor(speed: float) -> float:
    """Real time, or the speed of a flight that is slower by intention."""
    return min(1.0, speed)


def _anchored(wall_s: float, flight_s: float, rate: float, speed: float) -> bytes:
    return _ANCHOR.pack(wall_s, flight_s, rate, speed, wall_s + flight_s + rate + speed)


def clock_of(speed: float) -> Clock:
    """The clock that the parent process shares with this one, or one of its own at `speed`."""
    number, _, path = os.environ.get(VARIABLE, "").partition(":")
    return SharedClock(Path(path), int(number)) if path else Clock(speed)
