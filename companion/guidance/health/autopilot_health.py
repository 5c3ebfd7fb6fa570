"""Health reported by the autopilot: battery, estimator, GNSS, failsafe.

Theory of operation. The charge is the autopilot's, in percent or as a state of its own; one report
may be wrong, so two in a row must agree, and unknown is not full. Low: the current leg is finished,
the estimates of the target are reported, and the mode that follows a report is requested. Critical:
the vehicle is handed back at once by requesting the return, and only once in a flight: an operator
who hands control over again knows the charge, and the vehicle then holds.

With a poor position estimate the autopilot flies our setpoints to wrong positions, and measurements
are assigned to wrong positions. So the vehicle holds at once, and is handed back if that lasts. The
estimator's verdict decides, not one of its inputs: a receiver that loses its fix changes nothing
while another has one. If all lose it, an estimator that still has a position after the longest dead
reckoning of the autopilots has another source, and the plan continues, slower.

"Landed", reported in our mode inside the altitude band, is not accepted until an idle throttle
confirms it: meanwhile the vehicle holds.

A failsafe raised in flight while the mode stays ours has an unknown cause: the vehicle holds,
unless a low battery explains it.

Source: PX4 user guide, "ECL/EKF"; ArduPilot `ekf_check.cpp`, FS_EKF_THRESH 0.8.
"""

from __future__ import annotations

import math

from companion.domain import BatteryLevel, FlightMode, LandedState
from companion.guidance import events
from companion.guidance.control_authority import Finding, Reason, Verdict, Watch, worst

CONFIRMED_BY = 2
LEG_S = 20.0
"""Longest time for which a leg is still finished on a low battery."""


class BatteryWatch(Watch):
    """Watches the charge, 0 to 100 %."""

    def __init__(self, low_pct: float, critical_pct: float) -> None:
        self.level = BatteryLevel.UNKNOWN
        self.charge_pct: float | None = None
        """Charge, 0 to 100; None: unknown."""
        self._low_pct = low_pct
        self._critical_pct = critical_pct
        self._candidate = BatteryLevel.UNKNOWN
        self._agreed = 0
        self._was_handed_back = False
        self._has_ended_mission = False
        self.is_idle = True

    def handle(self, event: events.Event) -> None:
        """Apply an event about the battery."""
        match event:
            case events.BatteryReported():
                self.charge_pct = event.charge_pct
                level = max(self._level_of(event.charge_pct), event.level)
                self._agreed = self._agreed + 1 if level is self._candidate else 1
                self._candidate = level
                if self._agreed >= CONFIRMED_BY:
                    self.level = level
            case events.Retuned(tuning=tuning):
                self.set_thresholds(
                    tuning.params.battery_low_pct, tuning.params.battery_critical_pct
                )
            case events.AutopilotRestarted():
                self.level = self._candidate = BatteryLevel.UNKNOWN
                self.charge_pct = None
                self._agreed = 0
                self.note_flight_end()
        self.is_idle = self.level is not BatteryLevel.CRITICAL

    @property
    def is_low(self) -> bool:
        """True if the charge is low or critical."""
        return self.level >= BatteryLevel.LOW

    def set_thresholds(self, low_pct: float, critical_pct: float) -> None:
        """Set other thresholds for the next reports; two of them must agree again."""
        self._low_pct, self._critical_pct = low_pct, critical_pct
        self._agreed = 0

    @property
    def ends_mission(self) -> bool:
        """True if a low battery has to end the mission, once."""
        return self.level >= BatteryLevel.LOW and not self._has_ended_mission

    def note_mission_end(self) -> None:
        """Note that the mission was ended because of the battery."""
        self._has_ended_mission = True

    def note_handback(self) -> None:
        """Note that the vehicle was handed back because of the battery."""
        self._was_handed_back = True

    def note_flight_end(self) -> None:
        """Note the end of the flight."""
        self._was_handed_back = self._has_ended_mission = False

    def step(self, now_s: float) -> Finding | None:
        """Return the finding at a critical charge, or None."""
        del now_s
        if self.level is not BatteryLevel.CRITICAL:
            return None
        verdict = Verdict.HOLD if self._was_handed_back else Verdict.HAND_BACK
        text = f"battery critical{self._percent()}"
        return Finding(verdict, Reason.BATTERY_CRITICAL, text, FlightMode.RETURN)

    def text(self) -> str:
        """Return the level as text."""
        return f"battery {self.level.name.lower()}{self._percent()}"

    def _percent(self) -> str:
        return "" if self.charge_pct is None else f", {self.charge_pct:.0f} %"

    def _level_of(self, charge_pct: float | None) -> BatteryLevel:
        if charge_pct is None:
            return BatteryLevel.UNKNOWN
        if charge_pct <= self._critical_pct:
            return BatteryLevel.CRITICAL
        return BatteryLevel.LOW if charge_pct <= self._low_pct else BatteryLevel.GOOD


