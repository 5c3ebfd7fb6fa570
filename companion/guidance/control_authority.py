"""Control authority: phase, the operator's selection of offboard mode, and watch verdicts.

The module decides when offboard mode counts as selected by the operator. It also decides when a
search is due, when the companion must be silent, and which mode it requests to hand back.

Verdicts. At every tick each watch may return a finding; the worst one decides the phase. A finding
has a reason, which is counted, and a text, which is announced. A new failsafe is a reason here, a
`Watch` in this folder, and an entry in `Watches`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, IntEnum

from companion.domain import FlightMode
from companion.guidance.events import Event, HeartbeatReceived, LandedStateChanged
from companion.guidance.launch import Launch
from companion.guidance.phases import IN_CONTROL, OUT_OF_CONTROL, Phase, Trigger, next_phase
from companion.guidance.vehicle import VehicleView

REGAIN_QUIET_S = 2.0
"""Time for which HEARTBEATs must show another mode without a failsafe before it is taken as
selected.

PX4 may report a failsafe one HEARTBEAT after its mode, and our setpoints may still be in transit.
"""
LATE_S = 1.0
"""Longest delay of a frame sent before the hand-over: such a frame must not end control."""
ID_CONFLICT_S = 10.0
"""Longest silence of an id conflict: a bad link loses half of the other system's HEARTBEATs."""
CHOICES = frozenset({Trigger.MODE_LOST, Trigger.PILOT_TOOK})
"""Triggers that mean a person's choice, unless there is evidence of another cause."""
GRANT_REASONS = {
    Trigger.HANDED_BACK: "handed back",
    Trigger.CONTENTION: "second source of setpoints",
    Trigger.NOT_OURS: "another vehicle",
    Trigger.LANDED: "landed",
    Trigger.LAUNCH_FAILED: "takeoff aborted",
    Trigger.YIELD_RECALLED: "silent before the restart",
}
"""Ends of control after which a grant is needed, as texts for the operator."""
LATCHING_PHASES = {
    Phase.HANDBACK: Trigger.HANDED_BACK,
    Phase.LAUNCHING: Trigger.LAUNCH_FAILED,
}
FAILSAFE_REASON, ID_CONFLICT_REASON, FLAPS_REASON = "failsafe", "id conflict", "mode flaps"


