"""The arithmetic of crossing planners, as kernels: directions, and the latch as one small array.

Directions in the plane are unit vectors as two numbers. A latch is what `LatchedCrossing` remembers
of the crossing being flown, a float64 array of `LATCH_SIZE` numbers; all zeros: none yet.
`latched_step` is the whole planner where no fence limits it; with a fence the class chooses among
directions, by the same kernels. Source: see `crossing`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.kernel import Vector, kernel

MIN_DISTANCE_M = 1e-9
"""Closer than this there is no direction from one point to another."""


@kernel
def direction(
    from_east_m: float, from_north_m: float, to_east_m: float, to_north_m: float
) -> tuple[float, float]:
    """Unit vector from one point to another; east where they coincide."""
    east, north = to_east_m - from_east_m, to_north_m - from_north_m
    distance = math.hypot(east, north)
    if distance < MIN_DISTANCE_M:
        return 1.0, 0.0
    return east / distance, north / distance


@kernel
def turned(east: float, north: float, angle_rad: float) -> tuple[float, float]:
    """A vector turned counter-clockwise."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * east - s * north, s * east + c * north


GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))

POINT_EAST, POINT_NORTH = 0, 1
"""The crossing point."""
ESTIMATE_EAST, ESTIMATE_NORTH = 2, 3
"""The estimate when the crossing was chosen."""
DIRECTION_EAST, DIRECTION_NORTH = 4, 5
"""Unit vector from the estimate to the far side."""
START_EAST, START_NORTH = 6, 7
"""Where the vehicle was when the crossing was chosen."""
OVERSHOOT = 8
CROSSINGS = 9
"""Crossings flown to their end so far."""
IS_SET = 10
LATCH_SIZE = 11

FIRST, KEPT, FLOWN, MOVED = 0, 1, 2, 3
"""Verdicts: no latch yet, fly on, choose the next crossing, aim the same one anew."""


class LatchRule(NamedTuple):
    """The parameters of latched crossing, as the kernels take them."""

    overshoot_sigmas: float
    overshoot_min_m: float
    overshoot_max_m: float
    arrival_radius_m: float
    reaim_distance_m: float


@kernel
def overshoot_m(
    variance_east_m2: float,
    covariance_m2: float,
    variance_north_m2: float,
    baseline_m: float,
    rule: LatchRule,
) -> float:
    """How far beyond the estimate a crossing goes: the worst direction's sigmas, within limits.

    Never shorter than the base line of `PlanRequest`, within the upper limit.
    """
    half_trace = 0.5 * (variance_east_m2 + variance_north_m2)
    half_gap = 0.5 * (variance_east_m2 - variance_north_m2)
    largest_m2 = half_trace + math.hypot(half_gap, covariance_m2)
    wanted_m = rule.overshoot_sigmas * math.sqrt(max(largest_m2, 0.0))
    least_m = max(rule.overshoot_min_m, min(baseline_m, rule.overshoot_max_m))
    return min(max(wanted_m, least_m), rule.overshoot_max_m)


@kernel
def latch_verdict(
    latch: Vector,
    east_m: float,
    north_m: float,
    target_east_m: float,
    target_north_m: float,
    over_m: float,
    is_at_height: bool,
    rule: LatchRule,
) -> int:
    """What is to become of a latch.

    The latch was chosen when less was known; once a shorter overshoot will do, the rest of a long
    one would only cost time, so a crossing is also flown once the estimate lies behind by the
    present overshoot. Neither counts before the vehicle is at the height of the crossing.
    """
    if latch[IS_SET] == 0.0:
        return FIRST
    to_point_m = math.hypot(latch[POINT_EAST] - east_m, latch[POINT_NORTH] - north_m)
    d_east, d_north = latch[DIRECTION_EAST], latch[DIRECTION_NORTH]
    started_m = (latch[START_EAST] - target_east_m) * d_east
    started_m += (latch[START_NORTH] - target_north_m) * d_north
    beyond_m = (east_m - target_east_m) * d_east + (north_m - target_north_m) * d_north
    is_over = started_m < over_m <= beyond_m
    if is_at_height and (is_over or to_point_m <= rule.arrival_radius_m):
        return FLOWN
    moved_m = math.hypot(
        target_east_m - latch[ESTIMATE_EAST], target_north_m - latch[ESTIMATE_NORTH]
    )
    if moved_m > max(rule.reaim_distance_m, 0.5 * latch[OVERSHOOT]):
        return MOVED
    return KEPT


@kernel
def next_direction(
    latch: Vector,
    verdict: int,
    east_m: float,
    north_m: float,
    target_east_m: float,
    target_north_m: float,
) -> tuple[float, float]:
    """The direction of the crossing that follows a verdict: at the estimate, turned, or kept."""
    if verdict == FIRST:
        return direction(east_m, north_m, target_east_m, target_north_m)
    d_east, d_north = float(latch[DIRECTION_EAST]), float(latch[DIRECTION_NORTH])
    if verdict == FLOWN:
        return turned(d_east, d_north, GOLDEN_ANGLE_RAD)
    return d_east, d_north


@kernel
def new_latch(
    latch: Vector,
    verdict: int,
    point: tuple[float, float],
    heading: tuple[float, float],
    east_m: float,
    north_m: float,
    target_east_m: float,
    target_north_m: float,
    over_m: float,
    rule: LatchRule,
) -> Vector:
    """The latch on a point; one that is reached already turns on with the next crossing."""
    fresh = np.empty(LATCH_SIZE)
    fresh[POINT_EAST], fresh[POINT_NORTH] = point
    fresh[ESTIMATE_EAST], fresh[ESTIMATE_NORTH] = target_east_m, target_north_m
    fresh[DIRECTION_EAST], fresh[DIRECTION_NORTH] = heading
    if math.hypot(point[0] - east_m, point[1] - north_m) <= rule.arrival_radius_m:
        fresh[DIRECTION_EAST], fresh[DIRECTION_NORTH] = turned(
            heading[0], heading[1], GOLDEN_ANGLE_RAD
        )
    fresh[START_EAST], fresh[START_NORTH] = east_m, north_m
    fresh[OVERSHOOT] = over_m
    fresh[CROSSINGS] = latch[CROSSINGS] + 1.0 if verdict == FLOWN else latch[CROSSINGS]
    fresh[IS_SET] = 1.0
    return fresh


@kernel
def latched_step(
    latch: Vector,
    east_m: float,
    north_m: float,
    target_east_m: float,
    target_north_m: float,
    over_m: float,
    is_at_height: bool,
    rule: LatchRule,
) -> Vector:
    """The latch to fly next, where no fence limits it: the same one, or a new array.

    In the plane a vehicle always `is_at_height` of the crossing.
    """
    verdict = latch_verdict(
        latch, east_m, north_m, target_east_m, target_north_m, over_m, is_at_height, rule
    )
    if verdict == KEPT:
        return latch
    heading = next_direction(latch, verdict, east_m, north_m, target_east_m, target_north_m)
    point = (target_east_m + over_m * heading[0], target_north_m + over_m * heading[1])
    return new_latch(
        latch, verdict, point, heading, east_m, north_m, target_east_m, target_north_m, over_m, rule
    )


@kernel
def altitude_offset_m(crossings: float, swing_m: float) -> float:
    """Height of a crossing against the search altitude: above and below it by turns."""
    return swing_m if crossings % 2.0 == 0.0 else 0.0 - swing_m
