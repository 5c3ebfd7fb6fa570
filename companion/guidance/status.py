"""A snapshot of the session for views and logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.domain import FlightMode, PositionEnu, TargetEstimate, Waypoint
from companion.estimation.innovation_noise import TrackerHealth
from companion.guidance.situation import Situation
from companion.guidance.states import Phase


@dataclass(frozen=True, slots=True)
class EmitterStatus:
    """What is known of one emitter."""

    emitter_id: int
    estimate: TargetEstimate | None
    is_current: bool
    """Whether it is looked for now."""
    is_reported: bool


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
    """Of the emitter that is looked for now."""
    emitters: tuple[EmitterStatus, ...]
    """All that were heard or listed."""
    waypoint: Waypoint | None
    setpoint_enu_m: PositionEnu | None
    guard: tuple[str, ...]
    """Why the setpoint is not where the planner wanted it."""
    is_target_outside: bool
    """Whether the target is believed to be where the vehicle may not go."""
    health: TrackerHealth
    """How far the estimate can be trusted."""
    objection: str | None
    """Why the estimate must not be flown on, in words."""
    range_age_s: float | None
    """How old the newest range is that agrees with the estimate; None: there was none yet."""
    bearing_age_s: float | None
    """The same of bearings."""
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
    objection = tracker.objection(now_s)
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
        emitters=emitter_statuses(situation, now_s),
        waypoint=situation.flight_plan.waypoint,
        setpoint_enu_m=steering.setpoint_enu_m,
        guard=tuple(reason.value for reason in steering.reasons),
        is_target_outside=situation.flight_plan.is_target_outside,
        health=tracker.health,
        objection=None if objection is None else objection.value,
        range_age_s=tracker.contact.range_age_s(now_s),
        bearing_age_s=tracker.contact.bearing_age_s(now_s),
        accepted=situation.emitters.accepted,
        refused={reason.value: count for reason, count in situation.emitters.refusals.items()},
        internal_errors=dict(situation.containment.errors),
        battery_pct=vehicle.battery_pct,
        reasons={reason.value: count for reason, count in situation.reasons.items()},
    )


def emitter_statuses(situation: Situation, now_s: float) -> tuple[EmitterStatus, ...]:
    """What is known of every emitter that was heard or listed."""
    current = situation.tracker
    return tuple(
        EmitterStatus(
            tracker.emitter_id,
            situation.estimate if tracker is current else tracker.estimate(now_s),
            is_current=tracker is current,
            is_reported=tracker.emitter_id in situation.reports,
        )
        for tracker in situation.emitters.trackers
        if tracker.emitter_id is not None
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
