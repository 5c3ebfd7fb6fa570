"""The hand-over side of a session: how control comes, and everything that ends it."""

from __future__ import annotations

from companion.domain import FlightMode
from companion.guidance.commands import Severity
from companion.guidance.conditions import hand_back_mode
from companion.guidance.events import (
    HeartbeatReceived,
    OriginSet,
    Outcome,
    RequestAnswered,
    RequestKind,
)
from companion.guidance.findings import Finding, Reason, Verdict
from companion.guidance.params import FOLLOW_UP_MODE
from companion.guidance.situation import Situation
from companion.guidance.states import Phase, Trigger
from companion.guidance.vehicle import ORIGIN_STEP_M

CHECKING = Finding(Verdict.HOLD, Reason.CHECKING, "checking its inputs")


class Handover:
    """Watches whose vehicle it is.

    Args:
        situation: Of the session.
    """

    def __init__(self, situation: Situation) -> None:
        self._situation = situation

    def heartbeat(self, event: HeartbeatReceived) -> None:
        """The autopilot shows its mode."""
        situation, now_s = self._situation, event.time_s
        had_let_go = situation.authority.has_let_go
        situation.authority.observe(event)
        if situation.authority.has_let_go and not had_let_go:
            situation.withdraw()
        launch = situation.launch if situation.phase is Phase.LAUNCHING else None
        objection = None if launch is None else launch.observe(event)
        if not event.is_armed:
            if launch is None or objection is not None:
                self._disarmed(event)
        elif objection is not None:
            situation.enter(Trigger.MODE_LOST, now_s)
            situation.announce(Severity.WARNING, f"launch ended: {objection}")
        elif event.mode is FlightMode.OFFBOARD:
            self._offboard(now_s)
        elif launch is None and situation.enter(Trigger.MODE_LOST, now_s):
            name = situation.vehicle.name_of(event.mode)
            text = f"control lost: autopilot went to {name}; silent until given back"
            situation.announce(Severity.WARNING, text)

    def _disarmed(self, event: HeartbeatReceived) -> None:
        if self._situation.enter(Trigger.DISARMED, event.time_s):
            self._situation.authority.disarmed_in(event.mode)
            self._situation.announce(Severity.NOTICE, "disarmed: the flight is over")

    def _offboard(self, now_s: float) -> None:
        situation = self._situation
        if not (situation.authority.may_take(now_s) and situation.vehicle.obeys_setpoints):
            return
        is_climbing = situation.launch is not None and not situation.launch.is_at_offboard
        if situation.phase is Phase.LAUNCHING and is_climbing:
            return
        if situation.enter(Trigger.MODE_GIVEN, now_s):
            situation.launch = None
            situation.has_launched = True
            situation.find(CHECKING)
            text = f"in control: autopilot is in {situation.vehicle.guided_name}"
            situation.announce(Severity.NOTICE, text)

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

    def check_frame(self, event: OriginSet) -> None:
        """An origin that moved has moved every local position: start anew in the new frame.

        To be called before the vehicle takes the origin in.
        """
        situation = self._situation
        step_m = situation.vehicle.origin_step_m(event.origin)
        if step_m <= ORIGIN_STEP_M:
            return
        situation.vehicle.forget_frame()
        situation.forget_target()
        situation.steering.forget_setpoint()
        situation.find(Finding(Verdict.HOLD, Reason.FRAME_MOVED, "the local frame moved"))
        situation.enter(Trigger.INPUT_LOST, event.time_s)
        text = f"local origin moved by {step_m:.0f} m: estimate forgotten, waiting for ranging"
        situation.announce(Severity.WARNING, text)

    def restarted(self, now_s: float) -> None:
        """The autopilot restarted."""
        situation = self._situation
        situation.vehicle.forget()
        situation.forget_target()
        situation.authority.restarted()
        situation.enter(Trigger.RESTARTED, now_s)
        text = "autopilot restarted: holding until the operator engages"
        situation.announce(Severity.WARNING, text)

    def stop(self, now_s: float) -> None:
        """The process is asked to end: hand the vehicle back if it is in our hands."""
        situation = self._situation
        follow_up = FOLLOW_UP_MODE[situation.params.on_localised]
        mode = hand_back_mode(situation.authority, situation.vehicle, situation.launch, follow_up)
        if not (situation.enter(Trigger.STOP, now_s) and situation.phase is Phase.HANDBACK):
            return
        if mode is None:
            situation.enter(Trigger.HANDED_BACK, now_s)
            return
        name = situation.vehicle.name_of(mode)
        situation.announce(Severity.NOTICE, f"stopping: asking the autopilot to {name}")
        situation.ask_mode(mode)
