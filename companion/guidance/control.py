"""The control tick: tasks due, phase and setpoint."""

from __future__ import annotations

import math

from companion.domain import PositionEnu, PositionSetpoint
from companion.guard.gate import GuardReason
from companion.guidance.commands import SendHeartbeat, SendSetpoint, Severity, Topic
from companion.guidance.context import SessionContext
from companion.guidance.control_authority import FOLLOW_UP_S, Finding, Reason, Verdict
from companion.guidance.handover import Handover
from companion.guidance.health.autopilot_health import HAND_BACK_AFTER_S
from companion.guidance.health.watches import Watches
from companion.guidance.launch import LaunchView
from companion.guidance.measurements import EmitterScheduler
from companion.guidance.messages import FenceMessages, GuardMessages
from companion.guidance.phases import FLYING, IN_CONTROL, STREAMING, Phase, Trigger
from companion.guidance.readiness import LaunchPermit, WaitingReason, missing_inputs
from companion.guidance.reporting import REACHED_M, Reporting

TICK_S = 0.05
"""Setpoint rate of 20 Hz: PX4 needs 2 Hz, and a lossy link still delivers enough of 20."""
HEARTBEAT_PERIOD_S = 1.0
READY_AGAIN_S = 3.0
"""Longest interruption that is not announced each time."""
UNMONITORED = (Phase.LAUNCHING, Phase.FINISHED, Phase.HANDBACK)
"""Phases that send setpoints but ignore the findings."""
TRACK_STEP_M = 0.5
"""Minimum distance between logged positions: a hovering vehicle wanders by as much."""
NO_FAULTS = frozenset({Reason.CHECKING, Reason.NO_RANGING_YET, Reason.RANGING_IS_BACK})
"""Reasons to wait whose end needs no words."""
SILENCE_S = 0.3
"""Longest pause of the setpoints after which they continue; after a longer one the first setpoint
is the vehicle's position, because it may have moved."""


class StandstillWatch:
    """Warns once if the vehicle hovers away from its setpoint, and again after it has moved.

    An ArduPilot that is paused in GUIDED stands still and echoes every setpoint.
    """

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._stood_enu_m: PositionEnu | None = None
        """Position from which the vehicle has not moved; None: out of control."""
        self._away_since_s = 0.0
        """Time since which the setpoint has been away from the vehicle."""
        self._is_announced = False

    def step(self, now_s: float) -> None:
        """Advance by a second."""
        context, vehicle = self._context, self._context.vehicle
        phase, stood = context.authority.phase, self._stood_enu_m
        position = vehicle.position_enu_m
        setpoint = context.steering.setpoint_enu_m if phase in FLYING else None
        if phase not in IN_CONTROL or position is None:
            self._stood_enu_m = None
            return
        if stood is None or math.dist(position, stood) > REACHED_M:
            self._stood_enu_m, self._away_since_s, self._is_announced = position, now_s, False
        if setpoint is None or math.dist(position, setpoint) <= REACHED_M:
            self._away_since_s = now_s
        slowest_s = HAND_BACK_AFTER_S + REACHED_M / context.guard.limits.envelope.speed_mps
        if not self._is_announced and now_s - self._away_since_s > slowest_s:
            self._is_announced = True
            context.warn("vehicle does not follow: paused? reselect the mode")


