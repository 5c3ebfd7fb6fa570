"""The hand-over side of a session: how control comes, and everything that ends it."""

from __future__ import annotations

import math

from companion.domain import FlightMode, LandedState
from companion.guidance.authority import REGAIN_QUIET_S
from companion.guidance.commands import Severity
from companion.guidance.conditions import hand_back_mode
from companion.guidance.events import (
    AutopilotFenceRead,
    ControlStalled,
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    OriginSet,
    Outcome,
    RequestAnswered,
    RequestKind,
)
from companion.guidance.findings import Finding, Reason, Verdict
from companion.guidance.params import FOLLOW_UP_MODE
from companion.guidance.situation import Situation
from companion.guidance.states import HAS_VEHICLE, Phase, Trigger
from companion.guidance.vehicle import ORIGIN_STEP_M

SETTLE_S = 2.0
"""How long a frame or a home that moved must be stable."""
HAND_BACK_S = 1.4
"""How long the autopilot may take to confirm its mode: we end within 1.5 s of the request ..."""
LONGEST_HAND_BACK_S = 1.9
"""... and of the wish within 2 s, where it had to be found out first who flies."""
CHECKING = Finding(Verdict.HOLD, Reason.CHECKING, "checking its inputs")


class Handover:
    """Watches whose vehicle it is.

    Args:
        situation: Of the session.
    """

    def __init__(self, situation: Situation) -> None:
        self._situation = situation
        self._has_flown = False
        """Whether it was in the air since control began."""
        self._was_told = False
        self._hand_back_mode = FlightMode.HOLD
        """What the autopilot is asked for before it is let go ..."""
        self._asked_s: float | None = None
        """... and when it was; None: not yet, because it is not known who flies."""

    def heartbeat(self, event: HeartbeatReceived) -> None:
        """The autopilot shows its mode."""
        situation, now_s = self._situation, event.time_s
        had_let_go = situation.authority.has_let_go
        situation.authority.observe(event)
        if situation.authority.has_let_go and not had_let_go:
            situation.withdraw()
        launch = situation.launch if situation.phase is Phase.LAUNCHING else None
        objection = None if launch is None else launch.observe(event, situation.vehicle.height_m)
        if event.is_terminated or not event.is_armed:
            if launch is None or objection is not None or event.is_terminated:
                self._flight_over(event)
        elif objection is not None:
            situation.enter(Trigger.LAUNCH_FAILED, now_s)
            situation.announce(Severity.WARNING, f"launch ended: {objection}")
        elif event.mode is FlightMode.OFFBOARD:
            self._offboard(now_s)
        elif launch is None:
            self._foreign(event)

    def landed(self, event: LandedStateChanged) -> None:
        """The autopilot tells whether it flies; landing means that somebody else decides."""
        situation = self._situation
        if event.landed is LandedState.IN_AIR:
            self._has_flown = True
        is_down = event.landed is LandedState.ON_GROUND and self._has_flown
        if not is_down and event.landed is not LandedState.LANDING:
            return
        if situation.enter(Trigger.LANDED, event.time_s):
            text = "on the ground" if is_down else "the autopilot is landing"
            situation.announce(Severity.WARNING, f"control lost: {text}; silent until given back")

    def _foreign(self, event: HeartbeatReceived) -> None:
        situation, left = self._situation, self._situation.phase
        if not situation.enter(Trigger.MODE_LOST, event.time_s):
            return
        self._was_told = False
        name = situation.vehicle.name_of(event.mode)
        if left is Phase.HANDBACK:
            situation.announce(Severity.NOTICE, f"handed back: autopilot is in {name}")
            return
        text = f"control lost: autopilot went to {name}; silent until given back"
        situation.announce(Severity.WARNING, text)

    def _flight_over(self, event: HeartbeatReceived) -> None:
        if self._situation.enter(Trigger.DISARMED, event.time_s):
            self._situation.authority.disarmed_in(event.mode)
            why = "flight terminated" if event.is_terminated else "disarmed"
            self._situation.announce(Severity.NOTICE, f"{why}: the flight is over")

    def _offboard(self, now_s: float) -> None:
        situation = self._situation
        if not situation.vehicle.is_mode_known(now_s):
            return  # it may be over
        self._tell_why_it_does_not_count()
        if not (situation.authority.may_take and situation.vehicle.obeys_setpoints):
            return
        is_launched = situation.phase is Phase.LAUNCHING
        if situation.authority.has_twin(now_s) and not is_launched:
            return  # it may have been given to that one
        if not situation.fencing.is_ready:
            return
        is_climbing = situation.launch is not None and not situation.launch.is_at_offboard
        if is_launched and is_climbing:
            return
        if situation.enter(Trigger.MODE_GIVEN, now_s):
            self._has_flown = situation.vehicle.landed is LandedState.IN_AIR
            situation.launch = None
            situation.has_launched = True
            situation.find(CHECKING, now_s)
            text = f"in control: autopilot is in {situation.vehicle.guided_name}"
            situation.announce(Severity.NOTICE, text)

    def _tell_why_it_does_not_count(self) -> None:
        situation = self._situation
        authority, name = situation.authority, situation.vehicle.guided_name
        if self._was_told or not (authority.came_too_soon or authority.came_by_itself):
            return
        self._was_told = True
        text = f"{name} came too soon: leave it for {REGAIN_QUIET_S:g} s, or grant control"
        if authority.came_by_itself:
            how = "first choose a mode without one, or grant control"
            text = f"{name} is back after a failsafe: {how}"
        situation.announce(Severity.WARNING, text)

    def twin_heard(self, now_s: float) -> None:
        """Somebody else sends under our ids: what we do not fly yet is not offered."""
        self._situation.authority.twin_heard(now_s)
        self._situation.enter(Trigger.TWIN_HEARD, now_s)

    def answered(self, event: RequestAnswered) -> None:
        """The autopilot answered a request, or did not."""
        situation = self._situation
        situation.record("answer", request=event.kind.value, outcome=event.outcome.value)
        if situation.phase is Phase.LAUNCHING and situation.launch is not None:
            situation.launch.answered(event)
        elif situation.phase is Phase.HANDBACK and event.kind is RequestKind.SET_MODE:
            if event.outcome is not Outcome.ACCEPTED:
                situation.announce(Severity.ERROR, f"hand-back: {event.outcome.value}")
            situation.enter(Trigger.HANDED_BACK, event.time_s)
        elif situation.phase is Phase.FINISHED and event.outcome is not Outcome.ACCEPTED:
            situation.announce(Severity.ERROR, f"{event.kind.value}: {event.outcome.value}")

    def granted(self, now_s: float) -> None:
        """The operator gives control back."""
        situation = self._situation
        if situation.enter(Trigger.GRANTED, now_s):
            text = f"granted again: switch to {situation.vehicle.guided_name}"
            situation.announce(Severity.NOTICE, text)

    def check_frame(self, event: OriginSet) -> bool:
        """An origin that moved has moved every local position: start anew in the new frame.

        To be called before the vehicle takes the origin in; whether it moved.
        """
        situation = self._situation
        step_m = situation.vehicle.origin_step_m(event.origin)
        if step_m <= ORIGIN_STEP_M:
            return False
        situation.vehicle.move_frame(event.origin)
        situation.forget_target()
        situation.steering.forget_setpoint()
        finding = Finding(Verdict.HOLD, Reason.FRAME_MOVED, "the local frame moved")
        situation.find(finding, event.time_s)
        situation.hold_until(finding, event.time_s + SETTLE_S)
        situation.enter(Trigger.INPUT_LOST, event.time_s)
        text = f"local origin moved by {step_m:.0f} m: fence kept in its place, estimate forgotten"
        situation.announce(Severity.WARNING, text)
        return True

    def check_home(self, event: HomeSet) -> None:
        """A home that moves in flight changes neither the plan nor its height: hold, and tell.

        To be called before the vehicle takes the home in.
        """
        situation, before = self._situation, self._situation.vehicle.reported_home_enu_m
        if situation.phase not in HAS_VEHICLE or before is None:
            return
        step_m = math.dist(before, event.position_enu_m)
        if not step_m > ORIGIN_STEP_M:
            return
        text = f"home moved by {step_m:.0f} m; heights stay above the home of the take-over"
        situation.announce(Severity.WARNING, text)
        finding = Finding(Verdict.HOLD, Reason.HOME_MOVED, "home moved")
        situation.hold_until(finding, event.time_s + SETTLE_S)

    def fence(self, event: OriginSet | AutopilotFenceRead) -> None:
        """What the guard's fence stands on became known, or another one."""
        situation, fencing = self._situation, self._situation.fencing
        before = (fencing.refusal, fencing.note, fencing.is_ready)
        if isinstance(event, OriginSet):
            fencing.set_origin(event.origin)
        else:
            fencing.take(event)
        if (fencing.refusal, fencing.note, fencing.is_ready) == before:
            return
        if fencing.refusal is not None:
            situation.announce(Severity.ERROR, f"no control without a fence: {fencing.refusal}")
        elif fencing.note is not None:
            situation.announce(Severity.WARNING, fencing.note)
        elif fencing.is_ready:
            situation.announce(Severity.INFO, f"fence: {fencing.words}")

    def restarted(self, now_s: float) -> None:
        """The autopilot restarted."""
        situation = self._situation
        situation.fencing.forget()
        situation.vehicle.forget()
        situation.forget_target()
        situation.authority.restarted()
        situation.enter(Trigger.RESTARTED, now_s)
        text = "autopilot restarted: holding until the operator engages"
        situation.announce(Severity.WARNING, text)

    def unless_in_doubt(self, finding: Finding, now_s: float) -> Finding:
        """What asks the autopilot for a mode waits until it is known who flies: perhaps a pilot."""
        if self._situation.vehicle.mode_watch.may_be_asked(now_s):
            return finding
        return Finding(Verdict.HOLD, Reason.MODE_UNKNOWN, Reason.MODE_UNKNOWN.value)

    def hand_back(self, finding: Finding, now_s: float) -> None:
        """What is wrong does not pass: the autopilot shall fly by itself."""
        situation = self._situation
        if not situation.enter(Trigger.GIVE_UP, now_s):
            return
        self._hand_back_mode, self._asked_s = finding.mode, None
        name = situation.vehicle.name_of(finding.mode)
        text = f"handing back: {finding.text}; asking the autopilot to {name}"
        situation.announce(Severity.ERROR, text)
        self.go_on_handing_back(now_s)

    def give_way(self, finding: Finding, now_s: float) -> None:
        """Somebody else commands: silence."""
        if self._situation.enter(Trigger.GIVE_WAY, now_s):
            text = f"giving way: {finding.text}; silent until given back"
            self._situation.announce(Severity.ERROR, text)

    def stalled(self, event: ControlStalled) -> None:
        """The tick stood still: nothing is sent until mode and position were heard anew.

        What was asked before is not asked again, because whoever flies may have changed since; to
        hand back, it is once that is known.
        """
        situation = self._situation
        situation.vehicle.distrust(event.time_s)
        situation.steering.forget_setpoint()
        situation.withdraw()
        self._asked_s = None
        text = f"the computer stood still for {event.stalled_s:.1f} s: looking where we are"
        if situation.enter(Trigger.LAUNCH_FAILED, event.time_s):
            text += f"; launch ended: give {situation.vehicle.guided_name} again, or grant control"
        situation.announce(Severity.WARNING, text)

    def stop(self, now_s: float) -> None:
        """The process is asked to end: hand the vehicle back if it is in our hands."""
        situation = self._situation
        situation.is_stopping = True
        follow_up = FOLLOW_UP_MODE[situation.params.on_localised]
        mode = hand_back_mode(situation.authority, situation.vehicle, situation.launch, follow_up)
        if not (situation.enter(Trigger.STOP, now_s) and situation.phase is Phase.HANDBACK):
            return
        if mode is None:
            situation.enter(Trigger.HANDED_BACK, now_s)
            return
        self._hand_back_mode, self._asked_s = mode, None
        name = situation.vehicle.name_of(mode)
        is_known = situation.vehicle.mode_watch.may_be_asked(now_s)
        asking = "asking the autopilot" if is_known else "looking who flies, before asking"
        situation.announce(Severity.NOTICE, f"stopping: {asking} to {name}")
        self.go_on_handing_back(now_s)

    def go_on_handing_back(self, now_s: float) -> None:
        """Ask for the mode to hand back in, once it is known who flies; do not wait for ever."""
        situation, since_s = self._situation, self._situation.authority.since_s
        may_be_asked = situation.vehicle.mode_watch.may_be_asked(now_s)
        if self._asked_s is None and may_be_asked and now_s - since_s <= HAND_BACK_S:
            self._asked_s = now_s
            situation.ask_mode(self._hand_back_mode)
        asked_s = since_s if self._asked_s is None else self._asked_s
        if now_s > min(asked_s + HAND_BACK_S, since_s + LONGEST_HAND_BACK_S):
            situation.announce(Severity.ERROR, "hand-back: not confirmed in time")
            situation.enter(Trigger.HANDED_BACK, now_s)
