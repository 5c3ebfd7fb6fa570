"""Who may fly: the phase, and when offboard mode counts as given by the operator.

What follows from it is decided here, too: is a search due, is silence due, and how to hand back.
"""

from __future__ import annotations

import math

from companion.domain import Autopilot, FlightMode
from companion.guidance.authority.launch import Launch
from companion.guidance.authority.state_machine import (
    IN_CONTROL,
    OUT_OF_CONTROL,
    STREAMING,
    Phase,
    Trigger,
    next_phase,
)
from companion.guidance.events import HeartbeatReceived, LandedStateChanged
from companion.guidance.flight.vehicle import VehicleView

REGAIN_QUIET_S = 2.0
"""Offboard seen sooner than this after a yield comes from our own setpoints still in flight, or
from a mode that flaps: it must have been left for as long."""
LATE_S = 1.0
"""A frame from before control was given may come this much later, and ends nothing."""
ID_CONFLICT_S = 10.0
"""An id conflict may be silent as long: over a bad link half of its HEARTBEATs get lost."""
NOT_LEFT = frozenset({Trigger.HANDED_BACK, Trigger.GIVE_WAY, Trigger.LANDED, Trigger.LAUNCH_FAILED})
"""They end control while the mode may still be offboard, which nobody gave again then."""


class Authority:
    """The phase, and the latches that keep us from taking what nobody gave."""

    def __init__(self) -> None:
        self.phase = Phase.WAITING
        self.since_s = 0.0
        self.has_let_go = False
        """Since the report the vehicle was seen out of offboard: it is not ours any more."""
        self._must_leave_offboard = False
        self._has_heartbeat = False
        self._left_s = -math.inf
        """When another mode was first shown after offboard, or a yield began ..."""
        self._away_s = math.inf
        """... and for how long, when offboard came back."""
        self._given_s = -math.inf
        self._newest: HeartbeatReceived | None = None
        self._id_conflict_s = -math.inf

    def enter(self, trigger: Trigger, now_s: float) -> Phase | None:
        """Apply a trigger; the phase that was left, or None if nothing changed."""
        if trigger is Trigger.GRANTED:
            self._must_leave_offboard = False
        left = self.phase
        phase = next_phase(left, trigger)
        if phase is left:
            return None
        if trigger in NOT_LEFT:
            self._must_leave_offboard = True
        self.phase = phase
        self.since_s = now_s
        if trigger is Trigger.MODE_GIVEN:
            self._given_s = now_s
        if phase is Phase.YIELD:  # what was on its way by now is nobody's gift
            self._left_s, self._away_s = now_s, 0.0
        if phase is Phase.FINISHED:
            self.has_let_go = trigger is Trigger.REPORT_RECALLED
        return left

    def is_overtaken(self, event: HeartbeatReceived | LandedStateChanged) -> bool:
        """Whether a newer heartbeat came before, so that what this one shows is over.

        An order may lie, after a long delay or over two links. So what takes control away is
        believed in any case, but for the moment after control was given.
        """
        newest = self._newest
        if newest is None or newest.order is None or event.order is None:
            return False
        if event.order >= newest.order:
            return False
        if isinstance(event, HeartbeatReceived) and event.mode is FlightMode.OFFBOARD:
            return event.is_armed
        return self.phase in IN_CONTROL and event.time_s - self._given_s <= LATE_S

    def observe(self, heartbeat: HeartbeatReceived) -> None:
        """Set or clear the latch from what the autopilot shows.

        A vehicle found flying in offboard, or in a failsafe, may be someone else's or left by a
        companion that died: streaming would take over unasked (PX4 re-enters offboard by itself
        when setpoints return, also ours that a link had kept). So offboard that a failsafe ended is
        nobody's gift, but an ArduPilot's, which never goes back to GUIDED by itself. A failsafe may
        be told a HEARTBEAT later than its mode.
        """
        is_offboard = heartbeat.mode is FlightMode.OFFBOARD
        was_offboard = self._newest is not None and self._newest.mode is FlightMode.OFFBOARD
        if was_offboard and not is_offboard:
            self._left_s = heartbeat.time_s
        elif is_offboard and not was_offboard and self._newest is not None:
            self._away_s = heartbeat.time_s - self._left_s
        if (was_offboard or self.phase is Phase.YIELD) and _may_return_by_itself(heartbeat):
            self._must_leave_offboard = True
        self._newest = heartbeat
        if self.phase is Phase.FINISHED and not (heartbeat.is_armed and is_offboard):
            self.has_let_go = True
        if not self._has_heartbeat:
            self._has_heartbeat = True
            self._must_leave_offboard = heartbeat.is_armed and (
                is_offboard or heartbeat.is_failsafe
            )
        elif not is_offboard and not heartbeat.is_failsafe:
            self._must_leave_offboard = False

    def id_conflict_heard(self, now_s: float) -> None:
        """Somebody sends under our ids: offboard, seen while we do not fly, is that one's."""
        self._id_conflict_s = now_s
        is_offboard = self._newest is not None and self._newest.mode is FlightMode.OFFBOARD
        if is_offboard and self.phase in (*OUT_OF_CONTROL, Phase.STANDBY):
            self._must_leave_offboard = True

    def has_id_conflict(self, now_s: float) -> bool:
        """Whether somebody else sends under our ids: of two that are given control, both fly."""
        return now_s - self._id_conflict_s <= ID_CONFLICT_S

    def note_disarmed(self, mode: FlightMode) -> None:
        """The flight ended; offboard left over from it does not count for the next one."""
        self._must_leave_offboard = mode is FlightMode.OFFBOARD

    def forget_autopilot(self) -> None:
        """The autopilot restarted: its next heartbeat is a first one again."""
        self._has_heartbeat = False
        self._newest = None

    @property
    def may_begin(self) -> bool:
        """Whether the vehicle is free for us to get ready."""
        return not self._must_leave_offboard

    @property
    def may_take(self) -> bool:
        """Whether offboard, seen now, was given by the operator."""
        if self._must_leave_offboard:
            return False
        return self.phase is not Phase.YIELD or self._away_s >= REGAIN_QUIET_S

    @property
    def came_too_soon(self) -> bool:
        """Whether offboard, seen now after a yield, would have been given a little later."""
        is_yield = self.phase is Phase.YIELD and not self._must_leave_offboard
        return is_yield and self._away_s < REGAIN_QUIET_S

    @property
    def came_by_itself(self) -> bool:
        """Whether offboard, seen now after a yield, is what a failsafe ended."""
        return self.phase is Phase.YIELD and self._must_leave_offboard and self._away_s > 0.0