class ControlTick:
    """Runs 20 times a second; only this class sends heartbeats and setpoints."""

    def __init__(
        self,
        context: SessionContext,
        watches: Watches,
        handover: Handover,
        scheduler: EmitterScheduler,
    ) -> None:
        self._context = context
        self._watches = watches
        self._handover = handover
        self.reporting = Reporting(context, watches.battery, scheduler)
        self._permit = LaunchPermit(context)
        self._waiting = WaitingReason(context.vehicle, context.authority, context.fencing)
        self._standstill = StandstillWatch(context)
        self._guard_messages = GuardMessages()
        self._fence_messages = FenceMessages()
        self._logged_enu_m: PositionEnu | None = None
        self._tick_s: float | None = None
        self._next_heartbeat_s = -math.inf
        self._sent_s = -math.inf
        self._missing_s = -math.inf
        """Last time at which an input of control was missing."""
        self._is_silent = True
        """True if silence was due at the last tick."""

    def run(self, now_s: float) -> None:
        """Decide the phase, and send the heartbeat and the setpoint that are due."""
        context = self._context
        dt_s = TICK_S if self._tick_s is None else now_s - self._tick_s
        self._tick_s = now_s
        finding = self._watches.step(now_s)
        self._search(now_s)
        self._advance_phase(finding, now_s)
        if context.guard.limits.fence is not self._fence_messages.logged:
            fence = self._fence_messages.record(context.guard.limits.fence)
            if fence is not None:
                context.record("fence", **fence)
        position = context.vehicle.position_enu_m
        logged = self._logged_enu_m
        if position is not None and (
            logged is None or not math.dist(position, logged) < TRACK_STEP_M
        ):
            self._logged_enu_m = position
            context.record("position", position_enu_m=tuple(round(each, 2) for each in position))
        phase = context.authority.phase
        if phase in FLYING and context.flight_plan.is_due(now_s):
            context.plan_now(now_s)
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + HEARTBEAT_PERIOD_S
            context.send(SendHeartbeat())
            self._standstill.step(now_s)
        is_known = self._is_silent or context.vehicle.is_position_fresh(now_s)
        if is_known and now_s - self._sent_s > SILENCE_S:  # the last setpoint is safer
            context.steering.forget_setpoint()  # while the position is stale
        setpoint = self._setpoint(now_s, dt_s)
        if phase not in IN_CONTROL:
            self._announce_stop(now_s, is_stopping=setpoint is None and not self._is_silent)
        self._is_silent = setpoint is None
        if setpoint is None:
            return
        self._sent_s = now_s
        reasons = context.steering.reasons
        if phase in IN_CONTROL and (reasons or self._guard_messages.logged):
            self._announce_guard_reasons(reasons, now_s)
        context.send(SendSetpoint(setpoint))
        self._watches.echo.note_setpoint(setpoint.position_enu_m, now_s)

    def _search(self, now_s: float) -> None:
        """Count the time in which the radio listens for an emitter that was not heard."""
        context, fence = self._context, self._context.guard.limits.fence
        if context.searching.is_over or context.authority.phase is Phase.FINISHED:
            return  # measurements are ignored from then on
        area = None if fence is None else tuple(fence.polygon_enu_m)
        progress = context.emitters.progress
        problem = context.searching.tick(now_s, context.vehicle, area, progress)
        if problem is not None:
            context.warn(problem)

    def _announce_stop(self, now_s: float, *, is_stopping: bool) -> None:
        """Announce why setpoints stop, or control is unavailable, unless a finding does."""
        context, vehicle = self._context, self._context.vehicle
        missing = self._watches.inputs.missing(now_s)
        if missing is None and context.authority.phase is Phase.STANDBY:
            missing = self._unready(now_s)
        if missing is not None:
            self._missing_s = now_s
        if context.authority.phase is Phase.STANDBY:
            is_settling = missing is None and now_s - self._missing_s < READY_AGAIN_S
            if is_settling or not context.record_finding(missing, now_s):
                return
            if missing is None:
                guided = vehicle.guided_name
                context.announce(Severity.INFO, f"ready again: switch to {guided}", Topic.READINESS)
                return
            text = f"not ready: {missing.text}"
            if is_stopping:
                text += "; setpoints stopped"
            context.warn(text, Topic.READINESS)
        elif is_stopping and context.authority.phase in UNMONITORED:
            if missing is not None:
                context.warn(f"setpoints stopped: {missing.text}")
            elif vehicle.is_ours:
                mode = vehicle.guided_name
                context.warn(f"setpoints stopped in {mode}: choose a mode")

    def _unready(self, now_s: float) -> Finding | None:
        """Return a finding about inputs that only control needs, or None."""
        names = missing_inputs(self._context.vehicle, self._context.fencing, now_s)
        if not names:
            return None
        return Finding(Verdict.HOLD, Reason.INPUT_MISSING, f"waiting for {' and '.join(names)}")

    def _announce_guard_reasons(self, reasons: tuple[GuardReason, ...], now_s: float) -> None:
        for text in self._guard_messages.texts(reasons, now_s):
            self._context.warn(text)
        names = self._guard_messages.record(reasons, now_s)
        if names is not None:
            self._context.record("guard", reasons=names)

    def _advance_phase(self, finding: Finding | None, now_s: float) -> None:
        """Advance the phase by the finding of the watches, if they have one that counts in it."""
        context = self._context
        if context.authority.phase in (Phase.WAITING, Phase.STANDBY):
            self._permit.tick(now_s)
        match context.authority.phase:
            case Phase.YIELD:
                # announce "ready" as a NOTICE, which bypasses the rate limit
                if self._handover.is_yield_over(now_s):
                    self._wait(now_s, Severity.NOTICE)
            case Phase.WAITING:
                self._wait(now_s)
            case Phase.STANDBY if not context.fencing.is_ready:
                context.enter(Trigger.FENCE_LOST, now_s)
            case Phase.STANDBY if self._permit.is_given:
                context.begin_launch(now_s)
            case Phase.LAUNCHING:
                self._advance_launch(finding, now_s)
            case Phase.NORMAL | Phase.DEGRADED | Phase.HOLD:
                self._apply_finding(finding, now_s)
            case Phase.HANDBACK:
                self._handover.continue_hand_back(now_s)
        self.reporting.tick(now_s)

    def _wait(self, now_s: float, severity: Severity = Severity.INFO) -> None:
        context = self._context
        reason = self._waiting.due_text(now_s)
        if reason is not None:
            context.warn(reason, Topic.READINESS)
        authority = context.authority
        vehicle, fencing = context.vehicle, context.fencing
        is_ready = vehicle.objection is None and fencing.refusal is None
        is_ready = is_ready and not missing_inputs(vehicle, fencing, now_s)
        is_ready = is_ready and authority.knows_mode
        if is_ready and authority.may_begin and not authority.has_id_conflict(now_s):
            context.enter(Trigger.READY, now_s)
            guided = f"ready: switch to {context.vehicle.guided_name} to hand over"
            text = "ready: automatic takeoff begins" if context.is_launch_wanted else guided
            context.announce(severity, text, Topic.READINESS)

    def _advance_launch(self, finding: Finding | None, now_s: float) -> None:
        context = self._context
        launch, vehicle = context.launch, context.vehicle
        heartbeat, height_m, home = vehicle.heartbeat, vehicle.height_m, vehicle.home_enu_m
        if launch is None:
            return
        if finding is not None:
            launch.note_problem(finding.text, now_s)
        elif heartbeat is None or height_m is None or home is None or not vehicle.is_usable(now_s):
            launch.wait(now_s)
        else:
            most_m = context.guard.limits.envelope.altitude_max_m
            launch.altitude_m = min(launch.altitude_m, most_m)  # the fence may have just been read
            has_origin = vehicle.origin is not None
            view = LaunchView(now_s, heartbeat, height_m, home[2], has_origin)
            context.send(*launch.tick(view))
        if launch.failure is not None:
            context.announce(Severity.ERROR, f"takeoff aborted: {launch.failure}")
            context.enter(Trigger.LAUNCH_FAILED, now_s)

    def _apply_finding(self, finding: Finding | None, now_s: float) -> None:
        """Follow the plan, slow down, hold, or end control, by the worst finding now."""
        context = self._context
        if finding is not None and finding.verdict is Verdict.HAND_BACK:
            finding = self._handover.hold_if_unconfirmed(finding, now_s)
        before = context.finding_messages.announced
        is_new = context.record_finding(finding, now_s)
        if finding is None:
            if context.authority.phase is not Phase.NORMAL and context.enter(
                Trigger.INPUT_BACK, now_s
            ):
                context.plan_now(now_s)
            if is_new:
                context.announce(Severity.INFO, _resumed_text(before), Topic.PLAN)
            return
        match finding.verdict:
            case Verdict.SLOW:
                context.enter(Trigger.INPUT_AGES, now_s)
            case Verdict.HOLD:
                context.enter(Trigger.INPUT_LOST, now_s)
            case Verdict.HAND_BACK:
                self._handover.hand_back(finding, now_s)
                self._watches.note_handback(finding)
                return
            case Verdict.YIELD:
                self._handover.yield_control(finding, now_s)
                return
        if is_new:
            word = "degraded" if finding.verdict is Verdict.SLOW else "hold"
            context.warn(f"{word}: {finding.text}", Topic.PLAN)

    def _setpoint(self, now_s: float, dt_s: float) -> PositionSetpoint | None:
        """Return the setpoint of this tick, or None where silence is due."""
        context = self._context
        steering, vehicle = context.steering, context.vehicle
        motion = vehicle.motion
        if motion is None:
            return None
        if self._is_silence_due(now_s):
            return None
        is_fresh = vehicle.is_position_fresh(now_s)
        match context.authority.phase:
            case Phase.STANDBY | Phase.LAUNCHING if vehicle.is_ours:
                # granted before the mode was left, or an input is missing: following the vehicle
                # would follow its drift
                return steering.hold(motion, dt_s)
            case Phase.STANDBY | Phase.LAUNCHING:
                return steering.hold_at_vehicle(motion)
            case Phase.NORMAL | Phase.DEGRADED:
                limit_mps = context.guard.limits.envelope.speed_mps
                cap_mps = limit_mps * self._watches.inputs.speed_share(now_s)
                return steering.follow(context.flight_plan.waypoint, motion, dt_s, cap_mps)
            case Phase.HOLD | Phase.FINISHED | Phase.HANDBACK:
                if steering.setpoint_enu_m is None and not is_fresh:
                    return None  # the only known position is out of date
                if self._watches.jumps.is_in_doubt or not is_fresh:
                    return steering.freeze(motion)
                return steering.hold(motion, dt_s)
        return None

    def _is_silence_due(self, now_s: float) -> bool:
        """Return True if no setpoint may be sent at this tick."""
        context, authority = self._context, self._context.authority
        vehicle, launch, phase = context.vehicle, context.launch, authority.phase
        if phase not in STREAMING or not vehicle.mode_watch.is_known(now_s):
            return True
        if phase is Phase.FINISHED:
            return authority.has_left_offboard or now_s - authority.since_s > FOLLOW_UP_S
        if phase is Phase.STANDBY:
            return not (vehicle.wants_prestream and vehicle.is_position_fresh(now_s))
        if phase is Phase.LAUNCHING:
            return launch is None or not launch.wants_stream
        return False


def _resumed_text(before: Finding | None) -> str:
    """Return the text for resuming the plan after the last announced finding."""
    if before is None or before.reason in NO_FAULTS:
        return "following the plan"
    return f"following the plan; cleared: {before.text.partition(':')[0]}"
