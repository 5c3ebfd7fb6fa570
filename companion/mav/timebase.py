"""A sender's clock on the companion's time axis.

A remote stamp (`time_boot_ms`, `time_usec`) becomes local seconds by the smallest difference
arrival - stamp seen so far: delay only ever adds to it, so the smallest is the nearest to the
truth. The minimum is forgotten slowly, so that a drifting clock is followed.
"""

from __future__ import annotations

from dataclasses import dataclass

REBOOT_BACKWARD_S = 1.0
"""A stamp this much older than the newest one is a reboot, not reordering."""

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


class Timebase:
    """Converts the stamps of one sender's clock."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._newest_remote_s = 0.0
        self._updated_s = 0.0
        self._wraps = 0

    @property
    def offset_s(self) -> float | None:
        """Local minus remote time, with the shortest delay seen in it; None before any stamp."""
        return self._offset_s

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds."""
        remote_s = self._unwrapped(remote_s)
        rebooted = False
        if self._offset_s is not None and remote_s < self._newest_remote_s - REBOOT_BACKWARD_S:
            rebooted = True
            remote_s -= self._wraps * WRAP_S
            self._wraps = 0
            self._offset_s = None
        difference_s = now_s - remote_s
        if self._offset_s is None:
            self._offset_s = difference_s
            self._newest_remote_s = remote_s
        else:
            risen_s = self._offset_s + DRIFT_ALLOWANCE * max(0.0, now_s - self._updated_s)
            self._offset_s = min(risen_s, difference_s)
            self._newest_remote_s = max(self._newest_remote_s, remote_s)
        self._updated_s = now_s
        return StampReading(min(now_s, remote_s + self._offset_s), rebooted)

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
