"""A snapshot of the session for views and logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.domain import FlightMode, PositionEnu, TargetEstimate, Waypoint
from companion.estimation.innovation_noise import TrackerHealth
from companion.guidance.situation import Situation
from companion.guidance.states import Phase


@dataclass(frozen=True, slots=True)
class GuidanceStatus:
    """Everything an operator may want to see, as of `time_s`."""

    time_s: float
    phase: Phase
    detail: str
    """Why it holds or waits, in words."""
    mode: FlightMode
    is_armed: bool
    is_link_lost: bool
    vehicle_enu_m: PositionEnu | None
    height_m: float | None
    distance_m: float
    estimate: TargetEstimate | None
    waypoint: Waypoint | None
    setpoint_enu_m: PositionEnu | None
    guard: tuple[str, ...]
    """Why the setpoint is not where the planner wanted it."""
    health: TrackerHealth
    """How far the estimate can be trusted."""
    accepted: int
    refused: Mapping[str, int]
    reasons: Mapping[str, int]
    """How often each reason kept it from flying the plan at full speed, or at all."""
    internal_errors: Mapping[str, int]
    """Errors of the companion's own parts, which were contained."""
    battery_pct: float | None
    """0 to 100; None: unknown."""


def snapshot(now_s: float, situation: Situation) -> GuidanceStatus:
    """The status that the parts of a session add up to."""
    vehicle, steering, tracker = situation.vehicle, situation.steering, situation.tracker
    return GuidanceStatus(
        time_s=now_s,
        phase=situation.phase,
        detail=_detail(situation),
        mode=vehicle.mode,
        is_armed=vehicle.is_armed,
        is_link_lost=vehicle.is_link_lost(now_s),
        vehicle_enu_m=vehicle.position_enu_m,
        height_m=vehicle.height_m,
        distance_m=vehicle.distance_m,
        estimate=situation.estimate,
        waypoint=situation.flight_plan.waypoint,
        setpoint_enu_m=steering.setpoint_enu_m,
        guard=tuple(reason.value for reason in steering.reasons),
        health=tracker.health,
        accepted=tracker.accepted,
        refused={reason.value: count for reason, count in tracker.refusals.items()},
        internal_errors=dict(situation.containment.errors),
        battery_pct=vehicle.battery_pct,
        reasons={reason.value: count for reason, count in situation.reasons.items()},
    )


def _detail(situation: Situation) -> str:
    """Why it waits or holds, how far the launch is, or what it flies at."""
    phase, launch = situation.phase, situation.launch
    waypoint = situation.flight_plan.waypoint
    if phase is Phase.WAITING and not situation.authority.may_begin:
        guided_name = situation.vehicle.guided_name
        return f"found in {guided_name} or in a failsafe: change its mode, or grant control"
    if phase in (Phase.DEGRADED, Phase.HOLD) and situation.finding is not None:
        return situation.finding.text
    if phase is Phase.LAUNCHING and launch is not None:
        return launch.stage.value
    if phase is Phase.NORMAL and waypoint is not None:
        return f"{waypoint.reason.value}: {waypoint.detail}"
    return ""