DOUBT_S = 1.0
"""Longest trouble reported by an estimator after which it recovers by itself."""
GOOD_S = 1.0
"""Time without trouble until the estimate is trusted again."""
HAND_BACK_AFTER_S = 5.0
"""Trouble that lasts longer than this leads to a hand-back."""


class _Condition:
    """An intermittent condition; it ends only after `GOOD_S` without it."""

    def __init__(self) -> None:
        self.since_s: float | None = None
        """Time of its first report; None without one, or after its end."""
        self._bad_s = 0.0
        """Time of the last report of the condition."""
        self._good_s: float | None = None

    def note(self, is_bad: bool, now_s: float) -> None:
        """Record a report of the condition."""
        if self._is_over(now_s):
            self.clear()
        if is_bad:
            self._good_s, self._bad_s = None, now_s
            if self.since_s is None:
                self.since_s = now_s
        elif self.since_s is not None and self._good_s is None:
            self._good_s = now_s

    def lasted_s(self, now_s: float) -> float | None:
        """Return how long the condition has lasted, in seconds; None if it is over."""
        if self.since_s is None or self._is_over(now_s):
            return None
        return (now_s if self._good_s is None else self._bad_s) - self.since_s

    def clear(self) -> None:
        """End the condition at once."""
        self.since_s = self._good_s = None

    def _is_over(self, now_s: float) -> bool:
        return self._good_s is not None and now_s - self._good_s >= GOOD_S


DEAD_RECKONING_S = 10.0
"""Longest use of a position without GNSS: EKF2_NOAID_TOUT 5 s, posRetryTimeUseVel_ms 10 s."""
VERDICT_S = 3.0
"""Longest age of a verdict of the estimator."""
RECEIVER_S = 5.0
"""Longest age of a receiver's report; one that was unplugged has no fix."""


