"""Hand-over of control, and everything that ends it.

Control belongs to the person who armed or flies the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import asdict

from companion.domain import FlightMode, LandedState
from companion.guidance import events
from companion.guidance.commands import Severity, Topic
from companion.guidance.context import SessionContext
from companion.guidance.control_authority import (
    GRANT_REASONS,
    REGAIN_QUIET_S,
    Finding,
    Reason,
    Verdict,
    hand_back_mode,
)
from companion.guidance.phases import HAS_VEHICLE, Phase, Trigger
from companion.guidance.readiness import missing_inputs
from companion.guidance.vehicle import ORIGIN_STEP_M, vehicle_refusal

SETTLE_S = 2.0
"""Time for which a home that moved must be stable."""
HAND_BACK_S = 1.4
"""Longest time for the autopilot to confirm its mode: the process ends 1.5 s after the request."""
LONGEST_HAND_BACK_S = 1.9
"""Longest time from the request to stop, after which the process has 2 s, where the mode had to be
reacquired before the hand-back was requested."""
GRANT_HOW = "GRANT on the live map, or command 92 to component 191"
CHECKING = Finding(Verdict.HOLD, Reason.CHECKING, "checking its inputs")


class Handover:
    """Tracks control of the vehicle from hand-over to its end."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._has_flown = False
        """True if the vehicle was in the air since control began."""
        self._announced_missing: list[str] = []
        self._is_ignoring_announced = False
        self._grant_announced_s: float | None = None
        """Start of the yield for which the need of a grant was announced."""
        self._fitted_at: tuple[float, float, float] | None = None
        """Origin for which the fitted transform was announced: degrees, degrees, metres."""
        self._hand_back_mode = FlightMode.HOLD
        self._asked_s: float | None = None
        """Time of that request; None: not sent, because the current mode is not confirmed."""

    def handle(self, event: events.Event) -> None:
        """Apply an event of the autopilot or the operator that affects control; ignore others."""
        match event:
            case (
                events.OriginSet() | events.AutopilotFenceRead() | events.AutopilotFenceLimitsRead()
            ):
                self._update_fence(event)
            case events.HeartbeatReceived():
                self._note_mode(event)
            case events.LandedStateChanged():
                self._note_landed(event)
            case events.RequestAnswered():
                self._note_answer(event)
            case events.AutopilotRestarted():
                context, now_s = self._context, event.time_s
                context.fencing.forget(is_other=event.is_other)
                context.vehicle.forget()
                context.forget_target()
                context.authority.forget_autopilot()
                context.enter(Trigger.RESTARTED, now_s)
                if not event.is_other:
                    context.warn("autopilot restarted: reselect the mode to resume")
            case events.ControlStalled():
                self._note_stall(event)
            case events.IdConflictHeard():
                self._context.authority.note_id_conflict(event.time_s)
                self._context.enter(Trigger.ID_CONFLICT, event.time_s)
            case events.StopRequested():
                self._stop(event.time_s)

    def _note_mode(self, event: events.HeartbeatReceived) -> None:
        context, now_s = self._context, event.time_s
        had_left_offboard = context.authority.has_left_offboard
        context.authority.observe(event)
        if context.authority.has_left_offboard and not had_left_offboard:
            context.withdraw()
        refusal = vehicle_refusal(event.vehicle_class, event.autopilot)
        if refusal is not None:
            self.leave(refusal, now_s)
            return
        launch = context.launch if context.authority.phase is Phase.LAUNCHING else None
        objection = None if launch is None else launch.observe(event, context.vehicle.height_m)
        if event.is_terminated or not event.is_armed:
            if launch is None or objection is not None or event.is_terminated:
                self._flight_over(event)
        elif objection is not None:
            context.enter(Trigger.LAUNCH_FAILED, now_s)
            context.warn(f"takeoff aborted: {objection}")
        elif event.mode is FlightMode.OFFBOARD:
            self._note_offboard(now_s)
        elif launch is None:
            self._note_other_mode(event)

    def leave(self, why: str, now_s: float) -> None:
        """Stop sending: the autopilot on the link is not the vehicle that was handed over."""
        context, left = self._context, self._context.authority.phase
        if not context.enter(Trigger.NOT_OURS, now_s):
            return
        if left is not Phase.STANDBY:  # the waiting reason says the same
            context.announce(Severity.ERROR, f"control ended: {why}")

    def _note_landed(self, event: events.LandedStateChanged) -> None:
        """End control when the vehicle is landing: the autopilot or the pilot decided that."""
        context = self._context
        if event.landed is LandedState.IN_AIR:
            self._has_flown = True
        is_down = event.landed is LandedState.ON_GROUND and self._has_flown
        if not is_down and event.landed is not LandedState.LANDING:
            return
        left = context.authority.phase
        if context.enter(Trigger.LANDED, event.time_s):
            text = "on the ground" if is_down else "autopilot is landing"
            if left in (Phase.FINISHED, Phase.HANDBACK):  # as requested
                context.announce(Severity.NOTICE, f"as requested: {text}")
            else:
                context.warn(f"control lost: {text}")

    def _note_other_mode(self, event: events.HeartbeatReceived) -> None:
        context, left, finding = self._context, self._context.authority.phase, self._context.finding
        if not context.enter(Trigger.MODE_LOST, event.time_s):
            return
        name = context.vehicle.name_of(event.mode)
        if left is Phase.HANDBACK:
            context.announce(Severity.NOTICE, f"handed back: autopilot is in {name}")
            return
        # Echoes after the last HEARTBEAT in offboard may be targets of the mode chosen since.
        shown_s = context.authority.offboard_shown_s
        if finding and finding.reason is Reason.SECOND_SOURCE and finding.since_s <= shown_s:
            context.authority.require_grant(GRANT_REASONS[Trigger.CONTENTION])
        text = f"control lost: autopilot went to {name}"
        if context.authority.grant_reason is None:
            text += f"; ready again after {REGAIN_QUIET_S:g} s in that mode without a failsafe"
        context.warn(text)

    def _flight_over(self, event: events.HeartbeatReceived) -> None:
        if self._context.enter(Trigger.DISARMED, event.time_s):
            self._context.authority.note_disarmed(event.mode)
            why = "flight terminated" if event.is_terminated else "disarmed"
            self._context.announce(Severity.NOTICE, f"{why}: flight over")

    def _note_offboard(self, now_s: float) -> None:
        context = self._context
        if not context.vehicle.mode_watch.is_known(now_s):
            return  # the mode may have changed
        self._announce_ignored_mode()
        if context.vehicle.objection is not None:
            return
        is_launched = context.authority.phase is Phase.LAUNCHING
        missing = missing_inputs(context.vehicle, context.fencing, now_s)
        self._announce_missing(missing)
        if missing and not is_launched:
            return
        if not (context.authority.may_begin and context.vehicle.obeys_setpoints):
            return
        if context.authority.has_id_conflict(now_s) and not is_launched:
            return  # the operator may have meant the other system
        if not context.fencing.is_ready:
            return
        is_climbing = context.launch is not None and not context.launch.is_at_offboard
        if is_launched and is_climbing:
            return
        if context.enter(Trigger.MODE_GIVEN, now_s):
            self._has_flown = context.vehicle.landed is LandedState.IN_AIR
            context.record_finding(CHECKING, now_s)
            text = f"in control: autopilot is in {context.vehicle.guided_name}"
            context.announce(Severity.NOTICE, text)

    def _announce_missing(self, missing: list[str]) -> None:
        """Announce which inputs are missing although the mode was selected."""
        context = self._context
        is_waiting = context.authority.phase in (Phase.WAITING, Phase.STANDBY)
        if missing == self._announced_missing or not is_waiting:
            return
        self._announced_missing = missing
        if missing:
            name, parts = context.vehicle.guided_name, " and ".join(missing)
            context.warn(f"{name} without control: waiting for {parts}", Topic.READINESS)

    def _announce_ignored_mode(self) -> None:
        context = self._context
        authority, name = context.authority, context.vehicle.guided_name
        is_finished = authority.phase is Phase.FINISHED and authority.has_left_offboard
        is_ignored = authority.phase is Phase.YIELD or is_finished
        if not (authority.is_offboard_reselected and is_ignored):
            self._is_ignoring_announced = False
        elif not self._is_ignoring_announced:
            self._is_ignoring_announced = True
            reason = "the search is over" if is_finished else authority.grant_reason
            text = f"{name} too soon: leave it {REGAIN_QUIET_S:g} s, until ready"
            if reason is not None:
                text = f"{name} ignored: {reason}; {GRANT_HOW}"
            context.announce(Severity.NOTICE, text)

    def is_yield_over(self, now_s: float) -> bool:
        """Return True if a yield ends as another mode was selected; announce a needed grant."""
        context, authority = self._context, self._context.authority
        if authority.may_begin:
            return context.enter(Trigger.MODE_LEFT, now_s)
        if authority.grant_reason is not None and self._grant_announced_s != authority.since_s:
            self._grant_announced_s = authority.since_s
            text = f"grant needed, {authority.grant_reason}: {GRANT_HOW}"
            context.announce(Severity.NOTICE, text)
        return False

    def _note_answer(self, event: events.RequestAnswered) -> None:
        context = self._context
        context.record("answer", request=event.kind.value, outcome=event.outcome.value)
        if context.authority.phase is Phase.LAUNCHING and context.launch is not None:
            context.launch.note_answer(event)
        elif (
            context.authority.phase is Phase.HANDBACK and event.kind is events.RequestKind.SET_MODE
        ):
            if event.outcome is not events.Outcome.ACCEPTED:
                context.announce(Severity.ERROR, f"hand-back: {event.outcome.value}")
            context.enter(Trigger.HANDED_BACK, event.time_s)
        elif (
            context.authority.phase is Phase.FINISHED
            and event.outcome is not events.Outcome.ACCEPTED
        ):
            context.announce(Severity.ERROR, f"{event.kind.value}: {event.outcome.value}")

    def take_origin(self, event: events.OriginSet) -> None:
        """Set the vehicle's origin, which its positions already refer to."""
        context = self._context
        if event.origin != context.vehicle.origin:
            context.record("origin", **asdict(event.origin))
            origin = event.origin
            origin_deg_m = (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
            if event.off_m and origin_deg_m != self._fitted_at:
                self._fitted_at = origin_deg_m
                off_m = f"{event.off_m:.1f}"
                text = f"global position {off_m} m off the local one: using the fitted transform"
                self._context.warn(text)
        context.vehicle.handle(event)

    def take_home(self, event: events.HomeSet) -> None:
        """Set home; if it moves in flight, hold and warn: plan and altitude stay."""
        context, before = self._context, self._context.vehicle.reported_home_enu_m
        context.vehicle.handle(event)
        if context.authority.phase not in HAS_VEHICLE or before is None:
            return
        step_m = math.dist(before, event.position_enu_m)
        if not step_m > ORIGIN_STEP_M:
            return
        context.fencing.read_again()
        text = f"home moved {step_m:.0f} m: heights are above the old home"
        context.warn(text)
        finding = Finding(Verdict.HOLD, Reason.HOME_MOVED, "home moved")
        context.passing.hold(finding, event.time_s + SETTLE_S)

    def _update_fence(
        self,
        event: events.OriginSet | events.AutopilotFenceRead | events.AutopilotFenceLimitsRead,
    ) -> None:
        """Apply a new origin, fence or fence limits, and announce a change of the guard's fence."""
        context, fencing = self._context, self._context.fencing
        before = (fencing.refusal, fencing.note, fencing.is_ready, fencing.autopilot_fence)
        if isinstance(event, events.OriginSet):
            fencing.set_origin(event.origin)
        elif isinstance(event, events.AutopilotFenceLimitsRead):
            fencing.take_limits(event.limits)
        else:
            fencing.take(event)
        if (fencing.refusal, fencing.note, fencing.is_ready, fencing.autopilot_fence) == before:
            return
        if fencing.refusal is not None:
            context.announce(Severity.ERROR, f"no control without a fence: {fencing.refusal}")
        elif fencing.note is not None:
            context.warn(fencing.note)
        elif fencing.is_ready:
            context.announce(Severity.INFO, f"fence: {fencing.description}")

    def hold_if_unconfirmed(self, finding: Finding, now_s: float) -> Finding:
        """Return HOLD instead of a hand-back while the mode is unconfirmed: a pilot may fly."""
        if self._context.vehicle.mode_watch.may_request_mode(now_s):
            return finding
        return Finding(Verdict.HOLD, Reason.MODE_UNKNOWN, Reason.MODE_UNKNOWN.value)

    def hand_back(self, finding: Finding, now_s: float) -> None:
        """Start the hand-back: the fault persists, so the autopilot must fly by itself."""
        context = self._context
        if not context.enter(Trigger.HAND_BACK, now_s):
            return
        self._hand_back_mode, self._asked_s = finding.mode, None
        name = context.vehicle.name_of(finding.mode)
        text = f"handing back: {finding.text}; requesting {name}"
        context.announce(Severity.ERROR, text)
        self.continue_hand_back(now_s)

    def yield_control(self, finding: Finding, now_s: float) -> None:
        """Yield to another source of commands: send nothing more."""
        is_pilot = finding.reason is Reason.STICKS
        if self._context.enter(Trigger.PILOT_TOOK if is_pilot else Trigger.CONTENTION, now_s):
            text = f"control yielded: {finding.text}"
            if self._context.authority.grant_reason is None:
                text += f"; ready again after {REGAIN_QUIET_S:g} s in another mode"
            self._context.announce(Severity.ERROR, text)

    def _note_stall(self, event: events.ControlStalled) -> None:
        """Send nothing after a stalled control loop until mode and position are received again.

        An earlier request is not repeated, because control may have changed since; a hand-back is
        requested again once the mode is confirmed.
        """
        context = self._context
        context.vehicle.invalidate(event.time_s)
        context.steering.forget_setpoint()
        context.withdraw()
        self._asked_s = None
        text = f"control loop stalled {event.stalled_s:.1f} s: reacquiring state"
        if context.enter(Trigger.LAUNCH_FAILED, event.time_s):
            text += "; takeoff aborted"
        context.warn(text)

    def _stop(self, now_s: float) -> None:
        """Stop the process: hand the vehicle back first if the companion controls it."""
        context = self._context
        follow_up = FlightMode(context.params.on_localised)
        mode = hand_back_mode(context.authority, context.vehicle, context.launch, follow_up)
        if not context.stop(now_s):
            return
        if mode is None:
            context.enter(Trigger.HANDED_BACK, now_s)
            return
        self._hand_back_mode, self._asked_s = mode, None
        name = context.vehicle.name_of(mode)
        is_known = context.vehicle.mode_watch.may_request_mode(now_s)
        asking = "requesting" if is_known else "reacquiring state before requesting"
        context.announce(Severity.NOTICE, f"stopping: {asking} {name}")
        self.continue_hand_back(now_s)

    def continue_hand_back(self, now_s: float) -> None:
        """Request the hand-back mode once the current mode is confirmed, for a limited time."""
        context, since_s = self._context, self._context.authority.since_s
        may_request_mode = context.vehicle.mode_watch.may_request_mode(now_s)
        if self._asked_s is None and may_request_mode and now_s - since_s <= HAND_BACK_S:
            self._asked_s = now_s
            context.ask_mode(self._hand_back_mode)
        asked_s = since_s if self._asked_s is None else self._asked_s
        if now_s > min(asked_s + HAND_BACK_S, since_s + LONGEST_HAND_BACK_S):
            context.announce(Severity.ERROR, "hand-back not confirmed: take over now")
            context.enter(Trigger.HANDED_BACK, now_s)
