"""Tracks that do not depend on the estimate, and steps towards a waypoint."""

from __future__ import annotations

import itertools
import math

import numpy as np

from companion.domain import Point
from companion.kernel import Matrix, kernel

LANE_SLACK = 1e-9
"""Share of a spacing by which the last lane may lie outside through rounding."""


@kernel
def stepped(
    east_m: float, north_m: float, to_east_m: float, to_north_m: float, step_m: float
) -> tuple[float, float]:
    """The place one step on the way to a waypoint, or the waypoint where that is nearer."""
    de, dn = to_east_m - east_m, to_north_m - north_m
    distance_m = math.hypot(de, dn)
    if distance_m <= step_m:
        return to_east_m, to_north_m
    share = step_m / distance_m
    return east_m + share * de, north_m + share * dn


def lane_corners(
    area_m: tuple[float, float], spacing_m: float, first_north_m: float | None = None
) -> list[Point]:
    """Corners of east-west lanes over an area from the origin.

    Args:
        area_m: Width and depth of the area.
        spacing_m: Of the lanes.
        first_north_m: Of the first lane; None: half a spacing inside.
    """
    width_m, depth_m = area_m
    if first_north_m is None:
        first_north_m = 0.5 * spacing_m
    corners: list[Point] = []
    for lane in range(max(1, math.floor((depth_m - first_north_m) / spacing_m + LANE_SLACK) + 1)):
        north_m = first_north_m + spacing_m * lane
        ends = [(0.0, north_m), (width_m, north_m)]
        corners += ends if lane % 2 == 0 else ends[::-1]
    return corners


def lawnmower_track(
    area_m: tuple[float, float],
    start_enu_m: Point,
    spacing_m: float,
    step_m: float,
    steps: int,
    first_north_m: float | None = None,
) -> Matrix:
    """Places on the lanes at even steps along them, (steps, 2).

    The way from the start to the first lane is part of the track; at the end of the last lane it
    turns around and goes back lane by lane.

    Args:
        area_m: Width and depth of the area.
        start_enu_m: The first place.
        spacing_m: Of the lanes.
        step_m: Along the track.
        steps: How many places.
        first_north_m: Of the first lane; None: half a spacing inside.
    """
    sweep = lane_corners(area_m, spacing_m, first_north_m)
    corners = [start_enu_m, *sweep]
    length_m = step_m * (steps - 1)
    turns = 0
    while _length_m(corners) < length_m:
        turns += 1
        corners += (sweep[::-1] if turns % 2 else sweep)[1:]
    return along(np.array(corners), step_m, steps)


def along(corners: Matrix, step_m: float, steps: int) -> Matrix:
    """Places at even steps along a polyline, (steps, 2), its last corner from its end on.

    Args:
        corners: (k, 2).
        step_m: Along the polyline.
        steps: How many places.
    """
    legs_m = np.hypot(*np.diff(corners, axis=0).T)
    corner_at_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    at_m = step_m * np.arange(steps)
    return np.column_stack([np.interp(at_m, corner_at_m, axis) for axis in corners.T])


def _length_m(corners: list[Point]) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise(corners))
