"""The guidance session: events in, commands out, no clock and no socket.

It joins what the other modules know: the listener feeds the tracker, the flight plan turns the
estimate into waypoints and the steering these into guarded setpoints, and the transition table of
`states` says whether any may be sent.
"""

from __future__ import annotations

import math
from typing import Any

from companion.domain import FlightMode, PositionSetpoint, TargetEstimate
from companion.estimation.tracker import FusionReport, TargetTracker
from companion.guard.gate import Guard, GuardReason
from companion.guidance.authority import Authority
from companion.guidance.commands import (
    Announce,
    Command,
    Record,
    ReportResult,
    SendHeartbeat,
    SendSetpoint,
    SetMode,
    Severity,
    WithdrawRequest,
)
from companion.guidance.conditions import hand_back_mode, is_silence_due, missing_input
from companion.guidance.events import (
    AutopilotRestarted,
    ControlGranted,
    Event,
    HeartbeatReceived,
    OriginSet,
    Outcome,
    RangingReceived,
    RequestAnswered,
    RequestKind,
    StopRequested,
    TimerFired,
    VehicleMoved,
)
from companion.guidance.flight_plan import FlightPlan
from companion.guidance.launch import Launch, LaunchView
from companion.guidance.listener import RangingListener
from companion.guidance.params import FOLLOW_UP_MODE
from companion.guidance.params import SessionParams as SessionParams
from companion.guidance.records import estimate_record, result_of
from companion.guidance.states import IN_CONTROL, OUT_OF_CONTROL, STREAMING, Phase, Trigger
from companion.guidance.status import GuidanceStatus, snapshot
from companion.guidance.steering import Steering
from companion.guidance.stop_rule import StopRule
from companion.guidance.vehicle import ORIGIN_STEP_M, VehicleView
from companion.guidance.waiting import WaitingReason
from companion.planning.base import Planner

TICK_S = 0.05
"""Setpoints at 20 Hz: PX4 wants more than 2 Hz, and at 20 Hz a lossy link still delivers enough."""
HEARTBEAT_PERIOD_S = 1.0
HAND_BACK_S = 1.4
"""How long the autopilot may take to confirm its hold mode: we end within 1.5 s of the request."""


