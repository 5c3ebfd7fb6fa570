"""Shortest paths through free space, as straight legs.

Theory of operation. A shortest path among polygons turns only where free space is not convex: at
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
from collections.abc import Iterator

from companion.geometry.obstacles import FreeSpace
from companion.geometry.polygons import Point

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
                    place = goal if there == GOAL else self.nodes[there]
                    ahead_m = flown_m + leg_m
                    heapq.heappush(queue, (ahead_m + math.dist(place, goal), ahead_m, there, here))
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

    def _seen_from(self, place: Point, own: int) -> Iterator[tuple[int, float]]:
        for index, node in enumerate(self.nodes):
            if index != own and self.space.is_clear(place, node):
                yield index, math.dist(place, node)

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
