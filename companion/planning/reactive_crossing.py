"""Reactive crossing exactly as printed.

With s the vehicle, x the estimate, step eta and crossing distance l:

    |x - s| < eps_stop:  stay
    d = (x - s) / |x - s|;  c = x + l d;  v = (c - s) / |c - s|;  next = s + eta v

Note that c lies on the line from s through x, so v = d for every l > 0: the printed crossing
distance has no effect, each step simply flies at the estimate, and crossing only happens by
overshooting by less than one step. `latched_crossing` keeps the promise; this one is kept for
comparison.

Paper: Algorithm 1. Deviation: the next point is kept inside the fence.
"""

from __future__ import annotations

import math

from companion.domain import Waypoint, WaypointReason
from companion.params import NonNegative, Params, Positive
from companion.planning.base import Plan, PlanRequest
from companion.planning.keepin import kept_inside, unit


class ReactiveCrossingParams(Params, frozen=True):
    """Parameters of Algorithm 1, with the paper's values."""

    step_m: Positive = 5.0
    crossing_distance_m: Positive = 20.0
    stop_distance_m: NonNegative = 0.0
    """eps_stop; above zero the vehicle parks on its estimate and stops learning."""


class ReactiveCrossing:
    """Algorithm 1 of the paper; it needs no memory."""

    def __init__(self, params: ReactiveCrossingParams) -> None:
        self.params = params

    def initial_memory(self) -> None:
        """Nothing to remember."""

    def plan(self, request: PlanRequest, memory: None) -> Plan[None]:
        """One step of the printed algorithm."""
        vehicle, estimate = request.vehicle_enu_m, request.estimate.position_enu_m
        if math.dist(vehicle, estimate) < self.params.stop_distance_m:
            here = kept_inside(vehicle, vehicle, request.fence_enu_m, request.fence_margin_m)
            return Plan(Waypoint(here, WaypointReason.HOLD, "close to the estimate"), memory)
        d = unit(vehicle, estimate)
        length = self.params.crossing_distance_m
        crossing = (estimate[0] + length * d[0], estimate[1] + length * d[1])
        v = unit(vehicle, crossing)
        step = self.params.step_m
        target = (vehicle[0] + step * v[0], vehicle[1] + step * v[1])
        target = kept_inside(target, vehicle, request.fence_enu_m, request.fence_margin_m)
        return Plan(Waypoint(target, WaypointReason.CROSSING, "one step, as printed"), memory)
