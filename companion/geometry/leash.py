"""How far along a straight way one may go from home. Standard library only: the guard uses it."""

from __future__ import annotations

import math

from companion.geometry.obstacles import between
from companion.geometry.polygons import Point


def leashed(start: Point, goal: Point, home: Point, reach_m: float) -> Point:
    """The farthest point of a straight way that is not too far from home.

    From a start that is too far already only what is nearer counts.

    Args:
        start: Where the way begins.
        goal: Where it ends.
        home: Where distances are measured from.
        reach_m: How far is too far.
    """
    radius_m = max(reach_m, math.dist(start, home))
    de, dn = goal[0] - start[0], goal[1] - start[1]
    he, hn = start[0] - home[0], start[1] - home[1]
    a, b = de * de + dn * dn, de * he + dn * hn
    if a == 0.0 or math.dist(goal, home) <= radius_m:  # a: less than a square can tell
        return goal
    left_m2 = radius_m * radius_m - he * he - hn * hn
    return between(start, goal, (math.sqrt(b * b + a * max(0.0, left_m2)) - b) / a)
