"""Latched crossing: fly over the estimate to a point on its far side, and only then turn.

Theory of operation. Bilateral information needs views from both sides of the target, so the far
point must really be flown to: it is *latched* until it is reached, until the estimate lies behind
by as much as is still needed, or until the estimate has moved by more than the latch can mean. Its
distance beyond the estimate (the overshoot) follows the uncertainty,
clip(3 sqrt(lambda_max(P)), 2 m, 20 m): wide while little is known, tight at the end, where a short
base line makes bearings strong. Without bearings it is not shorter than the base line that ranges
need. Each new crossing turns by the golden angle, so that any number of
crossings covers all directions evenly, without planning and at O(1) cost.

Paper: section V-A and Appendix C, with the crossing distance made real (Algorithm 1 as printed
does not depend on it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from companion.domain import Point, Waypoint, WaypointReason
from companion.params import Params, Positive
from companion.planning.base import Plan, PlanRequest
from companion.planning.keepin import kept_inside, unit

GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
FENCE_TRIES = 5
"""Directions tried before a crossing cut short by the fence is accepted."""


class LatchedCrossingParams(Params, frozen=True):
    """Overshoot and when a crossing counts as flown."""

    overshoot_sigmas: Positive = 3.0
    """Overshoot in standard deviations of the worst direction."""
    overshoot_min_m: Positive = 2.0
    overshoot_max_m: Positive = 20.0
    arrival_radius_m: Positive = 1.5
    """The crossing point counts as reached within this distance."""
    reaim_distance_m: Positive = 3.0
    """A move of the estimate by more than this, or half the overshoot, aims anew."""

    def __post_init__(self) -> None:
        """Refuse an empty band for the overshoot."""
        if self.overshoot_min_m > self.overshoot_max_m:
            raise ValueError("overshoot_min_m must not exceed overshoot_max_m")


@dataclass(frozen=True, slots=True)
class Latch:
    """The crossing being flown."""

    point_enu_m: Point
    estimate_enu_m: Point
    """The estimate when the crossing was chosen."""
    direction: Point
    """Unit vector from the estimate to the crossing point."""
    start_enu_m: Point
    """Where the vehicle was when the crossing was chosen."""
    overshoot_m: float
    crossings: int
    """Crossings flown to their end so far."""


class LatchedCrossing:
    """The default planner."""

    def __init__(self, params: LatchedCrossingParams) -> None:
        self.params = params

    def initial_memory(self) -> Latch | None:
        """No crossing chosen yet."""
        return None

    def plan(self, request: PlanRequest, memory: Latch | None) -> Plan[Latch | None]:
        """The crossing in flight, or the next one."""
        vehicle, estimate = request.vehicle_enu_m, request.estimate.position_enu_m
        if memory is None:
            return self._latched(request, unit(vehicle, estimate), 0)
        if self._is_flown(request, memory):
            return self._latched(request, _turned(memory.direction), memory.crossings + 1)
        moved_m = math.dist(estimate, memory.estimate_enu_m)
        if moved_m > max(self.params.reaim_distance_m, 0.5 * memory.overshoot_m):
            return self._latched(request, memory.direction, memory.crossings)
        return Plan(self._waypoint(request, memory), memory)

    def _latched(
        self, request: PlanRequest, direction: Point, crossings: int
    ) -> Plan[Latch | None]:
        """Choose a crossing; directions that the fence cuts short are turned on first."""
        overshoot_m = self._overshoot_m(request)
        anchor = kept_inside(
            request.estimate.position_enu_m,
            request.vehicle_enu_m,
            request.fence_enu_m,
            request.fence_margin_m,
        )
        best: Latch | None = None
        best_length_m = -1.0
        for _ in range(FENCE_TRIES):
            far = (
                anchor[0] + overshoot_m * direction[0],
                anchor[1] + overshoot_m * direction[1],
            )
            point = kept_inside(far, anchor, request.fence_enu_m, request.fence_margin_m)
            length_m = math.dist(anchor, point)
            if length_m > best_length_m:
                estimate = request.estimate.position_enu_m
                best = Latch(
                    point, estimate, direction, request.vehicle_enu_m, overshoot_m, crossings
                )
                best_length_m = length_m
            if length_m >= 0.9 * overshoot_m:
                break
            direction = _turned(direction)
        assert best is not None
        if math.dist(request.vehicle_enu_m, best.point_enu_m) <= self.params.arrival_radius_m:
            best = replace(best, direction=_turned(best.direction))
        return Plan(self._waypoint(request, best), best)

    def _is_flown(self, request: PlanRequest, latch: Latch) -> bool:
        """Whether the point is reached, or the estimate is left behind by its present overshoot.

        The latch was chosen when less was known; once a shorter overshoot will do, the rest of a
        long one would only cost time.
        """
        vehicle, estimate = request.vehicle_enu_m, request.estimate.position_enu_m
        if math.dist(vehicle, latch.point_enu_m) <= self.params.arrival_radius_m:
            return True
        overshoot_m = self._overshoot_m(request)
        started_m = _along(latch.direction, estimate, latch.start_enu_m)
        return started_m < overshoot_m <= _along(latch.direction, estimate, vehicle)

    def _overshoot_m(self, request: PlanRequest) -> float:
        (a, b), (_, c) = request.estimate.covariance_m2
        largest = 0.5 * (a + c) + math.hypot(0.5 * (a - c), b)
        p = self.params
        wanted = p.overshoot_sigmas * math.sqrt(max(largest, 0.0))
        least = max(p.overshoot_min_m, min(request.baseline_m, p.overshoot_max_m))
        return min(max(wanted, least), p.overshoot_max_m)

    def _waypoint(self, request: PlanRequest, latch: Latch) -> Waypoint:
        vehicle, estimate = request.vehicle_enu_m, latch.estimate_enu_m
        is_ahead = _along(unit(vehicle, latch.point_enu_m), vehicle, estimate) > 0.0
        is_approach = is_ahead and math.dist(vehicle, estimate) > latch.overshoot_m
        reason = WaypointReason.APPROACH if is_approach else WaypointReason.CROSSING
        detail = f"crossing {latch.crossings + 1}, {latch.overshoot_m:.1f} m beyond the estimate"
        return Waypoint(latch.point_enu_m, reason, detail)


def _along(direction: Point, start: Point, end: Point) -> float:
    """How far `end` is from `start` in a direction (a unit vector)."""
    return (end[0] - start[0]) * direction[0] + (end[1] - start[1]) * direction[1]


def _turned(direction: Point) -> Point:
    c, s = math.cos(GOLDEN_ANGLE_RAD), math.sin(GOLDEN_ANGLE_RAD)
    return (c * direction[0] - s * direction[1], s * direction[0] + c * direction[1])
