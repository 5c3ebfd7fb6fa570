"""Planner protocol: the next waypoint from the current state, as a pure step in free space.

Planners choose a goal and end with `route_to`, which turns it into a waypoint whose leg is clear:
the goal itself, the first corner of the shortest path around obstacles, the shortest way back into
free space, or staying where there is no path at all. The goal is not remembered: the same goal
requested again at the corner gives the next corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Generic, Protocol, TypeVar

from companion.domain import TargetEstimate, Waypoint, WaypointReason
from companion.geometry.obstacles import FreeSpace, WayFinder, between
from companion.geometry.polygons import Point, Polygon, deepest_point, depth_m
from companion.kernel import Matrix
from companion.search.outlook import Outlook

Memory = TypeVar("Memory")


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Inputs of a planner."""

    vehicle_enu_m: Point
    estimate: TargetEstimate | None = None
    fence_enu_m: Polygon | None = None
    """Polygon that waypoints and the straight legs to them keep inside of, by `fence_margin_m`."""
    fence_margin_m: float = 0.0
    """Distance to keep from the fence and from every keep-out."""
    baseline_m: float = 0.0
    """Minimum horizontal distance of an informative view of the target; 0 where bearings are
    measured.

    Straight above it a slant range hardly depends on the target's position.
    """
    keep_out_enu_m: tuple[Polygon, ...] = ()
    """Polygons that waypoints and the straight legs to them stay out of."""
    also_inside_enu_m: tuple[Polygon, ...] = ()
    """Further polygons that they stay inside of, by the same margin."""
    leg_from_enu_m: Point | None = None
    """Start of the leg to the waypoint, if not the vehicle: the setpoint moves ahead."""
    home_enu_m: Point | None = None
    range_left_m: float = math.inf
    """Distance that the charge above the reserve lasts, the way home included."""
    outlook: Outlook | None = field(default=None, compare=False)
    """Remaining probability over the search area; None: unknown, or there was contact."""
    time_s: float = 0.0
    contact_s: float | None = None
    """Time of the latest usable ranging; None: unknown, and an estimate is assumed to be fresh."""
    height_m: float = 0.0
    """Height of the vehicle above the target, for slant ranges."""
    altitude_offset_m: float | None = None
    """Height of the vehicle above the search altitude; None: plans do not wait for heights."""
    yaw_enu_rad: float | None = None
    """Heading of the vehicle, counter-clockwise from east; None: unknown."""
    sigmas: tuple[float, float, float] | None = None
    """Standard deviations of a range, m, of a direction cosine, and of a power as a share of the
    slant range, as measured: infinite where there are none. None if nothing was measured yet."""
    joint_covariance: Matrix | None = field(default=None, compare=False)
    """Covariance (4, 4) of [east, north, range offset, bearing offset]; metres and radians.

    None: the covariance of the estimate with the prior of the offsets.
    """

    @property
    def begin_enu_m(self) -> Point:
        """Start of the leg to the waypoint."""
        return self.vehicle_enu_m if self.leg_from_enu_m is None else self.leg_from_enu_m


@dataclass(frozen=True, slots=True)
class Plan(Generic[Memory]):
    """Waypoint, and the planner's memory until the next request."""

    waypoint: Waypoint
    memory: Memory


class Planner(Protocol[Memory]):
    """Protocol of planners; pure, the caller keeps the memory."""

    @property
    def search_after_s(self) -> float | None:
        """Time without contact until it searches; None: never, 0: it needs no contact."""

    def plan(self, request: PlanRequest, memory: Memory | None) -> Plan[Memory]:
        """Return the next waypoint in the free space of the request; memory is None at first."""


SLACK_M = 1e-6
"""Excess of a leg's margin, so that a guard with the same margin never stops it."""
START_TOLERANCE_M = 0.01
"""Distance outside free space up to which a leg may begin: rounding, and a guard without slack."""
FARTHEST_BEYOND_M = 100.0
"""Largest distance that a point is pushed beyond a keep-out about the target."""
NO_ROOM = "the fence, the keep-outs and the margin leave no room"
"""Detail of a waypoint where free space is empty."""


@lru_cache(maxsize=8)
def _way_finder(
    fence_enu_m: tuple[Point, ...] | None,
    keep_out_enu_m: tuple[tuple[Point, ...], ...],
    margin_m: float,
    also_inside_enu_m: tuple[tuple[Point, ...], ...],
) -> WayFinder:
    """Return the cached path finder of a free space; every plan of a flight shares its graph."""
    space = FreeSpace(fence_enu_m, keep_out_enu_m, margin_m + SLACK_M, also_inside_enu_m)
    return WayFinder(space)


