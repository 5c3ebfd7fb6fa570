"""The fence: where a setpoint may be. Standard library only."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.geometry.polygons import (
    Point,
    area_m2,
    contains,
    deepest_point,
    depth_m,
    edges,
    is_simple,
    nearest_on_segment,
)


@dataclass(frozen=True, slots=True)
class Fence:
    """A simple polygon in local east and north with a margin inside its border.

    Raises:
        ValueError: Fewer than 3 corners, crossing edges, no area, or nothing left by the margin.
    """

    polygon_enu_m: tuple[Point, ...]
    margin_m: float

    def __post_init__(self) -> None:
        """Refuse a polygon that encloses nothing usable."""
        if len(self.polygon_enu_m) < 3:
            raise ValueError("a fence needs at least 3 corners")
        if not all(math.isfinite(v) for corner in self.polygon_enu_m for v in corner):
            raise ValueError("a fence corner is not a finite number")
        if not is_simple(self.polygon_enu_m):
            raise ValueError("two edges of the fence cross each other")
        if area_m2(self.polygon_enu_m) < 1.0:
            raise ValueError("the fence encloses no area")
        if depth_m(self.polygon_enu_m, deepest_point(self.polygon_enu_m)) <= self.margin_m:
            raise ValueError(f"the margin of {self.margin_m:g} m leaves nothing of the fence")

    def allows(self, point: Point) -> bool:
        """Whether a point is inside by at least the margin."""
        return depth_m(self.polygon_enu_m, point) >= self.margin_m

    def is_inside(self, point: Point) -> bool:
        """Whether a point is inside the polygon itself."""
        return contains(self.polygon_enu_m, point)

    def limited(self, start: Point, goal: Point) -> Point:
        """The farthest allowed point on the straight way from `start` to `goal`.

        From a start that is not allowed itself (blown outside, or started there) the result is
        an allowed point behind the nearest border instead: only ever inwards.
        """
        if not self.allows(start):
            return self.nearest_allowed(start)
        inside, step = 0.0, self._share_of_way(start, goal)
        share = step
        while share < 1.0 and self.allows(_between(start, goal, share)):
            inside = share
            share = min(1.0, share + step)
        if share >= 1.0 and self.allows(goal):
            return goal
        outside = share
        for _ in range(40):
            middle = 0.5 * (inside + outside)
            if self.allows(_between(start, goal, middle)):
                inside = middle
            else:
                outside = middle
        return _between(start, goal, inside)

    def nearest_allowed(self, point: Point) -> Point:
        """`point` if it is allowed, otherwise the first allowed one from the border inwards."""
        if self.allows(point):
            return point
        border = min(
            (nearest_on_segment(a, b, point) for a, b in edges(self.polygon_enu_m)),
            key=lambda candidate: math.dist(candidate, point),
        )
        towards = deepest_point(self.polygon_enu_m)
        inwards = point if contains(self.polygon_enu_m, point) else border
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            if self.allows(_between(inwards, towards, middle)):
                high = middle
            else:
                low = middle
        return _between(inwards, towards, high)

    def _share_of_way(self, start: Point, goal: Point) -> float:
        """Step of the search: no narrower notch than a quarter of the margin is jumped over."""
        length = math.dist(start, goal)
        return 1.0 if length == 0.0 else min(1.0, max(0.25 * self.margin_m, 0.05) / length)


def _between(a: Point, b: Point, share: float) -> Point:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
