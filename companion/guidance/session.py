"""The guidance session: events in, commands out, no clock and no socket.

It hands each event to the side that knows it: measurements to `Measuring`, what the autopilot and
the operator say to `Handover`, time to `ControlTick`. They share one `Situation`, and the
transition table of `states` says whether anything may be sent.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from companion.domain import TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.guard.gate import Guard
from companion.guidance.authority import Authority
from companion.guidance.commands import Command, ReportResult
from companion.guidance.control import TICK_S as TICK_S
from companion.guidance.control import ControlTick
from companion.guidance.emitters import EmitterQueue
from companion.guidance.events import (
    AutopilotFenceRead,
    AutopilotRestarted,
    ControlGranted,
    ControlStalled,
    EarlierRunFound,
    Event,
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    MemoryRecalled,
    OperatorAsked,
    OriginSet,
    RangingReceived,
    RequestAnswered,
    Retuned,
    StopRequested,
    TimerFired,
    TwinHeard,
    VehicleMoved,
    YawMeasured,
)
from companion.guidance.fencing import FencePlan, Fencing
from companion.guidance.flight_plan import FlightPlan
from companion.guidance.handover import Handover
from companion.guidance.measuring import Measuring
from companion.guidance.memory import SessionMemory
from companion.guidance.params import SessionParams as SessionParams
from companion.guidance.recollection import Recollection, remembered
from companion.guidance.situation import Situation
from companion.guidance.states import Phase
from companion.guidance.status import (
    EmitterStatus,
    GuidanceStatus,
    emitter_statuses,
    snapshot,
)
from companion.guidance.steering import Steering
from companion.guidance.tuning import When, objection_to_change
from companion.guidance.turns import Turns
from companion.guidance.vehicle import VehicleView
from companion.guidance.watches import Watches
from companion.planning.base import Planner

MODE_EVENTS = (HeartbeatReceived, LandedStateChanged)


class GuidanceSession:
    """Guides one vehicle to one emitter after the other.

    Args:
        params: How the mission is flown.
        emitters: The estimates of the targets, and whose turn it is.
        planner: Where to fly, given the estimate.
        guard: What may be sent.
        needs_origin: Whether setpoints are global, so that nothing flies without an origin.
        fence_plan: Where the guard's fence comes from; None: the guard has it already.
    """

    def __init__(
        self,
        params: SessionParams,
        emitters: EmitterQueue,
        planner: Planner[Any],
        guard: Guard,
        *,
        needs_origin: bool = False,
        fence_plan: FencePlan | None = None,
    ) -> None:
        fencing = Fencing(guard, fence_plan)
        self.situation = Situation(
            params, emitters, planner, guard, fencing, needs_origin=needs_origin
        )
        self.handover = Handover(self.situation)
        self._watches = Watches(self.situation)
        turns = Turns(self.situation, self._watches.inputs)
        self._measuring = Measuring(self.situation, self._watches.inputs, turns)
        self._control = ControlTick(self.situation, self._watches, self.handover, turns)
        self._recollection = Recollection(self.situation)

    def handle(self, event: Event) -> list[Command]:
        """What is to be done about an event."""
        if isinstance(event, MODE_EVENTS) and self.authority.is_overtaken(event):
            self.situation.record("overtaken", what=type(event).__name__)
            return self.situation.take_commands()
        self._note(event)
        self._react(event)
        return self.situation.take_commands()

    def _note(self, event: Event) -> None:
        """What is known of the vehicle and its surroundings after an event."""
        if isinstance(event, OriginSet):
            if self.handover.check_frame(event):
                self._watches.frame_moved(event.time_s)
            if event.origin != self.vehicle.origin:
                self.situation.record("origin", **asdict(event.origin))
        if isinstance(event, HomeSet):
            self.handover.check_home(event)
        if isinstance(event, VehicleMoved):
            self._watches.jumps.moved(event)
        if isinstance(event, YawMeasured):
            self._watches.jumps.turned(event)
        self.vehicle.handle(event)
        self._watches.handle(event)

    def _react(self, event: Event) -> None:
        """What an event is the occasion for."""
        match event:
            case OriginSet() | AutopilotFenceRead():
                self.handover.fence(event)
            case HeartbeatReceived():
                self.handover.heartbeat(event)
            case LandedStateChanged():
                self.handover.landed(event)
            case RangingReceived():
                self._measuring.receive(event.measurement, event.time_s)
            case VehicleMoved():
                self._measuring.fuse_due(event.time_s)
            case RequestAnswered():
                self.handover.answered(event)
            case ControlGranted():
                self.handover.granted(event.time_s)
            case OperatorAsked():
                self._watches.wishes.ask(event.wish)
            case Retuned():
                self.situation.retune(event.tuning)
            case AutopilotRestarted():
                self.handover.restarted(event.time_s)
                self._recollection.forget()
            case ControlStalled():
                self.handover.stalled(event)
            case TwinHeard():
                self.handover.twin_heard(event.time_s)
            case StopRequested():
                self.handover.stop(event.time_s)
            case EarlierRunFound():
                self._recollection.forbid_launch()
            case MemoryRecalled():
                self._recollection.recall(event.memory, event.age_s, event.time_s)
            case TimerFired():
                self._recollection.advance(event.time_s)
                self._measuring.fuse_due(event.time_s)
                self._control.run(event.time_s)

    @property
    def params(self) -> SessionParams:
        """How the mission is flown."""
        return self.situation.params

    @property
    def tracker(self) -> TargetTracker:
        """What is believed of the target."""
        return self.situation.tracker

    @property
    def vehicle(self) -> VehicleView:
        """What is known of the vehicle."""
        return self.situation.vehicle

    @property
    def flight_plan(self) -> FlightPlan:
        """Where it wants to fly."""
        return self.situation.flight_plan

    @property
    def steering(self) -> Steering:
        """The setpoint sent last, and what the guard did to it."""
        return self.situation.steering

    @property
    def authority(self) -> Authority:
        """Who may fly."""
        return self.situation.authority

    @property
    def fencing(self) -> Fencing:
        """Which fence the guard keeps."""
        return self.situation.fencing

    @property
    def estimate(self) -> TargetEstimate | None:
        """The estimate after the newest measurement."""
        return self.situation.estimate

    @property
    def result(self) -> ReportResult | None:
        """What was reported last, once something was."""
        return self.situation.result

    @property
    def has_found_all(self) -> bool:
        """Whether something was reported and nobody else is to be found."""
        return self.result is not None and self.situation.emitters.are_all_reported

    @property
    def phase(self) -> Phase:
        """Where the session stands."""
        return self.situation.phase

    @property
    def memory(self) -> SessionMemory:
        """What a later session would need to know."""
        return remembered(self.situation)

    @property
    def is_recalling(self) -> bool:
        """Whether what was recalled is not taken up yet: until then `memory` lacks it."""
        return self._recollection.is_waiting

    @property
    def is_stopped(self) -> bool:
        """Whether the process may end."""
        return self.phase is Phase.STOPPED

    def objection_to_change(self, when: When) -> str | None:
        """Why a parameter may not be changed now, in words, or None."""
        return objection_to_change(when, self.phase, is_armed=self.vehicle.is_armed)

    def emitters(self, now_s: float) -> tuple[EmitterStatus, ...]:
        """What is known of every emitter; a part of `status` that costs little."""
        return emitter_statuses(self.situation, now_s)

    def status(self, now_s: float) -> GuidanceStatus:
        """A snapshot for views and logs."""
        return snapshot(now_s, self.situation)
