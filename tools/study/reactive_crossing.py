"""Reactive crossing, Algorithm 1 of the paper, for comparison.

With s the vehicle, x the estimate, step eta and distance l:

    |x - s| < eps_stop:  stay
    d = (x - s) / |x - s|;  c = x + l d;  v = (c - s) / |c - s|;  next = s + eta v

c lies on the line from s through x, so v = d for every l > 0: the printed crossing distance has no
effect, and crossing only happens by overshooting by less than one step.

Deviation: the next point and the leg to it are kept in free space.
"""

from __future__ import annotations

import math

from companion.domain import Waypoint, WaypointReason
from companion.geometry.polygons import Point
from companion.kernel import kernel
from companion.planning.planner import Plan, PlanRequest, hold_position, kept_inside, route_to
from companion.planning.views import direction
from tools.study.case import Case


@kernel
def reactive_step(
    vehicle: Point, target: Point, step_m: float, crossing_distance_m: float, stop_distance_m: float
) -> Point:
    """Return the next position; the vehicle's own within the stop distance. Paper: Algorithm 1."""
    (east_m, north_m), (target_east_m, target_north_m) = vehicle, target
    if math.hypot(target_east_m - east_m, target_north_m - north_m) < stop_distance_m:
        return vehicle
    d_east, d_north = direction(vehicle, target)
    crossing_east_m = target_east_m + crossing_distance_m * d_east
    crossing_north_m = target_north_m + crossing_distance_m * d_north
    v_east, v_north = direction(vehicle, (crossing_east_m, crossing_north_m))
    return east_m + step_m * v_east, north_m + step_m * v_north


class ReactiveCrossing:
    """Algorithm 1 of the paper with the parameters of a case; it needs no memory."""

    search_after_s: float | None = None

    def __init__(self, case: Case) -> None:
        self.case = case

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """Return one step of the printed algorithm."""
        if request.estimate is None:
            return Plan(hold_position(request, "no estimate yet"), memory)
        case, vehicle = self.case, request.vehicle_enu_m
        estimate = request.estimate.position_enu_m
        far_m, stop_m = case.crossing_distance_m, case.stop_distance_m
        target = reactive_step(vehicle, estimate, case.step_m, far_m, stop_m)
        if target == vehicle:
            return Plan(hold_position(request, "close to the estimate"), memory)
        target = kept_inside(target, vehicle, request)
        waypoint = Waypoint(target, WaypointReason.CROSSING, "one step, as printed")
        return Plan(route_to(request, waypoint), memory)