class GuidanceSession:
    """Guides one vehicle to one emitter.

    Args:
        params: How the mission is flown.
        tracker: The estimate of the target.
        planner: Where to fly, given the estimate.
        guard: What may be sent.
        needs_origin: Whether setpoints are global, so that nothing flies without an origin.
    """

    def __init__(
        self,
        params: SessionParams,
        tracker: TargetTracker,
        planner: Planner[Any],
        guard: Guard,
        *,
        needs_origin: bool = False,
    ) -> None:
        self.params = params
        self.tracker = tracker
        self.vehicle = VehicleView(needs_origin=needs_origin)
        self.flight_plan = FlightPlan(planner, guard.limits.fence, tracker, params.altitude_m)
        self.steering = Steering(guard, params.altitude_m)
        self.authority = Authority()
        self.estimate: TargetEstimate | None = None
        self.result: ReportResult | None = None
        self._listener = RangingListener(tracker, self.vehicle.track)
        self._launch: Launch | None = None
        self._has_launched = False
        self._stop_rule = StopRule(params.stop_radius_m, params.stop_confirm_s)
        self._hold_reason = ""
        self._waiting = WaitingReason(self.vehicle, self.authority)
        self._tick_s: float | None = None
        self._next_heartbeat_s = -math.inf
        self._commands: list[Command] = []

    def handle(self, event: Event) -> list[Command]:
        """What is to be done about an event."""
        if isinstance(event, OriginSet):
            self._check_frame(event)
        self.vehicle.handle(event)
        match event:
            case HeartbeatReceived():
                self._on_heartbeat(event)
            case RangingReceived() if self.phase is Phase.FINISHED:
                pass  # parked on the estimate there is nothing to learn, only to unlearn
            case RangingReceived():
                self._fused(self._listener.receive(event.measurement), event.time_s)
                self._fused(self._listener.fuse_due(event.time_s), event.time_s)
            case VehicleMoved():
                self._fused(self._listener.fuse_due(event.time_s), event.time_s)
            case RequestAnswered():
                self._on_answer(event)
            case ControlGranted():
                if self._enter(Trigger.GRANTED, event.time_s):
                    text = f"granted again: switch to {self.vehicle.guided_name}"
                    self._announce(Severity.NOTICE, text)
            case AutopilotRestarted():
                self._on_restart(event.time_s)
            case StopRequested():
                self._on_stop(event.time_s)
            case TimerFired():
                self._on_tick(event.time_s)
        commands, self._commands = self._commands, []
        return commands

    @property
    def phase(self) -> Phase:
        """Where the session stands."""
        return self.authority.phase

    @property
    def is_stopped(self) -> bool:
        """Whether the process may end."""
        return self.phase is Phase.STOPPED

    def status(self, now_s: float) -> GuidanceStatus:
        """A snapshot for views and logs."""
        return snapshot(
            now_s,
            self.authority,
            self._hold_reason,
            self._launch,
            self.vehicle,
            self.flight_plan,
            self.steering,
            self.tracker,
            self.estimate,
        )

    # Phases

    def _enter(self, trigger: Trigger, now_s: float) -> bool:
        """Apply a trigger; whether the phase changed."""
        left = self.authority.enter(trigger, now_s)
        if left is None:
            return False
        self._record("phase", old=left.value, new=self.phase.value, trigger=trigger.value)
        if self.phase in OUT_OF_CONTROL:
            self._commands.append(WithdrawRequest())
        if not (left in IN_CONTROL and self.phase in STREAMING):
            self.steering.forget_setpoint()
        return True

    def _announce(self, severity: Severity, text: str) -> None:
        self._commands.append(Announce(severity, text))

    def _record(self, kind: str, **fields: object) -> None:
        self._commands.append(Record(kind, fields))

    def _ask_mode(self, mode: FlightMode) -> None:
        self._commands.append(SetMode(mode, self.vehicle.is_armed))

    def _on_heartbeat(self, event: HeartbeatReceived) -> None:
        now_s = event.time_s
        had_let_go = self.authority.has_let_go
        self.authority.observe(event)
        if self.authority.has_let_go and not had_let_go:
            self._commands.append(WithdrawRequest())
        launch = self._launch if self.phase is Phase.LAUNCHING else None
        objection = None if launch is None else launch.observe(event)
        if not event.is_armed:
            if launch is None or objection is not None:
                self._on_disarmed(event)
        elif objection is not None:
            self._enter(Trigger.MODE_LOST, now_s)
            self._announce(Severity.WARNING, f"launch ended: {objection}")
        elif event.mode is FlightMode.OFFBOARD:
            self._on_offboard(now_s)
        elif launch is None and self._enter(Trigger.MODE_LOST, now_s):
            name = self.vehicle.name_of(event.mode)
            text = f"control lost: autopilot went to {name}; silent until given back"
            self._announce(Severity.WARNING, text)

    def _on_disarmed(self, event: HeartbeatReceived) -> None:
        if self._enter(Trigger.DISARMED, event.time_s):
            self.authority.disarmed_in(event.mode)
            self._announce(Severity.NOTICE, "disarmed: the flight is over")

    def _on_offboard(self, now_s: float) -> None:
        if not (self.authority.may_take(now_s) and self.vehicle.obeys_setpoints):
            return
        is_climbing = self._launch is not None and not self._launch.is_at_offboard
        if self.phase is Phase.LAUNCHING and is_climbing:
            return
        if self._enter(Trigger.MODE_GIVEN, now_s):
            self._launch = None
            self._has_launched = True
            self._hold_reason = "checking its inputs"
            text = f"in control: autopilot is in {self.vehicle.guided_name}"
            self._announce(Severity.NOTICE, text)

    def _on_answer(self, event: RequestAnswered) -> None:
        self._record("answer", request=event.kind.value, outcome=event.outcome.value)
        if self.phase is Phase.LAUNCHING and self._launch is not None:
            self._launch.answered(event)
        elif self.phase is Phase.HANDING_BACK and event.kind is RequestKind.SET_MODE:
            if event.outcome is not Outcome.ACCEPTED:
                self._announce(Severity.ERROR, f"hand-back: {event.outcome.value}")
            self._enter(Trigger.HANDED_BACK, event.time_s)
        elif self.phase is Phase.FINISHED and event.outcome is not Outcome.ACCEPTED:
            self._announce(Severity.ERROR, f"{event.kind.value}: {event.outcome.value}")

    def _check_frame(self, event: OriginSet) -> None:
        """An origin that moved has moved every local position: start anew in the new frame."""
        step_m = self.vehicle.origin_step_m(event.origin)
        if step_m <= ORIGIN_STEP_M:
            return
        self.vehicle.forget_frame()
        self._forget_target()
        self.steering.forget_setpoint()
        self._hold_reason = "the local frame moved"
        self._enter(Trigger.INPUT_LOST, event.time_s)
        text = f"local origin moved by {step_m:.0f} m: estimate forgotten, waiting for ranging"
        self._announce(Severity.WARNING, text)

    def _forget_target(self) -> None:
        self.tracker.restart()
        self.flight_plan.forget()
        self.estimate = None

    def _on_restart(self, now_s: float) -> None:
        self.vehicle.forget()
        self._forget_target()
        self.authority.restarted()
        self._enter(Trigger.RESTARTED, now_s)
        self._announce(Severity.WARNING, "autopilot restarted: holding until the operator engages")

    def _on_stop(self, now_s: float) -> None:
        follow_up = FOLLOW_UP_MODE[self.params.on_localised]
        mode = hand_back_mode(self.authority, self.vehicle, self._launch, follow_up)
        if self._enter(Trigger.STOP, now_s) and self.phase is Phase.HANDING_BACK:
            if mode is not None:
                name = self.vehicle.name_of(mode)
                self._announce(Severity.NOTICE, f"stopping: asking the autopilot to {name}")
                self._ask_mode(mode)
            else:
                self._enter(Trigger.HANDED_BACK, now_s)

    # Measurements

    def _fused(self, reports: list[FusionReport], now_s: float) -> None:
        for report in reports:
            if report.refusal is not None:
                self._record("refused", reason=report.refusal.value)
                continue
            if report.restarted:
                text = "the filter contradicted its measurements and was started anew"
                self._announce(Severity.WARNING, text)
                self.flight_plan.forget()
            self._replan(report, now_s)

    def _replan(self, report: FusionReport, now_s: float) -> None:
        estimate = self.tracker.estimate(now_s)
        if estimate is None:
            return
        if self.estimate is None or estimate.state is not self.estimate.state:
            self._announce(Severity.INFO, f"{estimate.state.value}: R95 {estimate.r95_m:.1f} m")
        self.estimate = estimate
        self._commands.append(estimate_record(report, estimate))
        if self.phase is Phase.ENGAGED:
            self._plan_now(now_s)

    def _plan_now(self, now_s: float) -> None:
        setpoint = self.steering.setpoint_enu_m
        self._commands += self.flight_plan.renew(now_s, self.vehicle, setpoint, self.estimate)

    # The control tick

    def _on_tick(self, now_s: float) -> None:
        dt_s = TICK_S if self._tick_s is None else now_s - self._tick_s
        self._tick_s = now_s
        self._fused(self._listener.fuse_due(now_s), now_s)
        self._advance_phase(now_s)
        if self.phase is Phase.ENGAGED and self.flight_plan.is_due(now_s):
            self._plan_now(now_s)
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + HEARTBEAT_PERIOD_S
            self._commands.append(SendHeartbeat())
        setpoint = self._setpoint(now_s, dt_s)
        if setpoint is not None and GuardReason.JUMPED in self.steering.reasons:
            self._announce(Severity.WARNING, "own position jumped: going on from where it says")
        if setpoint is not None:
            self._commands.append(SendSetpoint(setpoint))

    def _advance_phase(self, now_s: float) -> None:
        match self.phase:
            case Phase.WAITING:
                reason = self._waiting.news(now_s)
                if reason is not None:
                    self._announce(Severity.WARNING, reason)
                if self.vehicle.is_usable(now_s) and self.authority.may_begin:
                    self._enter(Trigger.READY, now_s)
                    self._announce(Severity.INFO, self._standby_text())
            case Phase.STANDBY if self.params.engage == "auto" and not self._has_launched:
                self._has_launched = True
                self._launch = Launch(self.params.altitude_m, now_s)
                self._enter(Trigger.LAUNCH, now_s)
            case Phase.LAUNCHING:
                self._advance_launch(now_s)
            case Phase.ENGAGED | Phase.HOLDING:
                self._check_inputs(now_s)
            case Phase.HANDING_BACK if now_s - self.authority.since_s > HAND_BACK_S:
                self._announce(Severity.ERROR, "hand-back: not confirmed in time")
                self._enter(Trigger.HANDED_BACK, now_s)
        self._check_localised(now_s)

    def _standby_text(self) -> str:
        if self.params.engage == "auto" and not self._has_launched:
            return "ready: launching by itself"
        return f"ready: switch to {self.vehicle.guided_name} to give control"

    def _advance_launch(self, now_s: float) -> None:
        launch, heartbeat = self._launch, self.vehicle.heartbeat
        height_m, home = self.vehicle.height_m, self.vehicle.home_enu_m
        if launch is None or heartbeat is None or height_m is None or home is None:
            return
        if not self.vehicle.is_usable(now_s):
            return
        has_origin = self.vehicle.origin is not None
        view = LaunchView(now_s, heartbeat, height_m, home[2], has_origin)
        self._commands += launch.tick(view)
        if launch.failure is not None:
            self._announce(Severity.ERROR, f"launch gave up: {launch.failure}")
            self._enter(Trigger.LAUNCH_FAILED, now_s)

    def _check_inputs(self, now_s: float) -> None:
        missing = missing_input(
            self.vehicle,
            self.estimate,
            self.tracker.last_accepted_s,
            self.params.ranging_timeout_s,
            self.flight_plan.search_after_s,
            now_s,
        )
        if missing is None:
            if self._enter(Trigger.INPUT_BACK, now_s):
                self._announce(Severity.INFO, "flying the plan")
                self._plan_now(now_s)
            return
        if self._enter(Trigger.INPUT_LOST, now_s) or missing != self._hold_reason:
            self._hold_reason = missing
            self._announce(Severity.WARNING, f"hold: {missing}")

    def _check_localised(self, now_s: float) -> None:
        heard_s, patience_s = self.tracker.last_accepted_s, self.params.ranging_timeout_s
        is_fresh = heard_s is not None and now_s - heard_s <= patience_s
        flown = self.estimate if self.phase is Phase.ENGAGED and is_fresh else None
        if self._stop_rule.is_met(flown, now_s) and flown is not None:
            self._report(flown, now_s)

    def _report(self, estimate: TargetEstimate, now_s: float) -> None:
        height_m = self.tracker.params.filter.target_height_m
        self.result, text = result_of(estimate, self.vehicle.origin, height_m)
        self._commands.append(self.result)
        self._announce(Severity.NOTICE, text)
        self._enter(Trigger.LOCALISED, now_s)
        self._ask_mode(FOLLOW_UP_MODE[self.params.on_localised])

    def _setpoint(self, now_s: float, dt_s: float) -> PositionSetpoint | None:
        """The setpoint of this tick, or None where silence is due."""
        position, home = self.vehicle.position_enu_m, self.vehicle.home_enu_m
        if position is None or home is None:
            return None
        if is_silence_due(self.authority, self.vehicle, self._launch, now_s):
            return None
        match self.phase:
            case Phase.STANDBY | Phase.LAUNCHING:
                return self.steering.stay_with(position, home[2])
            case Phase.ENGAGED:
                return self.steering.follow(self.flight_plan.waypoint, position, home[2], dt_s)
            case Phase.HOLDING | Phase.FINISHED | Phase.HANDING_BACK:
                return self.steering.stay(position, home[2], dt_s)
        return None
