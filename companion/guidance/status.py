"""A snapshot of the session for views and logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.domain import FlightMode, PositionEnu, TargetEstimate, Waypoint
from companion.estimation.innovation_noise import TrackerHealth
from companion.estimation.tracker import TargetTracker
from companion.guidance.authority import Authority
from companion.guidance.flight_plan import FlightPlan
from companion.guidance.launch import Launch
from companion.guidance.states import Phase
from companion.guidance.steering import Steering
from companion.guidance.vehicle import VehicleView


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


def snapshot(
    now_s: float,
    authority: Authority,
    hold_reason: str,
    launch: Launch | None,
    vehicle: VehicleView,
    flight_plan: FlightPlan,
    steering: Steering,
    tracker: TargetTracker,
    estimate: TargetEstimate | None,
) -> GuidanceStatus:
    """The status that the parts of a session add up to."""
    return GuidanceStatus(
        time_s=now_s,
        phase=authority.phase,
        detail=_detail(authority, hold_reason, launch, flight_plan.waypoint, vehicle.guided_name),
        mode=vehicle.mode,
        is_armed=vehicle.is_armed,
        is_link_lost=vehicle.is_link_lost(now_s),
        vehicle_enu_m=vehicle.position_enu_m,
        height_m=vehicle.height_m,
        distance_m=vehicle.distance_m,
        estimate=estimate,
        waypoint=flight_plan.waypoint,
        setpoint_enu_m=steering.setpoint_enu_m,
        guard=tuple(reason.value for reason in steering.reasons),
        health=tracker.health,
        accepted=tracker.accepted,
        refused={reason.value: count for reason, count in tracker.refusals.items()},
    )


def _detail(
    authority: Authority,
    hold_reason: str,
    launch: Launch | None,
    waypoint: Waypoint | None,
    guided_name: str,
) -> str:
    """Why it waits or holds, how far the launch is, or what it flies at."""
    phase = authority.phase
    if phase is Phase.WAITING and not authority.may_begin:
        return f"found in {guided_name} or in a failsafe: change its mode, or grant control"
    if phase is Phase.HOLDING:
        return hold_reason
    if phase is Phase.LAUNCHING and launch is not None:
        return launch.stage.value
    if phase is Phase.ENGAGED and waypoint is not None:
        return f"{waypoint.reason.value}: {waypoint.detail}"
    return ""
