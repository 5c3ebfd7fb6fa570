"""Free space, a margin away from every border of fence and keep-outs, and shortest paths in it.

Theory of operation. The points closer to an edge than the margin form a capsule: the edge, widened
to both sides and rounded at its ends. A capsule is convex, so a straight leg intersects it in one
interval, and the free parts of a leg follow exactly, without sampling. The nearest free point lies
on an edge shifted by the margin or on the circle about a corner, where these are not too close to
another edge. Together these form the boundary of free space; it is computed once, and the nearest
free point is then searched among its parts.

Standard library only, because the guard is built on it. Points are (east, north) in metres.

A shortest path among polygons turns only where free space is not convex: at
the corners of keep-outs and at the inward corners of a fence. With a margin such a corner is an
arc; legs go around it along the polygon about that arc, so a corner gives one or more nodes. The
clear legs between nodes form the graph, computed on demand and cached, and A* with the straight
distance searches it. A clear straight leg needs no graph at all.

Going about an arc instead of along it costs at most 8 % of the margin, so a gap narrower than that
beyond twice the margin may count as closed.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from companion.geometry.polygons import (
    Point,
    Polygon,
    are_apart,
    are_within,
    contains,
    edges,
    nearest_on_segment,
    signed_area_m2,
)

MAX_CORNERS = 200
"""Limit for a fence and its keep-outs together: the guard checks every edge in every tick."""
ROUNDING_M = 1e-6
"""Distance that a point is moved beyond the margin, so that rounding cannot undo it."""
GRAZE_M = 1e-9
"""Tolerance of the margin for a leg along a border: rounding."""

Segment = tuple[Point, Point]


class FreeSpace:
    """Free space `margin_m` off the borders of a fence, if any, and of `also_inside_enu_m`."""

    def __init__(
        self,
        fence_enu_m: Polygon | None,
        keep_out_enu_m: Sequence[Polygon] = (),
        margin_m: float = 0.0,
        also_inside_enu_m: Sequence[Polygon] = (),
    ) -> None:
        self.margin_m = margin_m
        self.fence_enu_m = None if fence_enu_m is None else _with_free_left(fence_enu_m, 1.0)
        self.keep_out_enu_m = tuple(_with_free_left(polygon, -1.0) for polygon in keep_out_enu_m)
        first = () if self.fence_enu_m is None else (self.fence_enu_m,)
        self._fences = (*first, *(_with_free_left(each, 1.0) for each in also_inside_enu_m))
        self.borders: tuple[tuple[Point, ...], ...] = self._fences + self.keep_out_enu_m
        """All polygons without repeated corners, oriented so that free space is to the left."""
        self._edges: tuple[Segment, ...] = tuple(
            e for border in self.borders for e in edges(border)
        )
        self._boxed = tuple((edge, _box(edge)) for edge in self._edges)

    def allows(self, point: Point) -> bool:
        """Return True if a point is free of every border by the margin; never on a border."""
        least_m = max(self.margin_m, GRAZE_M)
        near = self._edges_near(point, point, least_m + GRAZE_M)
        if not near:
            return near is not None
        return all(math.dist(point, nearest_on_segment(*edge, point)) >= least_m for edge in near)

    def is_clear(self, start: Point, end: Point) -> bool:
        """Return True if the whole straight leg keeps the margin, its ends included."""
        reach_m = max(self.margin_m - GRAZE_M, GRAZE_M)
        near = self._edges_near(start, end, reach_m)
        if not near:
            return near is not None
        return not any(are_within(reach_m, start, end, *edge) for edge in near)

    def _edges_near(self, start: Point, end: Point, reach_m: float) -> list[Segment] | None:
        """Return the edges whose bounding box is within reach of a leg's: in practice few.

        None if the leg does not start inside of every fence and outside of every keep-out.
        """
        for fence in self._fences:
            if not contains(fence, start):
                return None
        for keep_out in self.keep_out_enu_m:
            if contains(keep_out, start):
                return None
        west, east = min(start[0], end[0]) - reach_m, max(start[0], end[0]) + reach_m
        south, north = min(start[1], end[1]) - reach_m, max(start[1], end[1]) + reach_m
        near = []
        for edge, (west_m, east_m, south_m, north_m) in self._boxed:
            if not (west > east_m or east < west_m or south > north_m or north < south_m):
                near.append(edge)
        return near

    def pieces(self, start: Point, end: Point) -> Iterator[Segment]:
        """Yield the free parts of a straight leg, in its direction and order."""
        cuts = {0.0, 1.0}
        for share in self._shares(start, end, self.margin_m + GRAZE_M):
            cuts.update(min(max(t, 0.0), 1.0) for t in share)
        for low, high in _runs(sorted(cuts), lambda t: self.allows(between(start, end, t))):
            yield between(start, end, low), between(start, end, high)

    def nearest_allowed(self, point: Point) -> Point | None:
        """Return `point` if it is free, otherwise the nearest free one; None if there is none."""
        if self.allows(point):
            return point
        legs, arcs = self.boundary
        nearest = [nearest_on_segment(*leg, point) for leg in legs]
        nearest += [arc.nearest(point) for arc in arcs]
        nearest.sort(key=lambda candidate: math.dist(candidate, point))
        return next((candidate for candidate in nearest if self.allows(candidate)), None)

    @cached_property
    def boundary(self) -> tuple[tuple[Segment, ...], tuple[Arc, ...]]:
        """Boundary of free space, slightly inside the margin; empty without free space."""
        return tuple(self._moved_edges()), tuple(self._arcs())

    def _moved_edges(self) -> Iterator[Segment]:
        """Yield the parts of the edges, shifted by the margin, that are clear of other edges."""
        keep_m = self.margin_m + 0.5 * ROUNDING_M
        for edge in self._edges:
            start, end = moved_left(*edge, self.margin_m + ROUNDING_M)
            clear = 0.0
            for low, high in [*sorted(self._shares(start, end, keep_m)), (1.0, 1.0)]:
                free_to = min(low, 1.0)
                if free_to > clear and self.allows(between(start, end, 0.5 * (clear + free_to))):
                    yield between(start, end, clear), between(start, end, free_to)
                clear = max(clear, high)

    def _arcs(self) -> Iterator[Arc]:
        """Yield the parts of circles about protruding corners that are clear of the other edges."""
        for border in self.borders:
            for index, corner in enumerate(border):
                before, after = border[index - 1], border[(index + 1) % len(border)]
                whole = _around(before, corner, after, self.margin_m + ROUNDING_M)
                if whole.turn_rad > 0.0:
                    yield from self._free_of(whole)

    def _free_of(self, arc: Arc) -> Iterator[Arc]:
        def is_on_boundary(turn_rad: float) -> bool:
            position = arc.at(turn_rad)
            for edge in self._edges:
                if math.dist(nearest_on_segment(*edge, position), position) < self.margin_m:
                    return False  # sooner than by `allows`: most points fail at one near edge
            return self.allows(position)

        cuts = {0.0, arc.turn_rad, *self._cuts(arc)}
        for low, high in _runs(sorted(cuts), is_on_boundary):
            yield Arc(arc.centre, arc.radius_m, arc.first_rad + low, high - low)

    def _cuts(self, arc: Arc) -> Iterator[float]:
        """Yield the turns along an arc where it may enter or leave the margin of an edge."""
        keep_m = self.margin_m + 0.5 * ROUNDING_M
        for edge in self._edges:
            away_m = math.dist(nearest_on_segment(*edge, arc.centre), arc.centre)
            if away_m <= arc.radius_m + keep_m:
                for direction_rad in _directions(arc, edge, keep_m):
                    turn_rad = (direction_rad - arc.first_rad) % math.tau
                    if turn_rad < arc.turn_rad:
                        yield turn_rad

    def _shares(self, start: Point, end: Point, radius_m: float) -> Iterator[tuple[float, float]]:
        """Yield the parts of a leg within a radius of an edge, as from `share_in_capsule`."""
        for edge in self._edges:
            if not are_apart(radius_m, start, end, *edge):
                share = share_in_capsule(start, end, edge, radius_m)
                if share is not None:
                    yield share


@dataclass(frozen=True, slots=True)
class Arc:
    """Part of a circle, counter-clockwise."""

    centre: Point
    radius_m: float
    first_rad: float
    """Direction of its beginning, counter-clockwise from east."""
    turn_rad: float
    """Angle from there to its end, less than a whole turn."""

    def at(self, turn_rad: float) -> Point:
        """Return the point at an angle from the beginning."""
        direction_rad = self.first_rad + turn_rad
        return (
            self.centre[0] + self.radius_m * math.cos(direction_rad),
            self.centre[1] + self.radius_m * math.sin(direction_rad),
        )

    def nearest(self, point: Point) -> Point:
        """Return the point of the arc that is nearest to `point`."""
        direction_rad = math.atan2(point[1] - self.centre[1], point[0] - self.centre[0])
        turn_rad = (direction_rad - self.first_rad) % math.tau
        if turn_rad <= self.turn_rad:
            return self.at(turn_rad)
        ends = self.at(0.0), self.at(self.turn_rad)
        return min(ends, key=lambda end: math.dist(end, point))


def check_corners(polygons: Iterable[Polygon]) -> None:
    """Raise `ValueError` for polygons with more corners than can be checked in every tick."""
    count = sum(map(len, polygons))
    if count > MAX_CORNERS:
        raise ValueError(
            f"{count} corners in all, with those of keep_out_enu_m; at most {MAX_CORNERS} can "
            "be checked in time"
        )


def between(a: Point, b: Point, share: float) -> Point:
    """Return the point at a share of the way from `a` to `b`; at 0 and 1 exactly these."""
    if share == 1.0:
        return b
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))


def _box(edge: Segment) -> tuple[float, float, float, float]:
    """Return west, east, south and north of an edge."""
    (e0, n0), (e1, n1) = edge
    return min(e0, e1), max(e0, e1), min(n0, n1), max(n0, n1)


def moved_left(start: Point, end: Point, by_m: float) -> Segment:
    """Return a segment shifted sideways, to the left of its direction."""
    share = by_m / math.dist(start, end)
    east, north = share * (start[1] - end[1]), share * (end[0] - start[0])
    return (start[0] + east, start[1] + north), (end[0] + east, end[1] + north)


def share_in_capsule(
    start: Point, end: Point, edge: Segment, radius_m: float
) -> tuple[float, float] | None:
    """Return the part of a leg within a radius of an edge as shares of the leg, or None."""
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
    """Return the interval of t with low <= value + t slope <= high; None if it is empty."""
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
    """Return the interval of t with |s + t d| <= radius; None if it is empty."""
    a, b, c = de * de + dn * dn, se * de + sn * dn, se * se + sn * sn - radius_m * radius_m
    if a == 0.0:
        return (-math.inf, math.inf) if c <= 0.0 else None
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return None
    root = math.sqrt(discriminant)
    return ((-b - root) / a, (-b + root) / a)


def _with_free_left(polygon: Polygon, side: float) -> tuple[Point, ...]:
    """Return a polygon counter-clockwise (side 1) or clockwise (-1), without repeated corners."""
    corners = tuple(a for a, b in edges(polygon) if a != b)
    return corners if side * signed_area_m2(corners) >= 0.0 else corners[::-1]


def _runs(cuts: Sequence[float], is_free: Callable[[float], bool]) -> Iterator[tuple[float, float]]:
    """Yield the free intervals of a function that changes only at cuts, by testing between them."""
    begun: float | None = None
    for low, high in pairwise(cuts):
        if not is_free(0.5 * (low + high)):
            if begun is not None:
                yield begun, low
            begun = None
        elif begun is None:
            begun = low
    if begun is not None:
        yield begun, cuts[-1]


def _around(before: Point, corner: Point, after: Point, radius_m: float) -> Arc:
    """Return the arc about a corner between its edges, on their left; empty where it is convex."""
    incoming = (corner[0] - before[0], corner[1] - before[1])
    outgoing = (after[0] - corner[0], after[1] - corner[1])
    cross = incoming[0] * outgoing[1] - incoming[1] * outgoing[0]
    dot = incoming[0] * outgoing[0] + incoming[1] * outgoing[1]
    turn_rad = max(0.0, -math.atan2(cross or -0.0, dot))  # a spike of zero width turns by pi
    return Arc(corner, radius_m, math.atan2(outgoing[0], -outgoing[1]), turn_rad)


def _directions(arc: Arc, edge: Segment, keep_m: float) -> Iterator[float]:
    """Yield the directions from its centre where a circle may cross the capsule of an edge."""
    (ae, an), (be, bn) = edge
    for corner in edge:
        east, north = corner[0] - arc.centre[0], corner[1] - arc.centre[1]
        away_m = math.hypot(east, north)
        if abs(arc.radius_m - keep_m) <= away_m <= arc.radius_m + keep_m and away_m > 0.0:
            part = (arc.radius_m**2 + away_m**2 - keep_m**2) / (2.0 * arc.radius_m * away_m)
            half_rad, middle_rad = math.acos(min(part, 1.0)), math.atan2(north, east)
            yield from (middle_rad - half_rad, middle_rad + half_rad)
    along_rad = math.atan2(bn - an, be - ae)
    se, sn = arc.centre[0] - ae, arc.centre[1] - an
    aside_m = sn * math.cos(along_rad) - se * math.sin(along_rad)
    for line_m in (-keep_m, keep_m):
        part = (line_m - aside_m) / arc.radius_m
        if abs(part) <= 1.0:
            yield from (along_rad + math.asin(part), along_rad + math.pi - math.asin(part))


def limited_to_reach(start: Point, goal: Point, home: Point, reach_m: float) -> Point:
    """Return the farthest point towards a goal within reach of home, or nearer than the start."""
    radius_m = max(reach_m, math.dist(start, home))
    de, dn = goal[0] - start[0], goal[1] - start[1]
    he, hn = start[0] - home[0], start[1] - home[1]
    a, b = de * de + dn * dn, de * he + dn * hn
    if a == 0.0 or math.dist(goal, home) <= radius_m:  # a: below the resolution of squares
        return goal
    left_m2 = radius_m * radius_m - he * he - hn * hn
    return between(start, goal, (math.sqrt(b * b + a * max(0.0, left_m2)) - b) / a)


ARC_STEP_RAD = math.pi / 4.0
"""Largest part of an arc around one node: 1 / cos(22.5 deg) is the 8 % above."""
NODE_SLACK_M = 1e-6
"""Distance of nodes beyond the margin, so that rounding does not block their legs."""
START, GOAL = -1, -2
"""Indices of the start and the goal in the graph."""


class WayFinder:
    """Path finder through one free space."""

    def __init__(self, space: FreeSpace) -> None:
        self.space = space
        self.nodes: tuple[Point, ...] = tuple(
            node
            for border in space.borders
            for node in _corner_nodes(border, space.margin_m + NODE_SLACK_M)
            if space.allows(node)
        )
        self._legs: dict[int, tuple[tuple[int, float], ...]] = {}

    def way(self, start: Point, goal: Point) -> tuple[Point, ...] | None:
        """Return the corners of the shortest path and its goal, or None if there is no path."""
        if self.space.is_clear(start, goal):
            return (goal,)
        arrived: dict[int, int] = {}
        queue = [(math.dist(start, goal), 0.0, START, START)]
        while queue:
            _, flown_m, here, previous = heapq.heappop(queue)
            if here in arrived:
                continue
            arrived[here] = previous
            if here == GOAL:
                return self._traced(arrived, goal)
            for there, leg_m in self._legs_from(here, start, goal):
                if there not in arrived:
                    node = goal if there == GOAL else self.nodes[there]
                    ahead_m = flown_m + leg_m
                    heapq.heappush(queue, (ahead_m + math.dist(node, goal), ahead_m, there, here))
        return None

    def _legs_from(self, here: int, start: Point, goal: Point) -> Iterator[tuple[int, float]]:
        if here == START:
            yield from self._seen_from(start, START)
            return
        if here not in self._legs:
            self._legs[here] = tuple(self._seen_from(self.nodes[here], here))
        yield from self._legs[here]
        if self.space.is_clear(self.nodes[here], goal):
            yield GOAL, math.dist(self.nodes[here], goal)

    def _seen_from(self, position: Point, own: int) -> Iterator[tuple[int, float]]:
        for index, node in enumerate(self.nodes):
            if index != own and self.space.is_clear(position, node):
                yield index, math.dist(position, node)

    def _traced(self, arrived: dict[int, int], goal: Point) -> tuple[Point, ...]:
        corners, here = [goal], arrived[GOAL]
        while here != START:
            corners.append(self.nodes[here])
            here = arrived[here]
        return tuple(reversed(corners))


def _corner_nodes(border: tuple[Point, ...], radius_m: float) -> Iterator[Point]:
    """Yield nodes about corners that protrude to the left; legs between them avoid the arcs."""
    for index, corner in enumerate(border):
        before, after = border[index - 1], border[(index + 1) % len(border)]
        incoming = (corner[0] - before[0], corner[1] - before[1])
        outgoing = (after[0] - corner[0], after[1] - corner[1])
        cross = incoming[0] * outgoing[1] - incoming[1] * outgoing[0]
        dot = incoming[0] * outgoing[0] + incoming[1] * outgoing[1]
        turn_rad = -math.atan2(cross, dot)  # to the right
        if turn_rad <= 0.0:
            continue
        count = math.ceil(turn_rad / ARC_STEP_RAD)
        step_rad = turn_rad / count
        distance_m = radius_m / math.cos(0.5 * step_rad)
        first_rad = math.atan2(incoming[0], -incoming[1])  # left normal of the incoming edge
        for k in range(count):
            direction_rad = first_rad - (k + 0.5) * step_rad
            yield (
                corner[0] + distance_m * math.cos(direction_rad),
                corner[1] + distance_m * math.sin(direction_rad),
            )