def way_finder(request: PlanRequest) -> WayFinder | None:
    """Return the path finder for a request, or None without a fence or keep-out."""
    if request.fence_enu_m is None and not request.keep_out_enu_m:
        return None
    fence = None if request.fence_enu_m is None else tuple(request.fence_enu_m)
    keep_out = tuple(tuple(polygon) for polygon in request.keep_out_enu_m)
    also_inside = tuple(tuple(polygon) for polygon in request.also_inside_enu_m)
    return _way_finder(fence, keep_out, request.fence_margin_m, also_inside)


def kept_inside(point: Point, anchor: Point, request: PlanRequest) -> Point:
    """Return `point`, or the free point that replaces it.

    Beyond the fence that is the farthest one on the way to it from `anchor`, usually the estimate
    or the vehicle; in a keep-out it is the nearest one.
    """
    finder = way_finder(request)
    if finder is None or finder.space.allows(point):
        return point
    point = cut_by_fence(point, anchor, request)
    nearest = finder.space.nearest_allowed(point)
    return point if nearest is None else nearest


def cut_by_fence(point: Point, anchor: Point, request: PlanRequest) -> Point:
    """Return `point`, or the farthest point towards it from `anchor` that is inside the fence."""
    fence_enu_m, margin_m = request.fence_enu_m, request.fence_margin_m + SLACK_M
    if fence_enu_m is None or depth_m(fence_enu_m, point) >= margin_m:
        return point
    if depth_m(fence_enu_m, anchor) < margin_m:
        anchor = deepest_point(fence_enu_m)
        if depth_m(fence_enu_m, anchor) < margin_m:
            return anchor
    inside, outside = 0.0, 1.0
    for _ in range(24):
        middle = 0.5 * (inside + outside)
        if depth_m(fence_enu_m, between(anchor, point, middle)) >= margin_m:
            inside = middle
        else:
            outside = middle
    return between(anchor, point, inside)


def pushed_beyond(point: Point, heading: Point, request: PlanRequest) -> Point:
    """Return `point`, or the first free one beyond it, if any within `FARTHEST_BEYOND_M`."""
    finder = way_finder(request)
    if finder is None or finder.space.allows(point):
        return point
    end = (point[0] + FARTHEST_BEYOND_M * heading[0], point[1] + FARTHEST_BEYOND_M * heading[1])
    return next((first for first, _ in finder.space.pieces(point, end)), point)


def is_reachable(point: Point, request: PlanRequest) -> bool:
    """Return True if there is a path to a free point."""
    finder = way_finder(request)
    if finder is None:
        return True
    start = finder.space.nearest_allowed(request.begin_enu_m)
    return start is not None and finder.way(start, point) is not None


def route_to(request: PlanRequest, wanted: Waypoint) -> Waypoint:
    """Return a waypoint whose straight leg is clear, on the path to the wanted one."""
    finder = way_finder(request)
    if finder is None:
        return wanted
    begin, space = request.begin_enu_m, finder.space
    start, goal = space.nearest_allowed(begin), space.nearest_allowed(wanted.position_enu_m)
    if start is None or goal is None:
        fence = request.fence_enu_m
        inside = begin if fence is None else deepest_point(fence)
        return Waypoint(inside, WaypointReason.HOLD, NO_ROOM)
    if math.dist(begin, start) > START_TOLERANCE_M:
        return _detour(wanted, start, "back into free space")
    way = finder.way(start, goal)
    if way is None:
        return Waypoint(start, WaypointReason.HOLD, f"no path to: {wanted.detail}")
    if len(way) == 1:
        return replace(wanted, position_enu_m=goal)
    corners = "1 corner" if len(way) == 2 else f"{len(way) - 1} corners"
    return _detour(wanted, way[0], f"{corners} to go")


def hold_position(request: PlanRequest, why: str) -> Waypoint:
    """Return a waypoint at the end of the last leg, or at the vehicle."""
    return route_to(request, Waypoint(request.begin_enu_m, WaypointReason.HOLD, why))


def _detour(wanted: Waypoint, position: Point, what: str) -> Waypoint:
    detail = f"{what}: {wanted.detail}"
    return replace(wanted, position_enu_m=position, reason=WaypointReason.DETOUR, detail=detail)