def _may_return_by_itself(heartbeat: HeartbeatReceived) -> bool:
    """Whether a failsafe keeps a flying vehicle out of offboard for only as long as it lasts."""
    is_away = heartbeat.is_armed and heartbeat.mode is not FlightMode.OFFBOARD
    return is_away and heartbeat.is_failsafe and heartbeat.autopilot is not Autopilot.ARDUPILOT


FOLLOW_UP_S = 5.0
"""How long the autopilot may take to enter the mode that follows the report."""


def is_silence_due(
    authority: Authority, vehicle: VehicleView, launch: Launch | None, now_s: float
) -> bool:
    """Whether no setpoint may leave at this tick."""
    phase = authority.phase
    if phase not in STREAMING or not vehicle.is_mode_known(now_s):
        return True
    if phase is Phase.FINISHED:
        return authority.has_let_go or now_s - authority.since_s > FOLLOW_UP_S
    if phase is Phase.STANDBY:
        return not (vehicle.wants_prestream and vehicle.is_position_fresh(now_s))
    if phase is Phase.LAUNCHING:
        return launch is None or not launch.wants_stream
    return False


def hand_back_mode(
    authority: Authority, vehicle: VehicleView, launch: Launch | None, follow_up: FlightMode
) -> FlightMode | None:
    """What to ask the autopilot for before the end, or None if it is not in our hands."""
    match authority.phase:
        case Phase.FINISHED:
            return follow_up if vehicle.is_ours and not authority.has_let_go else None
        case Phase.LAUNCHING:
            may_fly = vehicle.is_armed or (launch is not None and launch.may_be_flying)
            return FlightMode.HOLD if may_fly else None
    return FlightMode.HOLD if authority.phase in IN_CONTROL else None
