"""The fence: the area where a setpoint may be. Standard library only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.geometry.obstacles import ROUNDING_M, FreeSpace, check_corners
from companion.geometry.polygons import Corners, Point, check_polygon, deepest_point, depth_m

LEAST_FENCE_M2 = 1.0
LEAST_KEEP_OUT_M2 = 1e-3
"""A mast is a keep-out too."""


@dataclass(frozen=True, slots=True)
class Fence:
    """A simple polygon in local east and north, keep-outs in it, and a margin to their borders.

    `also_inside_enu_m` are polygons that apply at the same time: the allowed area lies inside all
    of them. A `ValueError` names the fault: fewer than 3 corners, crossing edges, no area, more
    corners in all than can be checked in time, a negative margin, or no area left by it.
    """

    polygon_enu_m: Corners
    margin_m: float
    keep_out_enu_m: tuple[Corners, ...] = ()
    also_inside_enu_m: tuple[Corners, ...] = ()
    space: FreeSpace = field(init=False, repr=False, compare=False)
    """Area left by the fence, the keep-outs and the margin."""

    def __post_init__(self) -> None:
        """Refuse polygons that enclose nothing, and a fence that leaves nothing usable."""
        check_corners((self.polygon_enu_m, *self.keep_out_enu_m, *self.also_inside_enu_m))
        for polygon in (self.polygon_enu_m, *self.also_inside_enu_m):
            check_polygon("fence", polygon, LEAST_FENCE_M2)
        for polygon in self.keep_out_enu_m:
            check_polygon("keep-out", polygon, LEAST_KEEP_OUT_M2)
        if not self.margin_m >= 0.0:
            raise ValueError("the margin of a fence must be 0 or more")
        middle = deepest_point(self.polygon_enu_m)
        if depth_m(self.polygon_enu_m, middle) <= self.margin_m:
            raise ValueError(f"the margin of {self.margin_m:g} m leaves nothing of the fence")
        space = self.free_space(self.margin_m)
        object.__setattr__(self, "space", space)
        if not any(space.boundary):
            rest = "its other borders" if self.also_inside_enu_m else "the keep-outs"
            raise ValueError(f"{rest} leave nothing of the fence")

    def free_space(self, margin_m: float) -> FreeSpace:
        """Return the area that another margin would leave."""
        return FreeSpace(self.polygon_enu_m, self.keep_out_enu_m, margin_m, self.also_inside_enu_m)

    def allows(self, point: Point) -> bool:
        """Return True if a point is inside, and outside every keep-out, by at least the margin."""
        return self.space.allows(point)

    def limited(self, start: Point, goal: Point) -> Point:
        """Return the farthest point of the line from `start` to `goal` with all before allowed.

        From a start that is not allowed itself (blown outside, or started there) the result is the
        nearest allowed point instead: only ever the shortest way back.
        """
        if self.allows(goal) and self.space.is_clear(start, goal):
            return goal
        first, end = next(self.space.pieces(start, goal), (goal, goal))
        if math.dist(first, start) <= ROUNDING_M:
            return self.nearest_allowed(end)
        return self.nearest_allowed(start)

    def nearest_allowed(self, point: Point) -> Point:
        """Return `point` if it is allowed, otherwise the nearest allowed one."""
        nearest = self.space.nearest_allowed(point)
        assert nearest is not None  # the constructor has checked that there is free space
        return nearest
