"""Who may fly: the phase, and when offboard mode counts as given by the operator."""

from __future__ import annotations

from companion.domain import FlightMode
from companion.guidance.events import HeartbeatReceived
from companion.guidance.states import Phase, Trigger, next_phase

REGAIN_QUIET_S = 2.0
"""Offboard seen sooner than this after a yield comes from our own setpoints still in flight."""


class Authority:
    """The phase, and the latches that keep us from taking what nobody gave."""

    def __init__(self) -> None:
        self.phase = Phase.WAITING
        self.since_s = 0.0
        """When the phase began."""
        self.has_let_go = False
        """Since the report the vehicle was seen out of offboard: it is not ours any more."""
        self._must_leave_offboard = False
        self._has_heartbeat = False

    def enter(self, trigger: Trigger, now_s: float) -> Phase | None:
        """Apply a trigger; the phase that was left, or None if nothing changed."""
        if trigger is Trigger.GRANTED:
            self._must_leave_offboard = False
        left = self.phase
        phase = next_phase(left, trigger)
        if phase is left:
            return None
        self.phase = phase
        self.since_s = now_s
        if phase is Phase.FINISHED:
            self.has_let_go = False
        return left

    def observe(self, heartbeat: HeartbeatReceived) -> None:
        """Set or clear the latch from what the autopilot shows.

        A vehicle found flying in offboard, or in a failsafe, may be someone else's, or may have
        been left by a companion that died: streaming would take over without anyone having asked
        (PX4 re-enters offboard by itself when setpoints return).
        """
        is_offboard = heartbeat.mode is FlightMode.OFFBOARD
        if self.phase is Phase.FINISHED and not (heartbeat.is_armed and is_offboard):
            self.has_let_go = True
        if not self._has_heartbeat:
            self._has_heartbeat = True
            self._must_leave_offboard = heartbeat.is_armed and (
                is_offboard or heartbeat.is_failsafe
            )
        elif not is_offboard and not heartbeat.is_failsafe:
            self._must_leave_offboard = False

    def disarmed_in(self, mode: FlightMode) -> None:
        """The flight ended; offboard left over from it does not count for the next one."""
        self._must_leave_offboard = mode is FlightMode.OFFBOARD

    def restarted(self) -> None:
        """The autopilot restarted: its next heartbeat is a first one again."""
        self._has_heartbeat = False

    @property
    def may_begin(self) -> bool:
        """Whether the vehicle is free for us to get ready."""
        return not self._must_leave_offboard

    def may_take(self, now_s: float) -> bool:
        """Whether offboard, seen now, was given by the operator."""
        if self._must_leave_offboard:
            return False
        return self.phase is not Phase.YIELD or now_s - self.since_s >= REGAIN_QUIET_S
