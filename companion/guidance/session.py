"""The guidance session: events in, commands out, no clock and no socket; and its status.

It passes each event to the part that handles it: measurements to `Measuring`, reports of the
autopilot and commands of the operator to `Handover`, time to `ControlTick`. They share one
`SessionContext`, and the transition table of `phases` decides if anything may be sent. The
status is a snapshot of the session for views and logs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from companion.domain import FlightMode, PositionEnu, TargetEstimate, Waypoint
from companion.estimation.innovations import TrackerHealth
from companion.estimation.tracker import TargetTracker
from companion.guard.gate import Guard
from companion.guidance import events
from companion.guidance.commands import Command, ReportResult, SessionParams, When
from companion.guidance.context import SessionContext
from companion.guidance.control import TICK_S as TICK_S
from companion.guidance.control import ControlTick
from companion.guidance.emitters import EmitterQueue
from companion.guidance.fencing import FencePlan, Fencing
from companion.guidance.handover import Handover
from companion.guidance.health.watches import Watches
from companion.guidance.measurements import EmitterScheduler, Measuring
from companion.guidance.phases import IN_CONTROL, Phase
from companion.guidance.readiness import Recollection, memory_of
from companion.guidance.searching import Searching
from companion.planning.planner import Planner


@dataclass(frozen=True, slots=True)
class EmitterStatus:
    """Estimate and progress of one emitter."""

    emitter_id: int
    estimate: TargetEstimate | None
    is_current: bool
    is_reported: bool


@dataclass(frozen=True, slots=True)
class GuidanceStatus:
    """Snapshot for the operator, as of `time_s`."""

    time_s: float
    phase: Phase
    detail: str
    """Reason why it holds or waits, or the current leg."""
    mode: FlightMode
    is_armed: bool
    is_link_lost: bool
    vehicle_enu_m: PositionEnu | None
    height_m: float | None
    distance_m: float
    estimate: TargetEstimate | None
    """Estimate of the emitter that is searched for now, with the announced state."""
    emitters: tuple[EmitterStatus, ...]
    """Every emitter that was heard or listed."""
    waypoint: Waypoint | None
    setpoint_enu_m: PositionEnu | None
    guard: tuple[str, ...]
    """Reasons for which the guard changed the setpoint."""
    health: TrackerHealth
    """Indicators of trust in the estimate."""
    accepted: int
    refused: Mapping[str, int]
    battery_pct: float | None


def _detail(context: SessionContext) -> str:
    """Return why it waits or holds, the stage of the launch, or the reason of the waypoint."""
    phase, launch = context.authority.phase, context.launch
    waypoint = context.flight_plan.waypoint
    if phase is Phase.YIELD and context.authority.grant_reason is not None:
        return f"{context.authority.grant_reason}: needs a grant"
    if phase is Phase.WAITING and context.authority.needs_another_mode:
        guided_name = context.vehicle.guided_name
        return f"found in {guided_name} or in a failsafe: change its mode, or grant control"
    if phase in (Phase.DEGRADED, Phase.HOLD) and context.finding is not None:
        return context.finding.text
    if phase is Phase.LAUNCHING and launch is not None:
        return launch.stage.value
    if phase is Phase.NORMAL and waypoint is not None:
        return f"{waypoint.reason.value}: {waypoint.detail}"
    return ""


MODE_EVENTS = (events.HeartbeatReceived, events.LandedStateChanged)


class GuidanceSession:
    """Guides one vehicle to one emitter after the other; it `needs_origin` for global setpoints."""

    def __init__(
        self,
        params: SessionParams,
        emitters: EmitterQueue,
        planner: Planner[Any],
        guard: Guard,
        *,
        needs_origin: bool = False,
        fence_plan: FencePlan | None = None,
        searching: Searching | None = None,
    ) -> None:
        fencing = Fencing(guard, fence_plan)
        self.context = context = SessionContext(
            params,
            emitters,
            planner,
            guard,
            fencing,
            needs_origin=needs_origin,
            searching=searching,
        )
        self.vehicle, self.fencing, self.authority = context.vehicle, fencing, context.authority
        self.flight_plan, self.steering = context.flight_plan, context.steering
        self.searching = context.searching
        """Record of the search until contact."""
        self.handover = Handover(self.context)
        self._watches = Watches(self.context)
        scheduler = EmitterScheduler(self.context, self._watches.inputs)
        self._measuring = Measuring(self.context, self._watches.inputs, scheduler)
        self._control = ControlTick(self.context, self._watches, self.handover, scheduler)
        self._recollection = Recollection(self.context)

    def handle(self, event: events.Event) -> list[Command]:
        """Apply an event, and return the commands that follow."""
        if isinstance(event, events.RangingReceived):
            self._measuring.receive(event.measurement, event.time_s)
        elif isinstance(event, events.TimeLeft):
            self._measuring.continue_fusing(event.time_s)
        elif isinstance(event, events.TimerFired):
            self.vehicle.heard_s = event.heard_s
            self.vehicle.mode_watch.tick(event.time_s)
            if self._recollection.waiting:
                self._recollection.advance(event.time_s)
            self._control.run(event.time_s)
            self._measuring.tick(event.time_s)  # after the setpoint
        elif isinstance(event, MODE_EVENTS) and self.authority.is_out_of_date(event):
            self.context.record("overtaken", what=type(event).__name__)
        elif isinstance(event, events.LandedStateChanged) and self._doubts_landing(event):
            self.context.record("landing_doubted", height_m=self.vehicle.height_m)
        else:
            self._note(event)
            self._react(event)
        return self.context.take_commands()

    def _doubts_landing(self, event: events.LandedStateChanged) -> bool:
        height_m, floor_m = self.vehicle.height_m, self.context.guard.limits.envelope.altitude_min_m
        if height_m is None or self.phase not in IN_CONTROL:
            return False
        return self._watches.landing.doubts(event, height_m, floor_m)

    def _note(self, event: events.Event) -> None:
        """Update the vehicle and the watches."""
        match event:
            case events.OriginSet():
                if self._watches.jumps.take_origin(event):
                    self._watches.echo.frame_moved(event.time_s)
                self.handover.take_origin(event)
            case events.HomeSet():
                self.handover.take_home(event)
            case events.VehicleMoved():
                self._watches.jumps.take_position(event)
                return
            case events.YawMeasured():
                self._watches.jumps.take_heading(event)
                return
            case events.PositionAccuracyReported():
                self.vehicle.handle(event)
                return
            case _:
                self.vehicle.handle(event)
        self._watches.handle(event)

    def _react(self, event: events.Event) -> None:
        """React to an event, once vehicle and watches are updated."""
        match event:
            case events.VehicleMoved():
                self._measuring.fuse_due(event.time_s)
            case events.AutopilotClockSlipped():
                self.vehicle.track.clear()
                self.context.warn("autopilot's clock or link delay jumped: resyncing")
            case events.IdentityDoubted(problem=str(problem)):
                self.handover.leave(problem, event.time_s)
            case events.IdentityDoubted():
                self.authority.forget_heartbeats()
            case events.Retuned():
                self.context.retune(event.tuning)
            case events.ProcessMessage():
                self.context.announce(event.severity, event.text)
            case events.UncleanExitFound():
                self.context.forbid_launch()
                self.authority.require_another_mode()
            case events.MemoryRecalled():
                self._recollection.recall(event.memory, event.age_s, event.time_s)
            case _:
                self.handover.handle(event)
                if isinstance(event, events.AutopilotRestarted):
                    self._recollection.forget()

    @property
    def params(self) -> SessionParams:
        """Parameters of the mission."""
        return self.context.params

    @property
    def tracker(self) -> TargetTracker:
        """Tracker of the current emitter."""
        return self.context.tracker

    @property
    def estimate(self) -> TargetEstimate | None:
        """Estimate after the newest measurement; None before the first one."""
        return self.context.estimate

    @property
    def result(self) -> ReportResult | None:
        """Latest report; None if no emitter was reported."""
        return self.context.result

    @property
    def has_found_all(self) -> bool:
        """True if something was reported and no other emitter is left."""
        return self.result is not None and self.context.emitters.are_all_reported

    @property
    def has_finished(self) -> bool:
        """True once the last report was made, or the search ended, and the vehicle was released."""
        return self._control.reporting.has_finished

    @property
    def is_search_over(self) -> bool:
        """True if the search ended before all emitters were heard, and the flight with it."""
        return self._control.reporting.is_search_over

    @property
    def phase(self) -> Phase:
        """Phase of the session."""
        return self.authority.phase

    @property
    def memory(self) -> events.SessionMemory:
        """State that a later session needs."""
        return memory_of(self.context)

    @property
    def is_recalling(self) -> bool:
        """True while restored estimates wait for their frame: until then `memory` lacks them."""
        return bool(self._recollection.waiting)

    @property
    def is_behind(self) -> bool:
        """True while measurements wait for `TimeLeft` between control ticks."""
        return self._measuring.is_behind

    @property
    def is_stopped(self) -> bool:
        """True if the process may end."""
        return self.authority.phase is Phase.STOPPED

    def objection_to(self, command: events.OperatorCommand) -> str | None:
        """Return the reason why an operator's command would have no effect now, or None."""
        return self._watches.operator.objection(command)

    def objection_to_change(self, when: When) -> str | None:
        """Return the reason why a parameter may not be changed now, or None."""
        if when is When.NEVER:
            return "is read-only"
        if when is When.DISARMED and self.vehicle.is_armed:
            return "can be changed while disarmed only"
        is_passing = self.phase in (Phase.LAUNCHING, Phase.HANDBACK)
        return f"cannot be changed during {self.phase.value}" if is_passing else None

    def emitters(self, now_s: float) -> tuple[EmitterStatus, ...]:
        """Return the status of every emitter that was heard or listed; costs little."""
        context, current = self.context, self.context.tracker
        return tuple(
            EmitterStatus(
                tracker.emitter_id,
                context.estimate if tracker is current else tracker.estimate(now_s),
                is_current=tracker is current,
                is_reported=tracker.emitter_id in context.reports,
            )
            for tracker in context.emitters.trackers
            if tracker.emitter_id is not None
        )

    def status(self, now_s: float) -> GuidanceStatus:
        """Return a snapshot for views and logs."""
        context, vehicle, steering = self.context, self.vehicle, self.steering
        shown = context.shown_estimate(now_s)
        return GuidanceStatus(
            time_s=now_s,
            phase=context.authority.phase,
            detail=_detail(context),
            mode=vehicle.mode,
            is_armed=vehicle.is_armed,
            is_link_lost=vehicle.is_link_lost(now_s),
            vehicle_enu_m=vehicle.position_enu_m,
            height_m=vehicle.height_m,
            distance_m=vehicle.distance_m,
            estimate=shown,
            emitters=tuple(
                replace(each, estimate=shown) if each.is_current else each
                for each in self.emitters(now_s)
            ),
            waypoint=context.flight_plan.waypoint,
            setpoint_enu_m=steering.setpoint_enu_m,
            guard=tuple(reason.value for reason in steering.reasons),
            health=context.tracker.health,
            accepted=context.emitters.accepted,
            refused={reason.value: count for reason, count in context.emitters.rejected.items()},
            battery_pct=vehicle.battery_pct,
        )
