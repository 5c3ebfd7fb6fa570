"""Arithmetic of the crossing planners, as kernels.

Points and unit vectors are east and north, metres. A latch is the memory of `LatchedCrossing` of
the current crossing. The class chooses among directions by these
kernels. Source: see `crossing`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.geometry.polygons import Point
from companion.kernel import kernel

MIN_DISTANCE_M = 1e-9
"""Distance below which the direction from one point to another is undefined."""
PUSHED_M = 0.01
"""Excess of a point's distance over its overshoot that shows that a keep-out pushed it."""


@kernel
def direction(start: Point, end: Point) -> Point:
    """Return the unit vector from one point to another; east where they coincide."""
    east, north = end[0] - start[0], end[1] - start[1]
    distance = math.hypot(east, north)
    if distance < MIN_DISTANCE_M:
        return 1.0, 0.0
    return east / distance, north / distance


@kernel
def turned(vector: Point, angle_rad: float) -> Point:
    """Return a vector turned counter-clockwise."""
    (east, north), c, s = vector, math.cos(angle_rad), math.sin(angle_rad)
    return c * east - s * north, s * east + c * north


GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
"""Turn between crossings: any number of them covers all directions evenly."""


class Latch(NamedTuple):
    """Crossing that is being flown."""

    point_enu_m: Point
    """End of the crossing."""
    estimate_enu_m: Point
    """Estimate when the crossing was chosen."""
    direction: Point
    """Unit vector from the estimate to the far side."""
    start_enu_m: Point
    """Vehicle position when the crossing was chosen."""
    overshoot_m: float
    crossings: int
    """Number of completed crossings."""
    descent_m: float
    """Search altitude less the height of the crossing."""

    @property
    def pushed_m(self) -> float:
        """Distance of the point beyond the estimate if a keep-out pushed it there, otherwise 0."""
        (point_east, point_north), (east, north) = self.point_enu_m, self.estimate_enu_m
        beyond_m = (point_east - east) * self.direction[0]
        beyond_m += (point_north - north) * self.direction[1]
        return beyond_m if beyond_m > self.overshoot_m + PUSHED_M else 0.0


NO_LATCH = Latch((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0, -1, 0.0)
"""Placeholder before the first crossing."""

FIRST, KEPT, FLOWN, MOVED = 0, 1, 2, 3
"""Verdicts: no latch yet, continue, choose the next crossing, re-aim the same one."""


class LatchRule(NamedTuple):
    """Parameters of latched crossing for the kernels."""

    overshoot_sigmas: float
    overshoot_min_m: float
    overshoot_max_m: float
    arrival_radius_m: float
    reaim_distance_m: float


@kernel
def worst_sigma_m(variance_east_m2: float, covariance_m2: float, variance_north_m2: float) -> float:
    """Return the standard deviation in the worst direction."""
    half_trace = 0.5 * (variance_east_m2 + variance_north_m2)
    half_gap = 0.5 * (variance_east_m2 - variance_north_m2)
    largest_m2 = half_trace + math.hypot(half_gap, covariance_m2)
    return math.sqrt(max(largest_m2, 0.0))


@kernel
def overshoot_m(
    variance_east_m2: float,
    covariance_m2: float,
    variance_north_m2: float,
    baseline_m: float,
    rule: LatchRule,
) -> float:
    """Return the overshoot: sigmas of the worst direction or the baseline, within limits."""
    sigma_m = worst_sigma_m(variance_east_m2, covariance_m2, variance_north_m2)
    wanted_m = rule.overshoot_sigmas * sigma_m
    least_m = max(rule.overshoot_min_m, min(baseline_m, rule.overshoot_max_m))
    return min(max(wanted_m, least_m), rule.overshoot_max_m)


@kernel
def latch_verdict(
    latch: Latch, vehicle: Point, target: Point, over_m: float, is_at_height: bool, rule: LatchRule
) -> int:
    """Return the verdict on a latch.

    The latch was chosen when less was known; once a shorter overshoot suffices, the rest of a long
    one would only cost time, so a crossing is also complete once the estimate lies behind by the
    present overshoot. Neither counts before the vehicle is at the height of the crossing.
    """
    if latch.crossings < 0:
        return FIRST
    (east, north), (target_east, target_north), start = vehicle, target, latch.start_enu_m
    point, estimate = latch.point_enu_m, latch.estimate_enu_m
    d_east, d_north = latch.direction
    started_m = (start[0] - target_east) * d_east + (start[1] - target_north) * d_north
    beyond_m = (east - target_east) * d_east + (north - target_north) * d_north
    is_over = started_m < over_m <= beyond_m
    to_point_m = math.hypot(point[0] - east, point[1] - north)
    if is_at_height and (is_over or to_point_m <= rule.arrival_radius_m):
        return FLOWN
    moved_m = math.hypot(target_east - estimate[0], target_north - estimate[1])
    if moved_m > max(rule.reaim_distance_m, 0.5 * latch.overshoot_m):
        return MOVED
    return KEPT


@kernel
def next_direction(latch: Latch, verdict: int, vehicle: Point, target: Point) -> Point:
    """Return the direction of the crossing after a verdict: at the estimate, turned, or kept."""
    if verdict == FIRST:
        return direction(vehicle, target)
    if verdict == FLOWN:
        return turned(latch.direction, GOLDEN_ANGLE_RAD)
    return latch.direction


@kernel
def new_latch(
    latch: Latch,
    verdict: int,
    point: Point,
    heading: Point,
    vehicle: Point,
    target: Point,
    over_m: float,
    rule: LatchRule,
) -> Latch:
    """Return the latch on a point; if it is reached already, the next direction is turned."""
    if math.hypot(point[0] - vehicle[0], point[1] - vehicle[1]) <= rule.arrival_radius_m:
        heading = turned(heading, GOLDEN_ANGLE_RAD)
    flown = max(latch.crossings, 0) + (1 if verdict == FLOWN else 0)
    return Latch(point, target, heading, vehicle, over_m, flown, latch.descent_m)


@kernel
def altitude_offset_m(crossings: int, swing_m: float) -> float:
    """Return the height of a crossing over the search altitude: alternately above and below."""
    return swing_m if crossings % 2 == 0 else 0.0 - swing_m
