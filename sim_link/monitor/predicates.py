"""Exact predicates on polygons, written for the monitor alone.

The companion's guard has geometry of its own; nothing here is shared with it, so that a mistake in
one does not excuse itself in the other. Points are east and north, metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = tuple[float, float]
Corners = Sequence[Point]

BORDER_M = 4.0
"""Nearer to a border than this, "here" may be moved inwards by the margin."""
INWARDS_M = 2.0 * BORDER_M
"""A place in a corner, or in the notch of one, may be moved by more than the margin."""


def is_inside(corners: Corners, point: Point) -> bool:
    """Whether a point is inside a polygon, by its winding number; so is its border."""
    return border_distance_m(corners, point) == 0.0 or _is_wound_around(corners, point)


def _is_wound_around(corners: Corners, point: Point) -> bool:
    winding = 0
    north = point[1]
    a = corners[-1]
    for b in corners:
        if a[1] <= north:
            if b[1] > north and _side(a, b, point) > 0.0:
                winding += 1
        elif b[1] <= north and _side(a, b, point) < 0.0:
            winding -= 1
        a = b
    return winding != 0


def border_distance_m(corners: Corners, point: Point) -> float:
    """How far a point is from a polygon's border."""
    least_m = math.inf
    start = corners[-1]
    for end in corners:
        distance_m = _to_segment_m(start, end, point)
        if distance_m < least_m:
            least_m = distance_m
        start = end
    return least_m


def depth_m(fence: Corners, keep_outs: Sequence[Corners], point: Point) -> float:
    """How far inside the fence and outside of all keep-outs a point is; negative: it is not."""
    depth = _inside_m(fence, point)
    for keep_out in keep_outs:
        depth = min(depth, -_inside_m(keep_out, point))
    return depth


def _inside_m(corners: Corners, point: Point) -> float:
    """How far from its border a point is inside a polygon; negative: outside."""
    away_m = border_distance_m(corners, point)
    return away_m if _is_wound_around(corners, point) else -away_m


def is_moved_inwards(
    fence: Corners, keep_outs: Sequence[Corners], vehicle: Point, place: Point
) -> bool:
    """Whether `place` may be where a vehicle at a border, or beyond it, is to stay."""
    depth = depth_m(fence, keep_outs, vehicle)
    return depth < BORDER_M and math.dist(vehicle, place) <= INWARDS_M


def is_way_clear(fence: Corners, keep_outs: Sequence[Corners], start: Point, end: Point) -> bool:
    """Whether the straight way between two points inside crosses no border."""
    return not any(
        _cross(start, end, a, b) for corners in (fence, *keep_outs) for a, b in _edges(corners)
    )


def _edges(corners: Corners) -> list[tuple[Point, Point]]:
    return [(corners[i - 1], corners[i]) for i in range(len(corners))]


def _side(a: Point, b: Point, p: Point) -> float:
    """Positive if `p` is left of the line from `a` to `b`."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (p[0] - a[0]) * (b[1] - a[1])


def _to_segment_m(a: Point, b: Point, p: Point) -> float:
    east, north = b[0] - a[0], b[1] - a[1]
    to_east, to_north = p[0] - a[0], p[1] - a[1]
    length2 = east * east + north * north
    if length2 > 0.0:
        share = (to_east * east + to_north * north) / length2
        if share >= 1.0:
            share = 1.0
        if share > 0.0:
            to_east -= share * east
            to_north -= share * north
    return math.hypot(to_east, to_north)


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether two segments cross properly."""
    return _side(a, b, c) * _side(a, b, d) < 0.0 and _side(c, d, a) * _side(c, d, b) < 0.0
