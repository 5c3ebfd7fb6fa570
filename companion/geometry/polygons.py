"""Simple polygons and confidence ellipses in the horizontal plane.

Standard library only, because the guard is built on it. Points are (east, north) in metres; a
polygon is a sequence of at least three corners, not closed, in either direction, convex or not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

Point = tuple[float, float]
"""East and north, metres."""
Polygon = Sequence[Point]
Corners = tuple[Point, ...]

FARTHEST_M = 1e6
"""Largest coordinate of a local frame."""
TOUCH_M = 1e-3
"""Distance below which edges of one polygon touch: no file or autopilot resolves less."""


def edges(polygon: Polygon) -> Iterator[tuple[Point, Point]]:
    """Yield every edge as (start, end), the closing one included."""
    for index, start in enumerate(polygon):
        yield start, polygon[(index + 1) % len(polygon)]


def contains(polygon: Polygon, point: Point) -> bool:
    """Return True if `point` is inside, by the crossing number; either on the border itself."""
    east, north = point
    inside = False
    e0, n0 = polygon[-1]
    for e1, n1 in polygon:
        if (n0 > north) != (n1 > north) and east < (e1 - e0) * (north - n0) / (n1 - n0) + e0:
            inside = not inside
        e0, n0 = e1, n1
    return inside


def nearest_on_segment(start: Point, end: Point, point: Point) -> Point:
    """Return the point of the segment that is nearest to `point`."""
    de, dn = end[0] - start[0], end[1] - start[1]
    length2 = de * de + dn * dn
    if length2 == 0.0:
        return start
    t = ((point[0] - start[0]) * de + (point[1] - start[1]) * dn) / length2
    if not t > 0.0:
        return start
    if t > 1.0:
        t = 1.0
    return (start[0] + t * de, start[1] + t * dn)


def distance_to_border_m(polygon: Polygon, point: Point) -> float:
    """Return the distance to the nearest edge, metres, from inside or outside."""
    least_m = math.inf
    start = polygon[-1]
    for end in polygon:
        distance_m = math.dist(point, nearest_on_segment(start, end, point))
        if distance_m < least_m:
            least_m = distance_m
        start = end
    return least_m


def depth_m(polygon: Polygon, point: Point) -> float:
    """Return the distance to the border, positive inside and negative outside."""
    distance = distance_to_border_m(polygon, point)
    return distance if contains(polygon, point) else -distance


def segments_cross(a0: Point, a1: Point, b0: Point, b1: Point) -> bool:
    """Return True if two segments intersect in the interior of both (touching ends do not)."""

    def side(p: Point, q: Point, r: Point) -> float:
        """Return a number that is positive if r is to the left of p q, negative to the right."""
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a0, a1, b0) * side(a0, a1, b1) < 0.0 and side(b0, b1, a0) * side(b0, b1, a1) < 0.0


def are_apart(reach_m: float, a0: Point, a1: Point, b0: Point, b1: Point) -> bool:
    """Return True if the bounding boxes of two segments are farther apart than a distance."""
    return (
        min(a0[0], a1[0]) - reach_m > max(b0[0], b1[0])
        or max(a0[0], a1[0]) + reach_m < min(b0[0], b1[0])
        or min(a0[1], a1[1]) - reach_m > max(b0[1], b1[1])
        or max(a0[1], a1[1]) + reach_m < min(b0[1], b1[1])
    )


def are_within(reach_m: float, a0: Point, a1: Point, b0: Point, b1: Point) -> bool:
    """Return True if two segments come closer to each other than a distance."""
    if are_apart(reach_m, a0, a1, b0, b1):
        return False
    if segments_cross(a0, a1, b0, b1):
        return True
    return (
        math.dist(a0, nearest_on_segment(b0, b1, a0)) < reach_m
        or math.dist(a1, nearest_on_segment(b0, b1, a1)) < reach_m
        or math.dist(b0, nearest_on_segment(a0, a1, b0)) < reach_m
        or math.dist(b1, nearest_on_segment(a0, a1, b1)) < reach_m
    )


def is_simple(polygon: Polygon) -> bool:
    """Return True if no edge crosses or touches another one except its neighbour at their corner.

    Repeated corners count once. Where edges touch otherwise, crossing number and orientation no
    longer define the inside: a ring that is traversed twice has none.
    """
    corners = [a for a, b in edges(polygon) if math.dist(a, b) > TOUCH_M]
    if len(corners) <= 3:
        return True  # their area decides whether they enclose anything
    sides = list(edges(corners))
    last = len(sides) - 1
    return not any(
        are_within(TOUCH_M, *sides[i], *sides[j])
        for i in range(last)
        for j in range(i + 2, last + 1)
        if (i, j) != (0, last)  # neighbours at the closing corner
    )


def polygon_problem(polygon: Polygon, least_m2: float) -> str | None:
    """Return the reason, to follow its name, why a polygon does not enclose this area, or None."""
    if len(polygon) < 3:
        return "needs at least 3 corners"
    if not all(math.isfinite(value) for corner in polygon for value in corner):
        return "has a corner that is not a finite number"
    if not all(abs(value) <= FARTHEST_M for corner in polygon for value in corner):
        return f"has a corner farther than {FARTHEST_M / 1000.0:g} km from the origin"
    if not is_simple(polygon):
        return "has two edges that touch or cross each other"
    return None if area_m2(polygon) >= least_m2 else "encloses no area"


def check_polygon(name: str, polygon: Polygon, least_m2: float) -> None:
    """Raise `ValueError` for a polygon with a `polygon_problem`; the text calls it `name`."""
    problem = polygon_problem(polygon, least_m2)
    if problem is not None:
        raise ValueError(f"a {name} {problem}")


def signed_area_m2(polygon: Polygon) -> float:
    """Return the enclosed area, square metres, positive if counter-clockwise (shoelace formula)."""
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in edges(polygon)) / 2.0


def area_m2(polygon: Polygon) -> float:
    """Return the enclosed area, square metres, never negative."""
    return abs(signed_area_m2(polygon))


def deepest_point(polygon: Polygon, cells: int = 24) -> Point:
    """Return a point about as far inside as possible, from a grid of the bounding box."""
    easts, norths = [p[0] for p in polygon], [p[1] for p in polygon]
    candidates = (
        (
            min(easts) + (max(easts) - min(easts)) * (i + 0.5) / cells,
            min(norths) + (max(norths) - min(norths)) * (j + 0.5) / cells,
        )
        for i in range(cells)
        for j in range(cells)
    )
    return max(candidates, key=lambda point: depth_m(polygon, point))


Covariance = tuple[tuple[float, float], tuple[float, float]]

CHI2_95_TWO = 5.991464547107979
"""95 % quantile of chi-square with two degrees of freedom, -2 ln 0.05."""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Ellipse about a point in local east and north."""

    centre_enu_m: Point
    semi_major_m: float
    semi_minor_m: float
    major_enu_rad: float
    """Direction of the major axis, counter-clockwise from east, in (-pi/2, pi/2]."""

    def corners_enu_m(self, count: int = 48) -> tuple[Point, ...]:
        """Return points along the ellipse, 3 at least, counter-clockwise, without repetition."""
        along, across = math.cos(self.major_enu_rad), math.sin(self.major_enu_rad)
        corners = []
        for index in range(max(3, count)):
            turn = 2.0 * math.pi * index / max(3, count)
            major = self.semi_major_m * math.cos(turn)
            minor = self.semi_minor_m * math.sin(turn)
            east = self.centre_enu_m[0] + major * along - minor * across
            north = self.centre_enu_m[1] + major * across + minor * along
            corners.append((east, north))
        return tuple(corners)


def ellipse_95(centre_enu_m: Point, covariance_m2: Covariance) -> Ellipse:
    """Return the ellipse that holds 95 % of a plane normal; negative variances count as zero."""
    (east, cross), (_, north) = covariance_m2
    middle, half = 0.5 * (east + north), 0.5 * (east - north)
    reach = math.hypot(half, cross)
    major = math.sqrt(max(0.0, middle + reach) * CHI2_95_TWO)
    minor = math.sqrt(max(0.0, middle - reach) * CHI2_95_TWO)
    turn = 0.5 * math.atan2(cross, half)  # atan2(0, 0) is 0: a circle points east
    return Ellipse(centre_enu_m, major, minor, turn)
