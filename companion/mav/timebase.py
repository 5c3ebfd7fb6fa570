"""A sender's clock on the companion's time axis.

A remote stamp (`time_boot_ms`, `time_usec`) becomes local seconds by the smallest difference
arrival - stamp seen so far: delay only ever adds to it, so the smallest is the nearest to the
truth. The minimum is forgotten slowly, so that a drifting clock is followed.

A stamp that went back is one of three: the counter wrapped, the frame is late, or the sender
restarted. A wrap is a step by almost exactly 2**32 ms. A restart shows itself by going on: stamps
of the new clock come for a while, as fast as time passes, and none of the old one in between. Until
then they are read as what they would be otherwise, late.
"""

from __future__ import annotations

from dataclasses import dataclass

REBOOT_BACKWARD_S = 1.0
"""A stamp less older than the newest one than this is only reordered."""

REBOOT_CONFIRM_S = 0.3
REBOOT_STAMPS = 3
"""A new clock must be heard for so long, and so often, before it is believed."""

REBOOT_JITTER_S = 1.0
"""How unevenly its stamps may come meanwhile."""

WRAP_S = 2**32 / 1000.0
"""`time_boot_ms` starts again at zero after 49.7 days; that is not a reboot."""

MAX_WRAP_GAP_S = 60.0
"""Silence, or lateness, over which a wrap is still recognised."""

DRIFT_ALLOWANCE = 200e-6
"""How fast the minimum may rise, seconds per second: twice a poor crystal's drift."""


@dataclass(frozen=True, slots=True)
class StampReading:
    """One converted stamp."""

    time_s: float
    """On the companion's clock, never in the future."""
    is_reboot: bool
    """The sender's clock went back: it restarted."""


@dataclass(slots=True)
class _NewClock:
    """Stamps that went back, and may be those of a restarted sender."""

    remote_s: float
    local_s: float
    offset_s: float
    stamps: int = 1

    def continues_with(self, remote_s: float, now_s: float) -> bool:
        """Whether a stamp is of the same clock as the first one."""
        passed_s = now_s - self.local_s
        return abs((remote_s - self.remote_s) - passed_s) <= REBOOT_JITTER_S

    def take(self, remote_s: float, now_s: float) -> bool:
        """Take in one more; whether this is enough to believe in it."""
        self.stamps += 1
        self.offset_s = min(self.offset_s, now_s - remote_s)
        return self.stamps >= REBOOT_STAMPS and now_s - self.local_s >= REBOOT_CONFIRM_S


class Timebase:
    """Converts the stamps of one sender's clock."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._new_clock: _NewClock | None = None
        self._newest_remote_s = 0.0
        self._updated_s = 0.0
        self._wraps = 0

    @property
    def offset_s(self) -> float | None:
        """Local minus remote time, with the shortest delay seen in it; None before any stamp."""
        return self._offset_s

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds."""
        raw_s, remote_s = remote_s, self._unwrapped(remote_s)
        if self._offset_s is None:
            return self._start(remote_s, now_s, now_s - remote_s, is_reboot=False)
        if remote_s < self._newest_remote_s - REBOOT_BACKWARD_S:
            if self._is_new_clock(raw_s, now_s) and self._new_clock is not None:
                self._wraps = 0
                return self._start(raw_s, now_s, self._new_clock.offset_s, is_reboot=True)
        else:
            self._new_clock = None
            risen_s = self._offset_s + DRIFT_ALLOWANCE * max(0.0, now_s - self._updated_s)
            self._offset_s = min(risen_s, now_s - remote_s)
            self._newest_remote_s = max(self._newest_remote_s, remote_s)
            self._updated_s = now_s
        return StampReading(min(now_s, remote_s + self._offset_s), is_reboot=False)

    def _start(
        self, remote_s: float, now_s: float, offset_s: float, *, is_reboot: bool
    ) -> StampReading:
        self._offset_s = offset_s
        self._newest_remote_s = remote_s
        self._updated_s = now_s
        self._new_clock = None
        return StampReading(min(now_s, remote_s + offset_s), is_reboot)

    def _is_new_clock(self, remote_s: float, now_s: float) -> bool:
        """Whether a stamp that went back confirms that the sender restarted."""
        if self._new_clock is None or not self._new_clock.continues_with(remote_s, now_s):
            self._new_clock = _NewClock(remote_s, now_s, now_s - remote_s)
            return False
        return self._new_clock.take(remote_s, now_s)

    def _unwrapped(self, remote_s: float) -> float:
        """The stamp without the wraps of its counter; one from before the last wrap may be late.

        Only a step back by almost exactly one wrap is one: a sender that falls from Unix time to
        its time since boot goes back much further, and has restarted.
        """
        remote_s += self._wraps * WRAP_S
        if self._offset_s is None:
            return remote_s
        behind_s = self._newest_remote_s - remote_s
        if WRAP_S - MAX_WRAP_GAP_S < behind_s <= WRAP_S + REBOOT_BACKWARD_S:
            self._wraps += 1
            return remote_s + WRAP_S
        if self._wraps and -WRAP_S <= behind_s < -WRAP_S + MAX_WRAP_GAP_S:
            return remote_s - WRAP_S
        return remote_s