class HealthWatch(Watch):
    """Watches the health that the autopilot reports; a low battery explains a failsafe."""

    def __init__(self, battery: BatteryWatch) -> None:
        self._battery = battery
        self._doubt = _Condition()
        self._no_fix = _Condition()
        self._no_position = _Condition()
        self._receivers: dict[int, tuple[bool, float]] = {}
        """Fix state of each GNSS receiver that has had a fix, and the time of its report."""
        self._good_position_s = -math.inf
        """Time at which the estimator last reported a position of good quality."""
        self._is_failsafe = False
        self._accepted_failsafe = False
        """True if the failsafe was active when control was handed over: the operator knew."""
        self.is_idle = True

    def handle(self, event: events.Event) -> None:
        """Apply an event about health; ignore others."""
        match event:
            case events.EstimatorStatusReported():
                self._doubt.note(event.worst >= 1.0, event.time_s)
                self._no_position.note(event.has_position is False, event.time_s)
                if event.has_position and event.worst < 1.0:
                    self._good_position_s = event.time_s
            case events.FixReported():
                if event.has_fix or event.receiver in self._receivers:
                    self._receivers[event.receiver] = (event.has_fix, event.time_s)
                    oldest_s = event.time_s - RECEIVER_S
                    fixes = [has for has, at_s in self._receivers.values() if at_s >= oldest_s]
                    self._no_fix.note(not any(fixes), event.time_s)
            case events.HeartbeatReceived():
                self._is_failsafe = event.is_failsafe
                self._accepted_failsafe = self._accepted_failsafe and event.is_failsafe
            case events.AutopilotRestarted():
                self._doubt.clear()
                self._no_fix.clear()
                self._no_position.clear()
                self._receivers.clear()
                self._good_position_s = -math.inf
                self._is_failsafe = self._accepted_failsafe = False
        conditions = (self._doubt, self._no_fix, self._no_position)
        self.is_idle = not self._is_failsafe and all(
            condition.since_s is None for condition in conditions
        )

    def begin(self, now_s: float) -> None:
        """Note the start of control."""
        del now_s
        self._accepted_failsafe = self._is_failsafe

    def step(self, now_s: float) -> Finding | None:
        """Return the worst finding, the first of equals, or None."""
        found: list[Finding | None] = []
        doubt_s, no_fix_s = self._doubt.lasted_s(now_s), self._no_fix.lasted_s(now_s)
        no_position_s = self._no_position.lasted_s(now_s)
        if no_position_s is not None:
            text = "autopilot's estimator has no position"
            found.append(_finding(Reason.ESTIMATOR_POOR, text, no_position_s))
        if no_fix_s is not None:
            found.append(self._without_fix(no_fix_s, now_s))
        if doubt_s is not None and doubt_s >= DOUBT_S:
            text = "autopilot's position estimate is poor"
            found.append(_finding(Reason.ESTIMATOR_POOR, text, doubt_s))
        if self._is_failsafe and not self._accepted_failsafe and not self._battery.is_low:
            text = "autopilot failsafe active"
            found.append(Finding(Verdict.HOLD, Reason.FAILSAFE, text))
        return worst(found) if found else None

    def _without_fix(self, lasted_s: float, now_s: float) -> Finding:
        """Return the finding for a lost fix, by the estimator's verdict."""
        text = "autopilot lost GNSS fix"
        if now_s - self._good_position_s > VERDICT_S:
            return _finding(Reason.NO_FIX, text, lasted_s)
        if lasted_s <= DEAD_RECKONING_S:
            return Finding(Verdict.HOLD, Reason.NO_FIX, text)
        text = "no GNSS fix, but the autopilot's estimator has a position"
        return Finding(Verdict.SLOW, Reason.NO_FIX, text)


IDLE_THROTTLE = 0.15
"""Highest throttle on the ground: ArduPilot MOT_SPIN_MIN 0.15, PX4 MPC_THR_MIN 0.12."""
THROTTLE_S = 2.0
"""Longest age of a throttle report."""


class LandingWatch(Watch):
    """Doubts a landing that is reported in our mode and altitude band without an idle throttle."""

    def __init__(self) -> None:
        self._throttle: events.ThrottleReported | None = None
        self.is_idle = True
        """True unless a landing is doubted."""
        self._height_m = 0.0

    def doubts(self, event: events.LandedStateChanged, height_m: float, floor_m: float) -> bool:
        """Return True if a landing is doubted at a height above home; `floor_m` is the band's."""
        is_high = event.landed is LandedState.ON_GROUND and height_m >= floor_m
        self.is_idle = not is_high or self._has_idle_throttle(event.time_s)
        self._height_m = height_m
        return not self.is_idle

    def handle(self, event: events.Event) -> None:
        """Apply a throttle report; a restart of the autopilot ends every doubt."""
        match event:
            case events.ThrottleReported():
                self._throttle = event
            case events.AutopilotRestarted():
                self._throttle, self.is_idle = None, True

    def begin(self, now_s: float) -> None:
        """Start control without earlier doubts."""
        del now_s
        self.is_idle = True

    def step(self, now_s: float) -> Finding | None:
        """Return a hold while the autopilot reports a landing that is doubted, else None."""
        del now_s
        if self.is_idle:
            return None
        text = f"autopilot reports landed at {self._height_m:.0f} m: take over if it descends"
        return Finding(Verdict.HOLD, Reason.LANDED_DOUBTED, text)

    def _has_idle_throttle(self, now_s: float) -> bool:
        throttle = self._throttle
        is_fresh = throttle is not None and now_s - throttle.time_s <= THROTTLE_S
        return throttle is not None and is_fresh and throttle.share <= IDLE_THROTTLE


def _finding(reason: Reason, text: str, lasted_s: float) -> Finding:
    if lasted_s <= HAND_BACK_AFTER_S:
        return Finding(Verdict.HOLD, reason, text)
    return Finding(Verdict.HAND_BACK, reason, f"{text} for {HAND_BACK_AFTER_S:g} s")
