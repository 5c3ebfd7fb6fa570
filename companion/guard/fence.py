"""The fence: where a setpoint may be. Standard library only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.geometry.obstacles import ROUNDING_M, FreeSpace
from companion.geometry.polygons import Point, area_m2, deepest_point, depth_m, is_simple

Corners = tuple[Point, ...]

LEAST_FENCE_M2 = 1.0
LEAST_KEEP_OUT_M2 = 1e-3
"""A mast is a keep-out too."""


@dataclass(frozen=True, slots=True)
class Fence:
    """A simple polygon in local east and north, keep-outs in it, and a margin to their borders.

    Raises:
        ValueError: Fewer than 3 corners, crossing edges, no area, a negative margin, or nothing
            left by it.
    """

    polygon_enu_m: Corners
    margin_m: float
    keep_out_enu_m: tuple[Corners, ...] = ()
    space: FreeSpace = field(init=False, repr=False, compare=False)
    """What is left by the fence, the keep-outs and the margin."""

    def __post_init__(self) -> None:
        """Refuse polygons that enclose nothing, and a fence that leaves nothing usable."""
        _check_polygon("fence", self.polygon_enu_m, LEAST_FENCE_M2)
        for polygon in self.keep_out_enu_m:
            _check_polygon("keep-out", polygon, LEAST_KEEP_OUT_M2)
        if not self.margin_m >= 0.0:
            raise ValueError("the margin of a fence must not be negative")
        middle = deepest_point(self.polygon_enu_m)
        if depth_m(self.polygon_enu_m, middle) <= self.margin_m:
            raise ValueError(f"the margin of {self.margin_m:g} m leaves nothing of the fence")
        space = self.free_space(self.margin_m)
        object.__setattr__(self, "space", space)
        if space.nearest_allowed(middle) is None:
            raise ValueError("the keep-outs leave nothing of the fence")

    def free_space(self, margin_m: float) -> FreeSpace:
        """What another margin would leave."""
        return FreeSpace(self.polygon_enu_m, self.keep_out_enu_m, margin_m)

    def allows(self, point: Point) -> bool:
        """Whether a point is inside, and outside every keep-out, by at least the margin."""
        return self.space.allows(point)

    def limited(self, start: Point, goal: Point) -> Point:
        """The farthest point of the straight way from `start` to `goal` with all before allowed.

        From a start that is not allowed itself (blown outside, or started there) the result is
        the nearest allowed point instead: only ever the shortest way back.
        """
        if self.allows(goal) and self.space.is_clear(start, goal):
            return goal
        pieces = self.space.pieces(start, goal)
        if pieces and math.dist(pieces[0][0], start) <= ROUNDING_M:
            return self.nearest_allowed(pieces[0][1])
        return self.nearest_allowed(start)

    def nearest_allowed(self, point: Point) -> Point:
        """`point` if it is allowed, otherwise the nearest allowed one."""
        nearest = self.space.nearest_allowed(point)
        if nearest is None:  # a place so absurd that distances to it mean nothing
            nearest = self.space.nearest_allowed(deepest_point(self.polygon_enu_m))
        assert nearest is not None  # checked when the fence was made
        return nearest


def _check_polygon(name: str, polygon: Corners, least_m2: float) -> None:
    """Refuse a polygon that encloses nothing.

    Raises:
        ValueError: It does not enclose at least this area; the text calls it `name`.
    """
    if len(polygon) < 3:
        raise ValueError(f"a {name} needs at least 3 corners")
    if not all(math.isfinite(v) for corner in polygon for v in corner):
        raise ValueError(f"a {name} corner is not a finite number")
    if not is_simple(polygon):
        raise ValueError(f"two edges of the {name} cross each other")
    if area_m2(polygon) < least_m2:
        raise ValueError(f"the {name} encloses no area")
