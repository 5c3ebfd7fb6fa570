"""Latched crossing: the planner in flight while there is contact.

It flies over the estimate to a point on its far side, and only then turns. Bilateral
information needs views from both sides, so the far point must really be reached: it is *latched*
until it is reached, until the estimate lies behind by as much as is still needed, or until the
estimate has moved too far. Its distance beyond the estimate (the overshoot) is clip(3
sqrt(lambda_max(P)), 2 m, 20 m), and without bearings no shorter than the baseline that ranges need.
Each new crossing turns by the golden angle, so that any number of crossings covers all directions
evenly, without planning and at O(1) cost. With an altitude swing the crossings are flown
alternately above and below the search altitude, so that elevations differ, too; it takes longer.

With an antenna array, with received power, or with ranges alone to a target of configured height,
`views` gives the information of a leg, which decides three things. The overshoot has the highest
rate of information, though it is never shorter than the standard deviations above, because only
views from both sides separate the bearing offset, or P0, from the position. The turn begins where
braking would, at most a quarter of the overshoot early. And with `descend` the altitude is the
lowest of the altitude band, once the target is known to within the largest overshoot and if a pass
there has at least half as much again of information per metre. An azimuth about the vertical is
equally accurate at any height: it is the paper's, and crosses as above.

On a straight approach from afar a range has no information across it, and an array's directions are
limited by their offsets. With ranges and an array, the approach is a logarithmic spiral: always
`BEND_RAD` to the side, within the field of view, until the position is known as well as
the shortest overshoot requires, or near. It turns the line of sight by tan(bend) log 2 per halving
of the distance, and is 1 / cos(bend) as long as the straight path.

Paper: section V-A and Appendix C, with the crossing distance made effective; "Limitations and
Scope" for the separation plane in 3-D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from companion.domain import Distance, NonNegative, Params, Waypoint, WaypointReason
from companion.geometry.polygons import Point
from companion.planning.planner import (
    Plan,
    PlanRequest,
    cut_by_fence,
    hold_position,
    is_reachable,
    kept_inside,
    pushed_beyond,
    route_to,
    way_finder,
)
from companion.planning.views import (
    GOLDEN_ANGLE_RAD,
    KEPT,
    NO_LATCH,
    Antenna,
    Latch,
    LatchRule,
    LegView,
    altitude_offset_m,
    best_reach_m,
    direction,
    latch_verdict,
    leg_over,
    new_latch,
    next_direction,
    overshoot_m,
    rate,
    turned,
    worst_sigma_m,
)

DIRECTIONS_TRIED = 5
"""Directions tried before a crossing cut short by the fence is accepted."""
HEIGHT_SHARE = 0.5
"""Tolerance of a crossing's height, as a share of the swing."""
LONG_ENOUGH_SHARE = 0.9
"""Share of its overshoot beyond which a crossing is not cut short."""
TURN_SHARE = 0.25
"""Earliest begin of a turn before the end, as a share of the overshoot."""
DESCENT_GAIN = 1.5
"""Ratio of information rates above which a lower pass is flown: descent and climb take time."""
MIN_DESCENT_M = 1.0
"""Smallest descent that is commanded."""
BEND_RAD = math.radians(55.0)
"""Angle between the approach and the line of sight."""
VIEW_MARGIN_RAD = math.radians(5.0)
"""Margin of the field of view: in wind the heading differs from the course."""
BENT_BEYOND = 1.5
"""Distance, in overshoots, beyond which the approach is bent."""
HEIGHT_SIGMAS = 2.0
"""Safety margin of an estimated target height."""


class LatchedCrossingParams(Params, frozen=True):
    """Parameters of the overshoot, and of a completed crossing."""

    overshoot_sigmas: ClassVar[float] = 3.0
    """Overshoot in standard deviations of the worst direction."""
    overshoot_min_m: Distance = 2.0
    overshoot_max_m: Distance = 20.0
    arrival_radius_m: ClassVar[float] = 1.5
    """Distance within which the crossing point is reached."""
    reaim_distance_m: ClassVar[float] = 3.0
    """A move of the estimate by more than this, or half the overshoot, re-aims the crossing."""
    altitude_swing_m: NonNegative = 0.0
    """Crossings are flown alternately this much above and below the search altitude; 0: level."""
    descend: bool = False
    """True: crossings are flown lower where that is more informative; see `views`."""

    def __post_init__(self) -> None:
        """Reject an empty band for the overshoot, and two settings of one height."""
        if self.descend and self.altitude_swing_m > 0.0:
            raise ValueError("descend and altitude_swing_m exclude each other")
        if self.overshoot_min_m > self.overshoot_max_m:
            raise ValueError("overshoot_min_m must not exceed overshoot_max_m")

    def rule(self) -> LatchRule:
        """Return the same parameters for the kernels."""
        return LatchRule(*(getattr(self, name) for name in LatchRule._fields))


