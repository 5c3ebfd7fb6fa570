"""What the autopilot says of its own health: estimator, satellites, failsafe.

Theory of operation. An autopilot that doubts its position flies our setpoints to the wrong place,
and the ranging is placed wrongly too. So the vehicle stays where it is as soon as that is known,
and is handed back when it lasts: the autopilot knows better than we what it can still do. A
failsafe that is raised in flight while the mode stays ours has a cause that we do not see: it is
held on, unless a low battery explains it.

Source: PX4 user guide, "ECL/EKF", innovation test ratios; ArduPilot `ekf_check.cpp`, FS_EKF_THRESH
0.8.
"""

from __future__ import annotations

from companion.guidance.events import (
    EstimatorRated,
    Event,
    FixReported,
    HeartbeatReceived,
)
from companion.guidance.findings import Finding, Reason, Verdict

DOUBT_S = 1.0
"""A filter that doubts for less than this settles again by itself."""
GOOD_S = 1.0
"""It must be good again for as long before it is believed."""
PATIENCE_S = 5.0
"""What lasts longer than this is handed back."""


class _Trouble:
    """A condition that comes and goes: since when it lasts, ended only when it stays away."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._bad_s = 0.0
        """When it was last told to be so."""
        self._good_s: float | None = None

    def note(self, is_bad: bool, now_s: float) -> None:
        """It was told to be so."""
        if is_bad:
            self._good_s, self._bad_s = None, now_s
            if self._since_s is None:
                self._since_s = now_s
        elif self._since_s is not None and self._good_s is None:
            self._good_s = now_s

    def lasted_s(self, now_s: float) -> float | None:
        """For how long it was so; None once it has stayed away."""
        if self._good_s is not None and now_s - self._good_s >= GOOD_S:
            self.clear()
        if self._since_s is None:
            return None
        return (now_s if self._good_s is None else self._bad_s) - self._since_s

    def clear(self) -> None:
        """Forget it."""
        self._since_s = self._good_s = None


class HealthWatch:
    """Watches what the autopilot tells of itself."""

    def __init__(self) -> None:
        self._doubt = _Trouble()
        self._no_fix = _Trouble()
        self._had_fix = False
        self._is_failsafe = False
        self._accepted_failsafe = False
        """The failsafe was there when control was given: whoever gave it knows."""

    def handle(self, event: Event) -> None:
        """Take in what concerns health; other events change nothing."""
        match event:
            case EstimatorRated():
                self._doubt.note(event.worst >= 1.0, event.time_s)
            case FixReported():
                self._had_fix = self._had_fix or event.has_fix
                self._no_fix.note(self._had_fix and not event.has_fix, event.time_s)
            case HeartbeatReceived():
                self._is_failsafe = event.is_failsafe
                self._accepted_failsafe = self._accepted_failsafe and event.is_failsafe

    def begin(self) -> None:
        """Control begins."""
        self._accepted_failsafe = self._is_failsafe

    def forget(self) -> None:
        """The autopilot restarted."""
        self._doubt.clear()
        self._no_fix.clear()
        self._had_fix = self._is_failsafe = self._accepted_failsafe = False

    def findings(self, now_s: float, *, is_battery_low: bool) -> list[Finding]:
        """What is wrong now."""
        found = []
        doubt_s, no_fix_s = self._doubt.lasted_s(now_s), self._no_fix.lasted_s(now_s)
        if no_fix_s is not None:
            text = "the autopilot has lost its satellites"
            found.append(_finding(Reason.NO_FIX, text, no_fix_s))
        if doubt_s is not None and doubt_s >= DOUBT_S:
            text = "the autopilot doubts its own position"
            found.append(_finding(Reason.ESTIMATOR_POOR, text, doubt_s))
        if self._is_failsafe and not self._accepted_failsafe and not is_battery_low:
            text = "the autopilot reports a failsafe"
            found.append(Finding(Verdict.HOLD, Reason.FAILSAFE, text))
        return found


def _finding(reason: Reason, text: str, lasted_s: float) -> Finding:
    if lasted_s <= PATIENCE_S:
        return Finding(Verdict.HOLD, reason, text)
    return Finding(Verdict.HAND_BACK, reason, f"{text} for {PATIENCE_S:g} s")