class Authority:
    """The phase, and the two latches that keep the companion from taking control unprompted.

    The operator's rule is in docs/flying.md, "Who flies".
    """

    def __init__(self) -> None:
        self.phase = Phase.WAITING
        self.since_s = 0.0
        self.has_left_offboard = False
        """True once the vehicle left offboard after the report: never stream again."""
        self.grant_reason: str | None = None
        """Reason that only a grant, or the end of the flight, removes; None: no latch."""
        self.is_offboard_reselected = False
        """True if offboard was shown again after another mode in this phase."""
        self._must_leave_offboard = False
        """True while another mode has to be shown for `REGAIN_QUIET_S` first."""
        self._has_heartbeat = False
        self._other_mode_since_s: float | None = None
        """Time at which another mode was first shown without a failsafe; None if not shown."""
        self._control_began_s = -math.inf
        self._is_reselected = False
        """True if control was handed over by a second mode switch, without a grant."""
        self._newest: HeartbeatReceived | None = None
        self.offboard_shown_s = -math.inf
        """Time of the last HEARTBEAT that showed offboard, in seconds."""
        self._id_conflict_s = -math.inf

    def enter(self, trigger: Trigger, now_s: float) -> Phase | None:
        """Apply a trigger; return the phase that was left, or None if nothing changed."""
        if trigger is Trigger.GRANTED:
            self._must_leave_offboard, self.grant_reason = False, None
            self._is_reselected = False
        elif trigger is Trigger.MODE_LEFT:
            self._is_reselected = True
        left = self.phase
        phase = next_phase(left, trigger)
        if phase is Phase.YIELD:
            self._latch(trigger, left, now_s)
        if phase is left:
            return None
        self.phase = phase
        self.since_s = now_s
        self.is_offboard_reselected = False
        if trigger is Trigger.MODE_GIVEN:
            self._control_began_s = now_s
        if phase is Phase.FINISHED:
            self.has_left_offboard = trigger is Trigger.REPORT_RECALLED
        return left

    def _latch(self, trigger: Trigger, left: Phase, now_s: float) -> None:
        """Latch a grant or a mode change when control ends, or on a new reason against it."""
        trigger = LATCHING_PHASES.get(left, trigger)
        reason = GRANT_REASONS.get(trigger)
        if trigger in CHOICES and self.has_id_conflict(now_s):
            reason = ID_CONFLICT_REASON
        if (
            left in IN_CONTROL
            and self._is_reselected
            and now_s - self._control_began_s < REGAIN_QUIET_S
        ):
            reason = reason or FLAPS_REASON
        if trigger in CHOICES and self._newest is not None and self._newest.is_failsafe:
            reason = FAILSAFE_REASON
        self.grant_reason = self.grant_reason or reason
        if left is not Phase.YIELD:
            self._must_leave_offboard = True

    def require_grant(self, reason: str) -> None:
        """Require a grant although the mode was left by choice."""
        self.grant_reason = self.grant_reason or reason

    def require_another_mode(self) -> None:
        """Require another mode first: an earlier process may have left the vehicle in offboard."""
        self._must_leave_offboard = True

    def is_out_of_date(self, event: HeartbeatReceived | LandedStateChanged) -> bool:
        """Return True if a newer heartbeat arrived earlier, so that this event is out of date.

        A frame may be delayed for long, or come over a second link. An event that ends control is
        obeyed in any case, except for a moment after control was handed over.
        """
        if not self._is_older(event):
            return False
        if isinstance(event, HeartbeatReceived) and event.mode is FlightMode.OFFBOARD:
            return event.is_armed
        return self.phase in IN_CONTROL and event.time_s - self._control_began_s <= LATE_S

    def _is_older(self, event: HeartbeatReceived | LandedStateChanged) -> bool:
        newest = self._newest
        if newest is None or newest.order is None or event.order is None:
            return False
        return event.order < newest.order

    def observe(self, heartbeat: HeartbeatReceived) -> None:
        """Set or clear the latches by the mode that the autopilot reports.

        A vehicle found flying in offboard, or in a failsafe, may be flown by another system or left
        over from a companion that died. Streaming would take over unprompted: PX4 re-enters
        offboard by itself when setpoints return, including ours that a link had buffered. It does
        so only where a failsafe ended offboard; a mode that was chosen stays.
        """
        is_offboard = heartbeat.mode is FlightMode.OFFBOARD
        if is_offboard:
            self.offboard_shown_s = heartbeat.time_s
        if is_offboard and self._newest is not None:
            self.is_offboard_reselected |= self._newest.mode is not FlightMode.OFFBOARD
        is_older, self._newest = self._is_older(heartbeat), heartbeat
        if is_offboard or heartbeat.is_failsafe or is_older:
            self._other_mode_since_s = None
        elif self._other_mode_since_s is None:
            self._other_mode_since_s = heartbeat.time_s
        if self.phase is Phase.FINISHED and not (heartbeat.is_armed and is_offboard):
            self.has_left_offboard = True
        if self.phase is Phase.YIELD and heartbeat.is_armed and heartbeat.is_failsafe:
            self.require_grant(FAILSAFE_REASON)
        if not self._has_heartbeat:
            self._has_heartbeat = True
            self._must_leave_offboard |= self._other_mode_since_s is None
            self._must_leave_offboard &= heartbeat.is_armed
        elif self._is_other_mode_chosen(heartbeat):
            self._must_leave_offboard = False

    def _is_other_mode_chosen(self, heartbeat: HeartbeatReceived) -> bool:
        """Return True if another mode has been shown for long enough to be a choice."""
        if self._other_mode_since_s is None:
            return False
        return (
            not heartbeat.is_armed or heartbeat.time_s - self._other_mode_since_s >= REGAIN_QUIET_S
        )

    def note_id_conflict(self, now_s: float) -> None:
        """Note that another system sends under our ids and may have caused offboard mode."""
        self._id_conflict_s = now_s
        if self.phase is Phase.YIELD:
            self.require_grant(ID_CONFLICT_REASON)
        is_offboard = self._newest is not None and self._newest.mode is FlightMode.OFFBOARD
        if is_offboard and self.phase in (*OUT_OF_CONTROL, Phase.STANDBY):
            self._must_leave_offboard = True

    def has_id_conflict(self, now_s: float) -> bool:
        """Return True while another system sends under our ids, which also takes control."""
        return now_s - self._id_conflict_s <= ID_CONFLICT_S

    def note_disarmed(self, mode: FlightMode) -> None:
        """Note the end of the flight; offboard left over from it does not count."""
        self._must_leave_offboard = mode is FlightMode.OFFBOARD
        self.grant_reason, self._is_reselected = None, False

    def forget_heartbeats(self) -> None:
        """Treat the next heartbeat as the first one: those before may be another vehicle's."""
        self._has_heartbeat = False
        self._newest = self._other_mode_since_s = None

    def forget_autopilot(self) -> None:
        """Drop what is known of the flight, because the autopilot restarted."""
        self.forget_heartbeats()
        self.grant_reason = None

    @property
    def needs_another_mode(self) -> bool:
        """True if the vehicle is in offboard or a failsafe that another mode has to end first."""
        return self._must_leave_offboard and self._other_mode_since_s is None

    @property
    def may_begin(self) -> bool:
        """True if no latch is set, so that the companion may enter standby."""
        return not self._must_leave_offboard and self.grant_reason is None

    @property
    def knows_mode(self) -> bool:
        """True if a heartbeat has shown the mode since the last doubt or restart."""
        return self._has_heartbeat


