"""The fence: where a setpoint may be. Standard library only."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

from companion.geometry.polygons import (
    Point,
    area_m2,
    deepest_point,
    depth_m,
    edges,
    is_simple,
    nearest_on_segment,
)

ROUNDING_M = 1e-6
"""How much farther in than the margin a point is put, so that rounding cannot undo it."""


@dataclass(frozen=True, slots=True)
class Fence:
    """A simple polygon in local east and north with a margin inside its border.

    Raises:
        ValueError: Fewer than 3 corners, crossing edges, no area, a negative margin, or nothing
            left by it.
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
        if not self.margin_m >= 0.0:
            raise ValueError("the margin of a fence must not be negative")
        if depth_m(self.polygon_enu_m, deepest_point(self.polygon_enu_m)) <= self.margin_m:
            raise ValueError(f"the margin of {self.margin_m:g} m leaves nothing of the fence")

    def allows(self, point: Point) -> bool:
        """Whether a point is inside by at least the margin."""
        return depth_m(self.polygon_enu_m, point) >= self.margin_m

    def limited(self, start: Point, goal: Point) -> Point:
        """The farthest allowed point on the straight way from `start` to `goal`.

        From a start that is not allowed itself (blown outside, or started there) the result is
        the nearest allowed point instead: only ever inwards.
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
        """`point` if it is allowed, otherwise the nearest allowed one."""
        if self.allows(point):
            return point
        candidates = sorted(self._brink(point), key=lambda candidate: math.dist(candidate, point))
        nearest = next((candidate for candidate in candidates if self.allows(candidate)), None)
        return deepest_point(self.polygon_enu_m) if nearest is None else nearest

    def _brink(self, point: Point) -> Iterator[Point]:
        """Where the allowed area may be nearest to `point`.

        That is on an edge moved inwards by the margin, where two of those meet, or on the circle
        about a corner that the inside goes around.
        """
        sides = [(a, b) for a, b in edges(self.polygon_enu_m) if a != b]
        turn = sum(a[0] * b[1] - b[0] * a[1] for a, b in sides)
        inset_m = math.copysign(self.margin_m + ROUNDING_M, turn)
        moved = [_moved_left(a, b, inset_m) for a, b in sides]
        yield from (nearest_on_segment(a, b, point) for a, b in moved)
        yield from (m for pair in combinations(moved, 2) if (m := _meeting(*pair)) is not None)
        for corner, _ in sides:
            if (distance := math.dist(corner, point)) > 0.0:
                yield _between(corner, point, abs(inset_m) / distance)

    def _share_of_way(self, start: Point, goal: Point) -> float:
        """Step of the search: no narrower notch than a quarter of the margin is jumped over."""
        length = math.dist(start, goal)
        return 1.0 if length == 0.0 else min(1.0, max(0.25 * self.margin_m, 0.05) / length)


def _between(a: Point, b: Point, share: float) -> Point:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))


def _moved_left(start: Point, end: Point, by_m: float) -> tuple[Point, Point]:
    """A segment moved sideways, to the left of its direction."""
    share = by_m / math.dist(start, end)
    east, north = share * (start[1] - end[1]), share * (end[0] - start[0])
    return (start[0] + east, start[1] + north), (end[0] + east, end[1] + north)


def _meeting(first: tuple[Point, Point], second: tuple[Point, Point]) -> Point | None:
    """Where the straight lines through two segments meet, or None if they are parallel."""
    (a, b), (c, d) = first, second
    cross = (b[0] - a[0]) * (d[1] - c[1]) - (b[1] - a[1]) * (d[0] - c[0])
    if cross == 0.0:
        return None
    along = (c[0] - a[0]) * (d[1] - c[1]) - (c[1] - a[1]) * (d[0] - c[0])
    return _between(a, b, along / cross)