@dataclass(frozen=True, slots=True)
class SensorGeometry:
    """Antenna, dynamics and heights by which the information of a leg is computed."""

    antenna: Antenna
    speed_mps: float
    acceleration_mps2: float
    lowest_m: float
    """Lowest height that may be flown: above home, and above the target."""
    room_m: float
    """Search altitude less that height."""
    is_height_configured: bool
    """True if the target's configured height differs from the origin's, which makes ranges
    oblique."""

    @property
    def turn_m(self) -> float:
        """Cost of a turn by the golden angle per half crossing, as a distance: nearly v^2 / a."""
        return self.speed_mps**2 / self.acceleration_mps2


class LatchedCrossing:
    """Default planner; without a `SensorGeometry` it ignores heights and antennas."""

    search_after_s: float | None = None

    def __init__(self, params: LatchedCrossingParams, sensor: SensorGeometry | None = None) -> None:
        self.params = params
        self._sensor = sensor
        self._rule = params.rule()

    def plan(self, request: PlanRequest, memory: Latch | None) -> Plan[Latch | None]:
        """Return the crossing in flight, or the next one."""
        if request.estimate is None:
            return Plan(hold_position(request, "no estimate yet"), None)
        vehicle, target = request.vehicle_enu_m, request.estimate.position_enu_m
        (a, b), (_, c) = request.estimate.covariance_m2
        over_m = overshoot_m(a, b, c, request.baseline_m, self._rule)
        before, rule = NO_LATCH if memory is None else memory, self._rule
        sensor, sigmas_m = self._sensor_for(request), rule.overshoot_sigmas * worst_sigma_m(a, b, c)
        if sensor is not None:
            over_m = self._reach_m(request, sensor, before, sigmas_m)
            early_m = min(0.5 * sensor.turn_m, TURN_SHARE * over_m)
            rule = rule._replace(arrival_radius_m=max(early_m, rule.arrival_radius_m))
            bent = self._bent_approach(request, sensor, over_m) if before.crossings <= 0 else None
            if bent is not None and sigmas_m > rule.overshoot_min_m:
                return Plan(bent, None)
        behind_m = over_m if memory is None else max(over_m, memory.pushed_m)
        is_at_height = self._is_at_height(request, memory)
        verdict = latch_verdict(before, vehicle, target, behind_m, is_at_height, rule)
        if memory is not None and verdict == KEPT:
            return Plan(self._waypoint(request, memory), memory)
        heading = next_direction(before, verdict, vehicle, target)
        if sensor is not None:
            descent_m = self._descent_m(request, sensor, before, over_m, sigmas_m)
            before = before._replace(descent_m=descent_m)
            ahead = before._replace(direction=heading)
            over_m = self._reach_m(request, sensor, ahead, sigmas_m)
        chosen = self._best_point(request, target, heading, over_m)
        if chosen is None:
            return Plan(hold_position(request, "no path to any side of the estimate"), memory)
        latch = new_latch(before, verdict, *chosen, vehicle, target, over_m, rule)
        return Plan(self._waypoint(request, latch), latch)

    def _sensor_for(self, request: PlanRequest) -> SensorGeometry | None:
        """Return the geometry for choosing by information; None: cross as in the paper."""
        sensor = self._sensor
        if sensor is None or request.sigmas is None:
            return None
        is_array, has_directions = sensor.antenna.rows > 0, request.baseline_m == 0.0
        has_power = math.isfinite(request.sigmas[2])
        is_oblique = sensor.is_height_configured or self.params.descend or has_power
        return sensor if is_array or (is_oblique and not has_directions) else None

    def _reach_m(
        self, request: PlanRequest, sensor: SensorGeometry, latch: Latch, sigmas_m: float
    ) -> float:
        """Return the overshoot with the highest rate, not less than the position's sigmas."""
        most_m = self.params.overshoot_max_m
        leg = _leg(request, sensor, latch.direction, latch.descent_m)
        return max(best_reach_m(leg, self.params.overshoot_min_m, most_m), min(sigmas_m, most_m))

    def _bent_approach(
        self, request: PlanRequest, sensor: SensorGeometry, over_m: float
    ) -> Waypoint | None:
        """Return an approach to the side of a far target, or None.

        None if it is near, or there are no ranges with an array, or no leg is clear. The point is
        where the line of sight would be at right angles to the leg, so that it is never reached.
        """
        assert request.estimate is not None
        assert request.sigmas is not None
        vehicle, target = request.vehicle_enu_m, request.estimate.position_enu_m
        distance_m = math.dist(vehicle, target)
        bend_rad = min(BEND_RAD, sensor.antenna.half_view_rad - VIEW_MARGIN_RAD)
        has_ranges_and_array = math.isfinite(request.sigmas[0]) and sensor.antenna.rows > 0
        if distance_m <= BENT_BEYOND * over_m or bend_rad <= 0.0 or not has_ranges_and_array:
            return None
        aside = _far_point(
            vehicle, turned(direction(vehicle, target), bend_rad), distance_m * math.cos(bend_rad)
        )
        offset_m = altitude_offset_m(0, self.params.altitude_swing_m)
        detail = "approach from the side, so that ranges locate the target"
        bent = Waypoint(aside, WaypointReason.APPROACH, detail, offset_m)
        return bent if route_to(request, bent) == bent else None

    def _descent_m(
        self,
        request: PlanRequest,
        sensor: SensorGeometry,
        before: Latch,
        over_m: float,
        sigmas_m: float,
    ) -> float:
        """Return the descent to the lowest height, if it pays at the current overshoot, else 0.

        It is 0 while the target's position is too uncertain.
        """
        is_low = before.descent_m > 0.0
        known_m = self.params.overshoot_max_m * (2.0 if is_low else 1.0)
        if not self.params.descend or request.altitude_offset_m is None or sigmas_m > known_m:
            return 0.0
        assert request.estimate is not None
        above_m = request.height_m - request.altitude_offset_m
        above_m -= HEIGHT_SIGMAS * (request.estimate.height_sigma_m or 0.0)
        descent_m = min(sensor.room_m, above_m - sensor.lowest_m)
        if descent_m < MIN_DESCENT_M:
            return 0.0
        high, low = (_leg(request, sensor, before.direction, each) for each in (0.0, descent_m))
        pays = is_low or rate(over_m, low) > DESCENT_GAIN * rate(over_m, high)
        return descent_m if pays else 0.0

    def _is_at_height(self, request: PlanRequest, memory: Latch | None) -> bool:
        """Return True if the vehicle is at the crossing's height, so that it may end."""
        swing_m, offset_m = self.params.altitude_swing_m, request.altitude_offset_m
        if swing_m == 0.0 or offset_m is None or memory is None:
            return True
        wanted_m = altitude_offset_m(memory.crossings, swing_m)
        return abs(offset_m - wanted_m) <= HEIGHT_SHARE * swing_m

    def _best_point(
        self, request: PlanRequest, target: Point, heading: Point, over_m: float
    ) -> tuple[Point, Point] | None:
        """Return the crossing point and its direction; None if no direction can be flown.

        Directions that the fence cuts short, or that end at an unreachable point, are turned on. A
        point in a keep-out, perhaps the one about the target, is pushed beyond it: the nearest free
        point may be on the near side, and all views would be from there.
        """
        if way_finder(request) is None:
            return _far_point(target, heading, over_m), heading
        anchor = cut_by_fence(target, request.vehicle_enu_m, request)
        best: tuple[Point, Point] | None = None
        best_length_m = -1.0
        for _ in range(DIRECTIONS_TRIED):
            far = cut_by_fence(_far_point(anchor, heading, over_m), anchor, request)
            point = kept_inside(pushed_beyond(far, heading, request), anchor, request)
            length_m = math.dist(anchor, point)
            if length_m > best_length_m and is_reachable(point, request):
                best, best_length_m = (point, heading), length_m
                if length_m >= LONG_ENOUGH_SHARE * over_m:
                    break
            heading = turned(heading, GOLDEN_ANGLE_RAD)
        return best

    def _waypoint(self, request: PlanRequest, latch: Latch) -> Waypoint:
        vehicle, estimate = request.vehicle_enu_m, latch.estimate_enu_m
        ahead = direction(vehicle, latch.point_enu_m)
        to_estimate = (estimate[0] - vehicle[0], estimate[1] - vehicle[1])
        is_ahead = to_estimate[0] * ahead[0] + to_estimate[1] * ahead[1] > 0.0
        is_approach = is_ahead and math.dist(vehicle, estimate) > latch.overshoot_m
        reason = WaypointReason.APPROACH if is_approach else WaypointReason.CROSSING
        detail = f"crossing {latch.crossings + 1}, {latch.overshoot_m:.1f} m beyond the estimate"
        descent_m = latch.descent_m
        offset_m = altitude_offset_m(latch.crossings, self.params.altitude_swing_m) - descent_m
        waypoint = Waypoint(latch.point_enu_m, reason, detail, offset_m, descent_m)
        return route_to(request, waypoint)


def _leg(request: PlanRequest, sensor: SensorGeometry, along: Point, descent_m: float) -> LegView:
    """Return a leg in a direction at the height of a descent; the first one along the way."""
    assert request.estimate is not None
    assert request.sigmas is not None
    if along == NO_LATCH.direction:
        along = direction(request.vehicle_enu_m, request.estimate.position_enu_m)
    yaw_rad = 0.0
    if request.yaw_enu_rad is not None:
        yaw_rad = request.yaw_enu_rad - math.atan2(along[1], along[0])
    height_m = request.height_m - (request.altitude_offset_m or 0.0) - descent_m
    return leg_over(height_m, sensor.turn_m, request.sigmas, sensor.antenna, yaw_rad)


def _far_point(anchor: Point, heading: Point, over_m: float) -> Point:
    return (anchor[0] + over_m * heading[0], anchor[1] + over_m * heading[1])