FOLLOW_UP_S = 5.0
"""Longest time the autopilot may take to enter the mode that follows the report."""


def hand_back_mode(
    authority: Authority, vehicle: VehicleView, launch: Launch | None, follow_up: FlightMode
) -> FlightMode | None:
    """Return the mode to request before the end, or None if we do not control the vehicle."""
    match authority.phase:
        case Phase.FINISHED:
            return follow_up if vehicle.is_ours and not authority.has_left_offboard else None
        case Phase.LAUNCHING:
            may_fly = vehicle.is_armed or (launch is not None and launch.may_be_flying)
            return FlightMode.HOLD if may_fly else None
    return FlightMode.HOLD if authority.phase in IN_CONTROL else None


class Verdict(IntEnum):
    """Reaction that a finding needs, by severity.

    Yielding ranks above handing back: requesting a mode while another system commands would be a
    fight for the vehicle.
    """

    SLOW = 1
    """Continue, slower: DEGRADED."""
    HOLD = 2
    """Stay in place: HOLD."""
    HAND_BACK = 3
    """Request a mode in which the autopilot flies by itself: HANDBACK."""
    YIELD = 4
    """Be silent: YIELD."""


class Reason(Enum):
    """Reason why the plan is not followed, or not at full speed."""

    NO_LINK = "autopilot link lost"
    MODE_UNKNOWN = "autopilot's mode is unknown"
    POSITION_STALE = "vehicle position is stale"
    NO_HOME = "home is unknown"
    NO_ORIGIN = "origin is unknown"
    INPUT_MISSING = "an input that control needs is missing"
    NO_RANGING_YET = "waiting for ranging"
    RANGING_AGES = "ranging is ageing"
    NO_RANGING = "no ranging"
    RANGING_IS_BACK = "ranging is back, too few measurements"
    ESTIMATE_VAGUE = "estimate is too uncertain to coast"
    FILTER_DIVERGED = "filter is recovering"
    WRONG_UNIT = "measurements seem to be in a wrong unit"
    FRAME_MOVED = "local frame moved"
    HOME_MOVED = "home moved"
    OWN_JUMP = "vehicle position or heading jumped"
    FENCE = "the fence is not known, or cannot be kept"
    CHECKING = "checking its inputs"
    OPERATOR_HOLDS = "the operator requested hold"
    OPERATOR_RETURNS = "the operator requested return"
    SECOND_SOURCE = "second source of setpoints"
    SETPOINTS_LOST = "setpoints do not arrive"
    NO_ECHO = "setpoints are not echoed"
    STICKS = "the pilot moves the sticks"
    ESTIMATOR_POOR = "autopilot's position estimate is poor"
    NO_FIX = "autopilot lost GNSS fix"
    FAILSAFE = "autopilot reports a failsafe"
    LANDED_DOUBTED = "autopilot reports landed in flight"
    BATTERY_CRITICAL = "battery critical"
    INTERNAL_ERROR = "internal error"


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem, with the reaction that it needs."""

    verdict: Verdict
    reason: Reason
    text: str
    mode: FlightMode = FlightMode.HOLD
    """Mode to request on a hand-back."""
    since_s: float = -math.inf
    """Time of the first sign of it, in seconds; -inf where that decides nothing."""


class Watch:
    """Base of all watches; every method does nothing unless a watch overrides it."""

    is_idle: bool = False
    """True while `step` cannot find a fault at any time, so that it is not called."""

    def handle(self, event: Event) -> None:
        """Apply an event."""

    def begin(self, now_s: float) -> None:
        """Note the start of control."""

    def step(self, now_s: float) -> Finding | None:
        """Advance to a control tick, in control or not; return the worst finding, or None."""


def worst(findings: Iterable[Finding | None]) -> Finding | None:
    """Return the most severe finding, the first of several; None if there is none."""
    found = [finding for finding in findings if finding is not None]
    return max(found, key=lambda finding: finding.verdict, default=None)
