"""Information of a straight leg over the target, by antenna: closed forms, best overshoot.

A vehicle h above the target flies over it, from L before to L behind. At ground distance d, with
s^2 = d^2 + h^2 and theta = atan(d / h), the angle from the nadir, the information per metre is

    of ranges      along the leg    d^2 / (s^2 sigma_r^2)
    of a cosine    across the leg   c^2 / (s^2 sigma_0^2)
                   along the leg    (a cos theta + b sin theta)^2 cos^4 theta / (h^2 sigma_0^2)
    of a power     along the leg    d^2 / (s^4 sigma_s^2)

with sigma_s the noise of a power as a share of the slant range, sigma_p ln 10 / (10 n), and for an
axis of the antenna with components a ahead, c to the left and b upwards: the gradients of
slant and of axis . u, u being the unit vector to the target. A planar array's azimuth has c = 1 and
nothing else, so that coming closer than the height gains nothing. From 0 to L these are

    (L - h theta) / sigma_r^2      theta c^2 / (h sigma_0^2)
    [a^2 (3/8 theta + 1/4 sin 2 theta + 1/32 sin 4 theta) + b^2 (theta / 8 - 1/32 sin 4 theta)
     - a b cos^4 theta / 2] / (h sigma_0^2)
    (theta - sin theta cos theta) / (2 h sigma_s^2)

and a field of view excludes the angles outside of it. Crossings come from all directions in turn,
so that every axis gets its share of the sum. Divided by the path length plus the cost of turning, L
+ turn, it is the rate of information; at its maximum, one more metre has as much information as the
mean one.

The offset of bearings is odd in d and the position across is even, that of ranges the reverse: legs
over the target, and only those, separate them, so that neither offset changes the sum. The power at
1 m and the path-loss exponent are even in d and the position along the leg is odd, so that the same
holds for them.

Deviations: legs go straight over the estimate, which is only approximately true after a turn by the
golden angle; the vehicle is level; a planar array is assumed level; path loss is left out.

Source of the derivatives: those of `companion/estimation/measurement_model.py`, for a level body.

The kernels with which `crossing.LatchedCrossing` chooses among directions are here as well. Their
points and unit vectors are east and north, in metres; a latch is its memory of the current
crossing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.geometry.polygons import Point
from companion.kernel import kernel

Triple = tuple[float, float, float]
MIN_HEIGHT_M = 1.0
"""Minimum height above the target: below it, errors of position and antenna dominate."""
BISECTIONS = 8
"""Bisections of the overshoot: its bounds are 20 m apart, so that 0.1 m remain."""
WHOLE_RAD = 0.5 * math.pi
"""Angle from the nadir to the horizon."""


class Antenna(NamedTuple):
    """Antenna that measures directions; unit vectors are forward, left and up of the level body."""

    boresight: Triple
    first: Triple
    second: Triple
    rows: int
    """Rows of direction: 1 is the first axis alone (a line), or a planar array's azimuth; 2 both
    axes."""
    is_planar: bool
    half_view_rad: float
    """Half angle about the boresight; a line or two axes see the mirrored cone behind as well."""


class LegView(NamedTuple):
    """Geometry and information weights of a leg over the target."""

    height_m: float
    """Height above the target."""
    turn_m: float
    """Cost of the turn at an end, as a distance."""
    per_range_m2: float
    """Information of a range, 1 / sigma_r^2; 0: there are no ranges."""
    per_cosine: float
    """Information of a cosine, 1 / sigma_0^2, rad^-2; 0: there are no directions."""
    per_power: float
    """Information of a power about the logarithm of the slant range, 1 / sigma_s^2; 0: there are no
    powers."""
    across2: float
    """Sum over the axes of c^2."""
    ahead2: float
    ahead_up: float
    up2: float
    """Sums over the axes of a^2, a b and b^2."""
    middle_rad: float
    half_rad: float
    """Middle and half width of the visible angles from the nadir, ahead positive; the opposite
    angles are visible as well."""


@kernel
def leg_over(
    height_m: float,
    turn_m: float,
    sigmas: tuple[float, float, float],
    antenna: Antenna,
    yaw_rad: float,
) -> LegView:
    """Return the leg of a vehicle whose heading is `yaw_rad` counter-clockwise of the leg's.

    `sigmas` are those of a range, m, of a direction cosine, rad, and of a power as a share of the
    slant range; infinite: not measured.
    """
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    range_m, cosine_rad = max(sigmas[0], 1e-6), max(sigmas[1], 1e-6)
    forward, left, up = antenna.boresight
    ahead = c * forward - s * left
    across2, ahead2, ahead_up, up2 = 1.0, 0.0, 0.0, 0.0
    if antenna.is_planar:
        middle, half = 0.0, WHOLE_RAD
        if antenna.half_view_rad < math.pi:  # by azimuth, a target on the leg is ahead or behind
            level = math.cos(antenna.half_view_rad) * math.hypot(forward, left)
            if ahead < level or -ahead < level:
                half = 0.25 * math.pi if abs(ahead) >= level else 0.0
                middle = math.copysign(half, ahead)
    else:
        across2 = 0.0
        for row in range(antenna.rows):
            axis = antenna.first if row == 0 else antenna.second
            a = c * axis[0] - s * axis[1]
            across2 += (s * axis[0] + c * axis[1]) ** 2
            ahead2, ahead_up, up2 = ahead2 + a * a, ahead_up + a * axis[2], up2 + axis[2] * axis[2]
        # u is (sin, 0, -cos) of theta; its component along the boresight is a cosine in theta
        middle, size = math.atan2(ahead, -up), math.hypot(ahead, up)
        least = max(math.cos(antenna.half_view_rad), 0.0)
        half = math.acos(least / size) if size > least else 0.0
        if least == 0.0:
            half = WHOLE_RAD
    return LegView(
        max(abs(height_m), MIN_HEIGHT_M),
        turn_m,
        1.0 / (range_m * range_m),
        1.0 / (cosine_rad * cosine_rad) if antenna.rows > 0 else 0.0,
        1.0 / (sigmas[2] * sigmas[2]),
        across2,
        ahead2,
        ahead_up,
        up2,
        middle,
        half,
    )


@kernel
def _directions_to(angle_rad: float, leg: LegView) -> float:
    """Return the antiderivative of the information of directions, times h sigma_0^2."""
    s, c = math.sin(angle_rad), math.cos(angle_rad)
    double, c2 = 2.0 * s * c, c * c
    fourfold = 2.0 * double * (c2 - s * s)
    total = leg.across2 * angle_rad - 0.5 * leg.ahead_up * c2 * c2
    total += leg.ahead2 * (0.375 * angle_rad + 0.25 * double + fourfold / 32.0)
    return total + leg.up2 * (0.125 * angle_rad - fourfold / 32.0)


@kernel
def information(reach_m: float, leg: LegView) -> float:
    """Return the information of a leg of `reach_m` to either side of the target, m / m^2."""
    most = math.atan2(reach_m, leg.height_m)
    total = 2.0 * leg.per_range_m2 * (reach_m - leg.height_m * most)
    total += leg.per_power / leg.height_m * (most - math.sin(most) * math.cos(most))
    if leg.per_cosine > 0.0:
        for turn in range(-1, 2):
            middle = leg.middle_rad + math.pi * turn
            low, high = max(-most, middle - leg.half_rad), min(most, middle + leg.half_rad)
            if high > low:
                seen = _directions_to(high, leg) - _directions_to(low, leg)
                total += leg.per_cosine / leg.height_m * seen
    return total


@kernel
def marginal(reach_m: float, leg: LegView) -> float:
    """Return the information of one more metre at both ends: the derivative of `information`."""
    angle, slant_m = math.atan2(reach_m, leg.height_m), math.hypot(reach_m, leg.height_m)
    s, c = reach_m / slant_m, leg.height_m / slant_m
    total = 2.0 * leg.per_range_m2 * s * s
    total += 2.0 * leg.per_power * s * s / (slant_m * slant_m)
    for side in (-1.0, 1.0):
        off = (side * angle - leg.middle_rad) % math.pi
        if leg.per_cosine > 0.0 and min(off, math.pi - off) <= leg.half_rad:
            along = leg.ahead2 * c * c + 2.0 * side * leg.ahead_up * c * s + leg.up2 * s * s
            seen = (leg.across2 + along * c * c) * c * c
            total += leg.per_cosine * seen / (leg.height_m * leg.height_m)
    return total


@kernel
def rate(reach_m: float, leg: LegView) -> float:
    """Return the information per metre of path, turns included, 1/m^2."""
    return information(reach_m, leg) / (2.0 * max(reach_m + leg.turn_m, 1e-9))


@kernel
def best_reach_m(leg: LegView, least_m: float, most_m: float) -> float:
    """Return the overshoot with the highest rate between two bounds.

    It is found by bisection, and, because a field of view and tilted axes make more than one
    maximum, compared with both bounds and the edges of the field of view.
    """
    low, high = least_m, most_m
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if information(middle, leg) < marginal(middle, leg) * (middle + leg.turn_m):
            low = middle
        else:
            high = middle
    best, greatest = high, rate(high, leg)
    for index in range(4):
        reach_m = most_m if index == 0 else least_m
        if index > 1:  # the edges of the field of view
            edge = leg.middle_rad + (leg.half_rad if index == 2 else -leg.half_rad)
            reach_m = leg.height_m * abs(math.tan(edge))
        total = rate(min(max(reach_m, least_m), most_m), leg)
        if total > greatest:
            best, greatest = min(max(reach_m, least_m), most_m), total
    return best


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
    current overshoot. Neither counts before the vehicle is at the height of the crossing.
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
