"""Keeping waypoints inside the fence."""

from __future__ import annotations

import math

from companion.domain import Point
from companion.geometry.polygons import Polygon, deepest_point, depth_m


def kept_inside(point: Point, anchor: Point, fence_enu_m: Polygon | None, margin_m: float) -> Point:
    """`point`, or the farthest point on the way to it from `anchor` that is inside the fence.

    Args:
        point: Where the planner wants to go.
        anchor: A point it may fall back towards, usually the estimate or the vehicle.
        fence_enu_m: The fence; None: no limit.
        margin_m: Distance to keep from its border.
    """
    if fence_enu_m is None or depth_m(fence_enu_m, point) >= margin_m:
        return point
    if depth_m(fence_enu_m, anchor) < margin_m:
        anchor = deepest_point(fence_enu_m)
        if depth_m(fence_enu_m, anchor) < margin_m:
            return anchor
    inside, outside = 0.0, 1.0
    for _ in range(24):
        middle = 0.5 * (inside + outside)
        if depth_m(fence_enu_m, _between(anchor, point, middle)) >= margin_m:
            inside = middle
        else:
            outside = middle
    return _between(anchor, point, inside)


def _between(a: Point, b: Point, share: float) -> Point:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))


def unit(from_point: Point, to_point: Point) -> Point:
    """Direction between two points; east where they coincide."""
    distance = math.dist(from_point, to_point)
    if distance < 1e-9:
        return (1.0, 0.0)
    return ((to_point[0] - from_point[0]) / distance, (to_point[1] - from_point[1]) / distance)
