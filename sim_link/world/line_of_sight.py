"""Lines of sight and paths around obstacles: kernels over an array of walls.

Theory of operation. An obstacle is an upright prism over a simple polygon, given by its walls, one
row each. A straight path is blocked where it meets a wall below its top, or where one of its ends
lies inside an obstacle. A blocked signal takes the shorter of two ways: around, the shortest way in
the plane, taut about the corners as if every obstacle were tall, its climb spread over the whole
path; or over, a taut string over the roofs, in the upright plane through both ends. The paths from
every corner to the emitter are found once (`ways_to`): they do not depend on the sensor.

An obstacle blocks every path from or to its inside, but such a path makes no detour. Where
no way is left (a yard closed on all sides) the signal goes straight through. A touched wall blocks;
a path along a wall, or one that ends on it, does not meet it.

Excess and pull begin at zero at the edge of a shadow. The excess is continuous outside of the
obstacles in the plane, and in space about a single convex one; the pull jumps where the other way
round becomes the shorter one. Positions are metres, local east, north and up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry.polygons import Point, Polygon, edges, signed_area_m2
from companion.kernel import Matrix, Vector, kernel

START_EAST, START_NORTH, END_EAST, END_NORTH, TOP, OWNER = range(6)
"""Columns of a wall: its ends, the height that it reaches (infinite: any), and its obstacle."""
COLUMNS = 6

CORNER_SLACK_M = 1e-6
NOWHERE = -1.0
"""Share of a path that means "no intersection"."""

Flags = NDArray[np.bool_]


class Surroundings(NamedTuple):
    """An emitter among obstacles, as the kernels take it."""

    east_m: float
    north_m: float
    up_m: float
    edges: Matrix
    """Walls, (k, 6), those of one obstacle in a row."""
    corners: Matrix
    """Corners that a path may turn at, and the length of the path from there, metres, (c, 3)."""
    ignored: Flags
    """Flags of walls, (k,): True for obstacles that contain the emitter, which do not block it."""


@kernel
def side(ae: float, an: float, be: float, bn: float, e: float, n: float) -> float:
    """Return a positive value if (e, n) lies left of the line from a to b; antisymmetric."""
    return (ae - e) * (bn - n) - (an - n) * (be - e)


@kernel
def share_to_wall(ae: float, an: float, be: float, bn: float, index: int, edges: Matrix) -> float:
    """Return where the path from a to b meets a wall, as a share of the path, or `NOWHERE`.

    The ends of the wall count, those of the path do not.
    """
    pe, pn = edges[index, START_EAST], edges[index, START_NORTH]
    qe, qn = edges[index, END_EAST], edges[index, END_NORTH]
    p, q = side(ae, an, be, bn, pe, pn), side(ae, an, be, bn, qe, qn)
    if (p > 0.0 and q > 0.0) or (p < 0.0 and q < 0.0) or (p == 0.0 and q == 0.0):
        return NOWHERE
    a, b = side(pe, pn, qe, qn, ae, an), side(pe, pn, qe, qn, be, bn)
    if (a > 0.0 and b < 0.0) or (a < 0.0 and b > 0.0):
        return float(a / (a - b))
    return NOWHERE


@kernel
def is_left_of_wall(e: float, n: float, up: float, index: int, edges: Matrix) -> bool:
    """Return True if a position is level with a wall, below its top and west of it."""
    pn, qn = edges[index, START_NORTH], edges[index, END_NORTH]
    if (pn > n) == (qn > n) or up >= edges[index, TOP]:
        return False
    pe, qe = edges[index, START_EAST], edges[index, END_EAST]
    return bool(e < (qe - pe) * (n - pn) / (qn - pn) + pe)


@kernel
def is_inside(e: float, n: float, up: float, edges: Matrix) -> bool:
    """Return True if a position is inside an obstacle, by the crossing number."""
    odd = False
    for index in range(len(edges)):
        if odd and edges[index, OWNER] != edges[index - 1, OWNER]:
            return True
        if is_left_of_wall(e, n, up, index, edges):
            odd = not odd
    return odd


@kernel
def holding(e: float, n: float, up: float, edges: Matrix) -> Flags:
    """Mark the walls of obstacles that contain the position; flags of shape (k,)."""
    flags = np.zeros(len(edges), np.bool_)
    first, odd = 0, False
    for index in range(len(edges)):
        if edges[index, OWNER] != edges[first, OWNER]:
            flags[first:index] = odd
            first, odd = index, False
        if is_left_of_wall(e, n, up, index, edges):
            odd = not odd
    flags[first:] = odd
    return flags


@kernel
def is_blocked_in_space(
    target_e: float, target_n: float, target_up: float, e: float, n: float, up: float, edges: Matrix
) -> bool:
    """Return True if an obstacle stands between target and sensor; symmetric in both ends."""
    if target_e > e or (target_e == e and target_n > n):
        target_e, target_n, target_up, e, n, up = e, n, up, target_e, target_n, target_up
    for index in range(len(edges)):
        share = share_to_wall(target_e, target_n, e, n, index, edges)
        if share != NOWHERE and target_up + share * (up - target_up) < edges[index, TOP]:
            return True
    return is_inside(target_e, target_n, target_up, edges) or is_inside(e, n, up, edges)


@kernel
def walls_between(
    target_e: float, target_n: float, target_up: float, e: float, n: float, up: float, edges: Matrix
) -> int:
    """Count the walls on the straight path; at least 1 where a roof blocks it."""
    count = 0
    for index in range(len(edges)):
        share = share_to_wall(target_e, target_n, e, n, index, edges)
        if share != NOWHERE and target_up + share * (up - target_up) < edges[index, TOP]:
            count += 1
    if count == 0 and is_blocked_in_space(target_e, target_n, target_up, e, n, up, edges):
        return 1
    return count


@kernel
def is_blocked(target_e: float, target_n: float, e: float, n: float, edges: Matrix) -> bool:
    """Return True if the path is blocked in the plane, where an obstacle of any height blocks."""
    return is_blocked_in_space(target_e, target_n, 0.0, e, n, 0.0, edges)


@kernel
def is_cut(ae: float, an: float, be: float, bn: float, edges: Matrix, ignored: Flags) -> bool:
    """Return True if a leg in the plane meets a wall other than those in `ignored`."""
    for index in range(len(edges)):
        if not ignored[index] and share_to_wall(ae, an, be, bn, index, edges) != NOWHERE:
            return True
    return False


@kernel
def ways_to(
    target_e: float, target_n: float, corners: Matrix, edges: Matrix, ignored: Flags
) -> Vector:
    """Return the shortest paths from every corner to a target, (c,), metres; infinite: none.

    Dijkstra's algorithm over the legs between corners (c, 2) that no wall (k, 6) cuts, each tested
    only if it would shorten a path. `ignored` (k,) are walls about the target.
    """
    count = len(corners)
    ways, open_ways = np.full(count, np.inf), np.full(count, np.inf)
    for index in range(count):
        e, n = corners[index, 0], corners[index, 1]
        if not is_cut(target_e, target_n, e, n, edges, ignored):
            ways[index] = open_ways[index] = math.hypot(target_e - e, target_n - n)
    for _ in range(count):
        near = int(np.argmin(open_ways))
        if open_ways[near] == np.inf:
            break
        open_ways[near] = np.inf
        ne, nn = corners[near, 0], corners[near, 1]
        for index in range(count):
            e, n = corners[index, 0], corners[index, 1]
            way = ways[near] + math.hypot(ne - e, nn - n)
            if way < ways[index] and not is_cut(ne, nn, e, n, edges, ignored):
                ways[index] = open_ways[index] = way
    return ways


@kernel
def way_around(e: float, n: float, surroundings: Surroundings, ignored: Flags) -> tuple[float, int]:
    """Return the shortest way in the plane, m, infinite: none; and its first corner, or -1."""
    target_e, target_n, corners = surroundings.east_m, surroundings.north_m, surroundings.corners
    edges = surroundings.edges
    if not is_cut(target_e, target_n, e, n, edges, ignored):
        return math.hypot(target_e - e, target_n - n), -1
    ways = np.empty(len(corners))
    for index in range(len(corners)):
        leg = math.hypot(corners[index, 0] - e, corners[index, 1] - n)
        ways[index] = leg + corners[index, 2]
    for _ in range(len(corners)):
        best = int(np.argmin(ways))
        if not is_cut(corners[best, 0], corners[best, 1], e, n, edges, ignored):
            return ways[best], best
        ways[best] = np.inf
    return np.inf, -1


@kernel
def taut_m(at_m: Vector, tops_m: Vector, start_up: float, length_m: float, end_up: float) -> float:
    """Return the length of a taut string over roofs (k,) at distances and heights, metres."""
    if length_m == 0.0:
        return abs(end_up - start_up)
    string_m, here_m, up = 0.0, 0.0, start_up
    while here_m < length_m:
        next_m, next_up = length_m, end_up
        for index in range(len(at_m)):
            step_m, rise_m = at_m[index] - here_m, tops_m[index] - up
            is_steeper = rise_m * (next_m - here_m) > (next_up - up) * step_m
            if step_m > 0.0 and at_m[index] < length_m and is_steeper:
                next_m, next_up = at_m[index], tops_m[index]
        string_m += math.hypot(next_m - here_m, next_up - up)
        here_m, up = next_m, next_up
    return string_m


@kernel
def way_over(e: float, n: float, up: float, surroundings: Surroundings, ignored: Flags) -> float:
    """Return the shortest path straight over the roofs, metres; infinite: too high."""
    target_e, target_n, edges = surroundings.east_m, surroundings.north_m, surroundings.edges
    length_m = math.hypot(target_e - e, target_n - n)
    at_m, tops_m = np.empty(len(edges)), np.empty(len(edges))
    met = 0
    for index in range(len(edges)):
        share = share_to_wall(target_e, target_n, e, n, index, edges)
        if share == NOWHERE or ignored[index]:
            continue
        if edges[index, TOP] == np.inf:
            return np.inf
        at_m[met], tops_m[met] = share * length_m, edges[index, TOP]
        met += 1
    return taut_m(at_m[:met], tops_m[:met], surroundings.up_m, length_m, up)


@kernel
def detour(e: float, n: float, up: float, surroundings: Surroundings) -> tuple[float, float]:
    """Return the excess path in m and the bearing deflection in rad of a blocked signal.

    The excess is never negative. The deflection is counter-clockwise in [-pi, pi], from the
    direction of the emitter to that of the first corner on the path around; zero for a path over
    the roofs.
    """
    de, dn = surroundings.east_m - e, surroundings.north_m - n
    climb_m = surroundings.up_m - up
    straight_m = math.hypot(math.hypot(de, dn), climb_m)
    ignored = surroundings.ignored | holding(e, n, up, surroundings.edges)
    around_m, first = way_around(e, n, surroundings, ignored)
    around_m = math.hypot(around_m, climb_m)
    over_m = way_over(e, n, up, surroundings, ignored)
    excess_m = min(around_m, over_m) - straight_m
    if excess_m == np.inf or first < 0 or over_m <= around_m:
        return (0.0 if excess_m == np.inf else max(0.0, excess_m)), 0.0
    ce, cn = surroundings.corners[first, 0] - e, surroundings.corners[first, 1] - n
    return max(0.0, excess_m), math.atan2(de * cn - dn * ce, de * ce + dn * cn)


def walls(polygon: Polygon, top_m: float, owner: int) -> list[tuple[float, ...]]:
    """Return the rows of one obstacle."""
    return [(*start, *end, top_m, float(owner)) for start, end in edges(polygon) if start != end]


def turning_corners(polygon: Polygon) -> Iterator[Point]:
    """Yield the corners that a taut path can turn at, a hair outside the polygon."""
    corners = [start for start, end in edges(polygon) if start != end]
    if signed_area_m2(corners) < 0.0:
        corners.reverse()
    for index, (e, n) in enumerate(corners):
        (be, bn), (ae, an) = corners[index - 1], corners[(index + 1) % len(corners)]
        turn_rad = math.atan2(
            (e - be) * (an - n) - (n - bn) * (ae - e), (e - be) * (ae - e) + (n - bn) * (an - n)
        )
        if turn_rad > 0.0:
            outwards_rad = math.atan2(n - bn, e - be) + 0.5 * (turn_rad - math.pi)
            yield (
                e + CORNER_SLACK_M * math.cos(outwards_rad),
                n + CORNER_SLACK_M * math.sin(outwards_rad),
            )


def surroundings_of(
    target_enu_m: tuple[float, float, float], edges: Matrix, corners: Matrix
) -> Surroundings:
    """Return an emitter among walls (k, 6) and corners (c, 2), with the paths from each corner."""
    east, north, up = target_enu_m
    ignored = holding(east, north, up, edges)
    ways = ways_to(east, north, corners, edges, ignored)
    reached = np.isfinite(ways)
    table = np.column_stack([corners[reached], ways[reached]])
    return Surroundings(east, north, up, edges, table, ignored)
