"""Free space: inside a fence, outside keep-out polygons, and a margin away from every border.

Theory of operation. What is closer to an edge than the margin is a capsule: the edge, widened to
both sides and rounded at its ends. A capsule is convex, so a straight leg meets it in one interval,
and what is free of a leg follows exactly, without sampling. The way back into free space ends on an
edge moved by the margin, on the circle about a corner, or where two of these meet.

Standard library only, because the guard stands on it. Points are (east, north) in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

from companion.geometry.polygons import (
    Point,
    Polygon,
    contains,
    depth_m,
    edges,
    nearest_on_segment,
    segments_cross,
    signed_area_m2,
)

ROUNDING_M = 1e-6
"""How much farther in than the margin a point is put, so that rounding cannot undo it."""
GRAZE_M = 1e-9
"""A leg that keeps the margin up to this much keeps it: rounding of a leg along a border."""

Segment = tuple[Point, Point]


class FreeSpace:
    """Where a vehicle may be.

    Args:
        fence_enu_m: Corners of the fence; None: no fence.
        keep_out_enu_m: Polygons to stay out of.
        margin_m: Distance to keep from every border, on its allowed side.
    """

    def __init__(
        self,
        fence_enu_m: Polygon | None,
        keep_out_enu_m: Sequence[Polygon] = (),
        margin_m: float = 0.0,
    ) -> None:
        self.margin_m = margin_m
        self.fence_enu_m = None if fence_enu_m is None else _with_free_left(fence_enu_m, 1.0)
        self.keep_out_enu_m = tuple(_with_free_left(polygon, -1.0) for polygon in keep_out_enu_m)
        fences = () if self.fence_enu_m is None else (self.fence_enu_m,)
        self.borders: tuple[tuple[Point, ...], ...] = fences + self.keep_out_enu_m
        """Every polygon, without repeated corners, with free space to the left of its edges."""
        self._edges: tuple[Segment, ...] = tuple(
            e for border in self.borders for e in edges(border)
        )

    def allows(self, point: Point) -> bool:
        """Whether a point is on the allowed side of every border, by at least the margin."""
        if self.fence_enu_m is not None and not depth_m(self.fence_enu_m, point) >= self.margin_m:
            return False
        return all(-depth_m(polygon, point) >= self.margin_m for polygon in self.keep_out_enu_m)

    def is_clear(self, start: Point, end: Point) -> bool:
        """Whether the whole straight leg keeps the margin, its ends included."""
        if self.fence_enu_m is not None and not contains(self.fence_enu_m, start):
            return False
        if any(contains(polygon, start) for polygon in self.keep_out_enu_m):
            return False
        reach_m = max(self.margin_m - GRAZE_M, GRAZE_M)
        return not any(_is_within(reach_m, start, end, *edge) for edge in self._edges)

    def pieces(self, start: Point, end: Point) -> list[Segment]:
        """What is free of a straight leg, as legs in its direction."""
        radius_m = self.margin_m + GRAZE_M
        shares = [share_in_capsule(start, end, edge, radius_m) for edge in self._edges]
        cuts = {0.0, 1.0}
        cuts.update(min(max(t, 0.0), 1.0) for share in shares if share is not None for t in share)
        free: list[tuple[float, float]] = []
        for low, high in pairwise(sorted(cuts)):
            if not self.allows(between(start, end, 0.5 * (low + high))):
                continue
            if free and free[-1][1] == low:
                low = free.pop()[0]
            free.append((low, high))
        return [(between(start, end, low), between(start, end, high)) for low, high in free]

    def nearest_allowed(self, point: Point) -> Point | None:
        """`point` if it is allowed, otherwise the nearest allowed one; None if there is none."""
        if self.allows(point):
            return point
        inset_m = self.margin_m + ROUNDING_M
        moved = [moved_left(a, b, inset_m) for a, b in self._edges]
        corners = [a for a, _ in self._edges]
        simple = [nearest_on_segment(a, b, point) for a, b in moved]
        simple += [_on_circle(corner, inset_m, point) for corner in corners]
        nearest = self._nearest_of(simple, point)
        reach_m = math.inf if nearest is None else math.dist(nearest, point)
        meetings = list(_meetings(moved, corners, inset_m, point, reach_m))
        return self._nearest_of([*meetings, *([] if nearest is None else [nearest])], point)

    def _nearest_of(self, candidates: Sequence[Point], point: Point) -> Point | None:
        ordered = sorted(candidates, key=lambda candidate: math.dist(candidate, point))
        return next((candidate for candidate in ordered if self.allows(candidate)), None)


def between(a: Point, b: Point, share: float) -> Point:
    """The point that lies by a share of the way from `a` to `b`; at 0 and 1 exactly these."""
    if share == 1.0:
        return b
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))


def moved_left(start: Point, end: Point, by_m: float) -> Segment:
    """A segment moved sideways, to the left of its direction."""
    share = by_m / math.dist(start, end)
    east, north = share * (start[1] - end[1]), share * (end[0] - start[0])
    return (start[0] + east, start[1] + north), (end[0] + east, end[1] + north)


def share_in_capsule(
    start: Point, end: Point, edge: Segment, radius_m: float
) -> tuple[float, float] | None:
    """The part of a leg that is closer to an edge than a radius, as shares of the leg's line.

    Args:
        start: Of the leg.
        end: Of the leg.
        edge: With two different ends.
        radius_m: Of the capsule about the edge.
    """
    (ae, an), (be, bn) = edge
    length = math.hypot(be - ae, bn - an)
    ue, un = (be - ae) / length, (bn - an) / length
    de, dn = end[0] - start[0], end[1] - start[1]
    se, sn = start[0] - ae, start[1] - an
    along, slope_along = se * ue + sn * un, de * ue + dn * un
    aside, slope_aside = ue * sn - un * se, ue * dn - un * de
    middle = _both(
        _share_in_band(along, slope_along, 0.0, length),
        _share_in_band(aside, slope_aside, -radius_m, radius_m),
    )
    parts = [
        middle,
        _share_in_circle(se, sn, de, dn, radius_m),
        _share_in_circle(start[0] - be, start[1] - bn, de, dn, radius_m),
    ]
    met = [part for part in parts if part is not None]
    return (min(t for t, _ in met), max(t for _, t in met)) if met else None


def _share_in_band(
    value: float, slope: float, low: float, high: float
) -> tuple[float, float] | None:
    """Where low <= value + t slope <= high."""
    if slope == 0.0:
        return (-math.inf, math.inf) if low <= value <= high else None
    first, second = (low - value) / slope, (high - value) / slope
    return (min(first, second), max(first, second))


def _both(
    first: tuple[float, float] | None, second: tuple[float, float] | None
) -> tuple[float, float] | None:
    if first is None or second is None:
        return None
    low, high = max(first[0], second[0]), min(first[1], second[1])
    return (low, high) if low <= high else None


def _share_in_circle(
    se: float, sn: float, de: float, dn: float, radius_m: float
) -> tuple[float, float] | None:
    """Where (s + t d) is within a radius of zero."""
    a, b, c = de * de + dn * dn, se * de + sn * dn, se * se + sn * sn - radius_m * radius_m
    if a == 0.0:
        return (-math.inf, math.inf) if c <= 0.0 else None
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return None
    root = math.sqrt(discriminant)
    return ((-b - root) / a, (-b + root) / a)


def _is_within(reach_m: float, a0: Point, a1: Point, b0: Point, b1: Point) -> bool:
    """Whether two segments come closer to each other than a distance."""
    if min(a0[0], a1[0]) - reach_m > max(b0[0], b1[0]):
        return False
    if max(a0[0], a1[0]) + reach_m < min(b0[0], b1[0]):
        return False
    if min(a0[1], a1[1]) - reach_m > max(b0[1], b1[1]):
        return False
    if max(a0[1], a1[1]) + reach_m < min(b0[1], b1[1]):
        return False
    if segments_cross(a0, a1, b0, b1):
        return True
    return (
        math.dist(a0, nearest_on_segment(b0, b1, a0)) < reach_m
        or math.dist(a1, nearest_on_segment(b0, b1, a1)) < reach_m
        or math.dist(b0, nearest_on_segment(a0, a1, b0)) < reach_m
        or math.dist(b1, nearest_on_segment(a0, a1, b1)) < reach_m
    )


def _with_free_left(polygon: Polygon, side: float) -> tuple[Point, ...]:
    """A polygon counter-clockwise (side 1) or clockwise (-1), without repeated corners."""
    corners = tuple(a for a, b in edges(polygon) if a != b)
    return corners if side * signed_area_m2(corners) >= 0.0 else corners[::-1]


def _on_circle(centre: Point, radius_m: float, point: Point) -> Point:
    """The point of a circle that is nearest to `point`."""
    distance = math.dist(centre, point)
    return centre if distance == 0.0 else between(centre, point, radius_m / distance)


def _meetings(
    lines: Sequence[Segment],
    centres: Sequence[Point],
    radius_m: float,
    point: Point,
    reach_m: float,
) -> Iterator[Point]:
    """Where moved edges and circles about corners meet each other, of those within reach.

    The allowed space may end there in a nook, and only there be nearest to `point`.
    """
    near = [s for s in lines if math.dist(nearest_on_segment(*s, point), point) < reach_m]
    round_ = [c for c in centres if math.dist(_on_circle(c, radius_m, point), point) < reach_m]
    yield from (m for pair in combinations(near, 2) if (m := _crossing(*pair)) is not None)
    for centre in round_:
        for a, b in near:
            offset = (a[0] - centre[0], a[1] - centre[1])
            share = _share_in_circle(*offset, b[0] - a[0], b[1] - a[1], radius_m)
            if share is not None:
                yield from (between(a, b, t) for t in share)
    for one, other in combinations(round_, 2):
        distance = math.dist(one, other)
        if 0.0 < distance <= 2.0 * radius_m:
            middle, half = between(one, other, 0.5), 0.5 * distance
            aside = math.sqrt(radius_m * radius_m - half * half) / distance
            east, north = aside * (one[1] - other[1]), aside * (other[0] - one[0])
            yield (middle[0] + east, middle[1] + north)
            yield (middle[0] - east, middle[1] - north)


def _crossing(first: Segment, second: Segment) -> Point | None:
    """Where the straight lines through two segments meet, or None if they are parallel."""
    (a, b), (c, d) = first, second
    cross = (b[0] - a[0]) * (d[1] - c[1]) - (b[1] - a[1]) * (d[0] - c[0])
    if cross == 0.0:
        return None
    along = (c[0] - a[0]) * (d[1] - c[1]) - (c[1] - a[1]) * (d[0] - c[0])
    return between(a, b, along / cross)
