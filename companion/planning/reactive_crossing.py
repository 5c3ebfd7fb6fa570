"""Reactive crossing exactly as printed.

With s the vehicle, x the estimate, step eta and crossing distance l:

    |x - s| < eps_stop:  stay
    d = (x - s) / |x - s|;  c = x + l d;  v = (c - s) / |c - s|;  next = s + eta v

Note that c lies on the line from s through x, so v = d for every l > 0: the printed crossing
distance has no effect, each step simply flies at the estimate, and crossing only happens by
overshooting by less than one step. `latched_crossing` keeps the promise; this one is kept for
comparison.

Paper: Algorithm 1. Deviation: the next point and the leg to it are kept in free space.
"""

from __future__ import annotations

import math

from companion.domain import Waypoint, WaypointReason
from companion.kernel import kernel
from companion.params import NonNegative, Params, Positive
from companion.planning.base import Plan, PlanRequest
from companion.planning.directions import direction
from companion.planning.routing import held, kept_inside, routed


class ReactiveCrossingParams(Params, frozen=True):
    """Parameters of Algorithm 1, with the paper's values."""

    step_m: Positive = 5.0
    crossing_distance_m: Positive = 20.0
    stop_distance_m: NonNegative = 0.0
    """eps_stop; above zero the vehicle parks on its estimate and stops learning."""


@kernel
def reactive_step(
    east_m: float,
    north_m: float,
    target_east_m: float,
    target_north_m: float,
    step_m: float,
    crossing_distance_m: float,
    stop_distance_m: float,
) -> tuple[float, float]:
    """The next place of a vehicle; its own where it is closer than the stop distance.

    Paper: Algorithm 1.
    """
    if math.hypot(target_east_m - east_m, target_north_m - north_m) < stop_distance_m:
        return east_m, north_m
    d_east, d_north = direction(east_m, north_m, target_east_m, target_north_m)
    crossing_east_m = target_east_m + crossing_distance_m * d_east
    crossing_north_m = target_north_m + crossing_distance_m * d_north
    v_east, v_north = direction(east_m, north_m, crossing_east_m, crossing_north_m)
    return east_m + step_m * v_east, north_m + step_m * v_north


class ReactiveCrossing:
    """Algorithm 1 of the paper; it needs no memory."""

    search_after_s: float | None = None

    def __init__(self, params: ReactiveCrossingParams) -> None:
        self.params = params

    def initial_memory(self) -> None:
        """Nothing to remember."""

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """One step of the printed algorithm."""
        if request.estimate is None:
            return Plan(held(request, "no estimate yet"), memory)
        p, vehicle = self.params, request.vehicle_enu_m
        estimate = request.estimate.position_enu_m
        target = reactive_step(
            *vehicle, *estimate, p.step_m, p.crossing_distance_m, p.stop_distance_m
        )
        if target == vehicle:
            return Plan(held(request, "close to the estimate"), memory)
        target = kept_inside(target, vehicle, request)
        waypoint = Waypoint(target, WaypointReason.CROSSING, "one step, as printed")
        return Plan(routed(request, waypoint), memory)
