"""Lines of sight and ways around, against plane geometry done by hand and by the way finder."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.domain import PositionEnu
from companion.geometry.obstacles import FreeSpace, WayFinder
from companion.geometry.polygons import Point, depth_m, edges, nearest_on_segment
from sim_link.world.environment import Environment, ObstacleParams
from sim_link.world.line_of_sight import (
    detour,
    holding,
    is_blocked,
    is_blocked_in_space,
    is_inside,
    taut_m,
    turning_corners,
)

Corners = tuple[Point, ...]

REACH_M = 24.0
PLOTS = [(e, n) for e in (-50.0, 0.0, 50.0) for n in (-50.0, 0.0, 50.0) if (e, n) != (0.0, 0.0)]
"""Positions of obstacles with this reach that stand apart from each other."""

BLOCK: Corners = ((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0))
SQUARE: Corners = ((-10.0, -10.0), (10.0, -10.0), (10.0, 10.0), (-10.0, 10.0))
SLACK_M = 1e-4
"""Corners stand a hair outside, and a way turns at several."""

_coordinates = st.floats(-100.0, 100.0)
points = st.tuples(_coordinates, _coordinates)
heights = st.floats(0.0, 40.0)


@st.composite
def polygons(draw: st.DrawFn, about: Point | None = None) -> Corners:
    """A simple polygon about a centre that sees every corner, convex or not."""
    east, north = about or draw(points)
    count = draw(st.integers(3, 7))
    radii = draw(st.lists(st.floats(2.0, REACH_M), min_size=count, max_size=count))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    angles = [first + 2.0 * math.pi * index / count for index in range(count)]
    corners = tuple(
        (east + radius * math.cos(angle), north + radius * math.sin(angle))
        for radius, angle in zip(radii, angles, strict=True)
    )
    return corners if draw(st.booleans()) else corners[::-1]


heaps = st.lists(polygons(), min_size=1, max_size=3)
"""Obstacles that may overlap."""


@st.composite
def scenes(draw: st.DrawFn) -> list[Corners]:
    """Obstacles that stand apart, one in the middle."""
    others = draw(st.lists(st.sampled_from(PLOTS), max_size=2, unique=True))
    return [draw(polygons(about=centre)) for centre in ((0.0, 0.0), *others)]


@st.composite
def shadows(draw: st.DrawFn) -> tuple[list[Corners], Point, Point]:
    """Obstacles, and two positions with one of them between."""
    scene, angle = draw(scenes()), draw(st.floats(0.0, 2.0 * math.pi))
    far, near = draw(st.floats(REACH_M + 1.0, 90.0)), draw(st.floats(REACH_M + 1.0, 90.0))
    along = (math.cos(angle), math.sin(angle))
    return scene, (far * along[0], far * along[1]), (-near * along[0], -near * along[1])


def environment(*polygons: Corners, height_m: float | None = None) -> Environment:
    return Environment(
        [ObstacleParams(corners_enu_m=polygon, height_m=height_m) for polygon in polygons]
    )


def outside(scene: list[Corners], *positions: Point) -> None:
    """Go on only with positions clearly outside of the obstacles."""
    assume(all(depth_m(polygon, position) < -0.01 for polygon in scene for position in positions))


def way_m(scene: Environment, target: PositionEnu, sensor: PositionEnu) -> float:
    """Length of a signal's way."""
    if not is_blocked_in_space(*target, *sensor, scene.edges):
        return math.dist(target, sensor)
    return math.dist(target, sensor) + detour(*sensor, scene.around(target))[0]


def plane_way_m(scene: Environment, target: Point, sensor: Point) -> float:
    return way_m(scene, (*target, 0.0), (*sensor, 0.0))


# Line of sight


@pytest.mark.parametrize(
    ("target", "sensor", "blocked"),
    [
        ((50.0, 50.0), (10.0, 50.0), True),
        ((50.0, 50.0), (60.0, 50.0), False),
        ((50.0, 50.0), (40.0, 75.0), False),
        ((50.0, 50.0), (29.0, 72.0), True),
        ((50.0, 50.0), (10.0, 10.0), True),  # through a corner, and on through the inside
        ((50.0, 20.0), (10.0, 20.0), False),
        ((50.0, 50.0), (40.0, 50.0), True),  # from the inside out
        ((35.0, 40.0), (40.0, 50.0), True),  # inside, both
        ((60.0, 15.0), (15.0, 60.0), True),
    ],
)
def test_what_the_block_hides(target: Point, sensor: Point, blocked: bool) -> None:
    walls = environment(BLOCK).edges
    assert is_blocked(*target, *sensor, walls) is blocked
    assert is_blocked(*sensor, *target, walls) is blocked


def test_a_diagonal_through_two_corners_is_blocked() -> None:
    assert is_blocked(-20.0, -20.0, 20.0, 20.0, environment(SQUARE).edges)


def test_a_touched_corner_blocks_and_a_path_along_a_wall_does_not_meet_it() -> None:
    walls = environment(SQUARE).edges
    assert is_blocked(-20.0, 0.0, 0.0, 20.0, walls)
    assert not is_blocked(20.0, 10.0, 30.0, 10.0, walls)
    assert not is_blocked(-5.0, 10.0, 5.0, 10.0, walls)


def test_from_a_wall_only_its_own_side_is_seen() -> None:
    walls = environment(SQUARE).edges
    assert not is_blocked(30.0, 3.0, 10.0, 0.0, walls)
    assert is_blocked(-30.0, 3.0, 10.0, 0.0, walls)


def test_without_obstacles_everything_is_seen() -> None:
    walls = environment().edges
    assert not is_blocked(0.0, 0.0, 50.0, 50.0, walls)
    assert not is_inside(0.0, 0.0, 0.0, walls)
    assert holding(0.0, 0.0, 0.0, walls).shape == (0,)


@given(heaps, points, points, heights, heights, st.floats(1.0, 40.0))
def test_line_of_sight_is_the_same_from_either_end(
    scene: list[Corners], a: Point, b: Point, up_a: float, up_b: float, height_m: float
) -> None:
    walls = environment(*scene, height_m=height_m).edges
    there = is_blocked_in_space(*a, up_a, *b, up_b, walls)
    assert there == is_blocked_in_space(*b, up_b, *a, up_a, walls)
    assert is_blocked(*a, *b, walls) == is_blocked(*b, *a, walls)


@given(scenes(), points, points)
def test_line_of_sight_is_that_of_free_space(scene: list[Corners], a: Point, b: Point) -> None:
    outside(scene, a, b)
    sees = FreeSpace(None, scene).is_clear(a, b)
    assume(sees == FreeSpace(None, scene, margin_m=1e-3).is_clear(a, b))  # not by a hair
    assert is_blocked(*a, *b, environment(*scene).edges) is not sees


@pytest.mark.parametrize(
    ("sensor_up_m", "blocked"), [(0.0, True), (19.9, True), (20.1, False), (60.0, False)]
)
def test_a_path_above_the_roof_is_free(sensor_up_m: float, blocked: bool) -> None:
    """From (20, 0) on the ground the line meets the near wall at a half of the sensor's height."""
    walls = environment(SQUARE, height_m=15.0).edges
    # Walls at 10 m and 30 m of 40 m: it is lowest over the one near the emitter.
    assert is_blocked_in_space(20.0, 0.0, 10.0, -20.0, 0.0, 10.0 + sensor_up_m, walls) is blocked


def test_a_buried_emitter_is_hidden_from_straight_above() -> None:
    walls = environment(SQUARE, height_m=5.0).edges
    assert is_blocked_in_space(0.0, 0.0, 0.0, 0.0, 0.0, 30.0, walls)
    assert is_blocked_in_space(0.0, 0.0, 0.0, 1.0, 2.0, 30.0, walls)
    assert not is_blocked_in_space(0.0, 0.0, 5.0, 1.0, 2.0, 30.0, walls)  # on the roof


def test_in_the_plane_every_height_blocks() -> None:
    assert is_blocked(-20.0, 0.0, 20.0, 0.0, environment(SQUARE, height_m=0.1).edges)


def test_inside_is_reported_for_each_obstacle() -> None:
    """Overlapping ones do not cancel each other."""
    moved: Corners = tuple((east + 5.0, north) for east, north in SQUARE)
    walls = environment(SQUARE, moved, BLOCK).edges
    assert is_inside(3.0, 0.0, 0.0, walls)
    assert holding(3.0, 0.0, 0.0, walls).tolist() == [True] * 8 + [False] * 4
    assert holding(12.0, 0.0, 0.0, walls).tolist() == [False] * 4 + [True] * 4 + [False] * 4
    assert holding(40.0, 40.0, 0.0, walls).tolist() == [False] * 8 + [True] * 4


# Ways around


def test_the_way_about_one_corner() -> None:
    excess_m, pull_rad = detour(10.0, 20.0, 0.0, environment(BLOCK).around((50.0, 50.0, 0.0)))
    way = math.dist((10.0, 20.0), (45.0, 30.0)) + math.dist((45.0, 30.0), (50.0, 50.0))
    assert excess_m == pytest.approx(way - 50.0, abs=SLACK_M)
    assert pull_rad == pytest.approx(math.atan2(10.0, 35.0) - math.atan2(30.0, 40.0), abs=SLACK_M)


def test_the_way_about_two_corners() -> None:
    excess_m, pull_rad = detour(20.0, 50.0, 0.0, environment(BLOCK).around((50.0, 50.0, 0.0)))
    way = math.dist((20.0, 50.0), (30.0, 60.0)) + 15.0 + math.dist((45.0, 60.0), (50.0, 50.0))
    assert excess_m == pytest.approx(way - 30.0, abs=SLACK_M)
    assert pull_rad == pytest.approx(math.pi / 4.0, abs=SLACK_M)


def test_inward_corners_do_not_turn_a_way() -> None:
    hook: Corners = ((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (20.0, 30.0), (20.0, 10.0), (0.0, 10.0))
    assert len(list(turning_corners(hook))) == 5
    way = plane_way_m(environment(hook), (10.0, -10.0), (10.0, 20.0))
    corners: list[Point] = [(10.0, -10.0), (0.0, 0.0), (0.0, 10.0), (10.0, 20.0)]
    assert way == pytest.approx(sum(math.dist(*leg) for leg in pairwise(corners)), abs=SLACK_M)


def test_direction_and_repeated_corners_do_not_matter() -> None:
    expected = detour(10.0, 40.0, 0.0, environment(BLOCK).around((50.0, 50.0, 0.0)))
    for corners in (BLOCK[::-1], (*BLOCK, BLOCK[0]), (BLOCK[0], *BLOCK)):
        excess = detour(10.0, 40.0, 0.0, environment(corners).around((50.0, 50.0, 0.0)))
        assert excess == pytest.approx(expected, abs=SLACK_M)


def test_the_shortest_way_among_several_leads_between_them() -> None:
    left: Corners = ((-30.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-30.0, 1.0))
    right: Corners = ((2.0, -1.0), (30.0, -1.0), (30.0, 1.0), (2.0, 1.0))
    way = plane_way_m(environment(left, right), (-10.0, -10.0), (-10.0, 10.0))
    corners: list[Point] = [(-10.0, -10.0), (-2.0, -1.0), (-2.0, 1.0), (-10.0, 10.0)]
    assert way == pytest.approx(sum(math.dist(*leg) for leg in pairwise(corners)), abs=SLACK_M)


def test_walls_that_touch_leave_no_gap() -> None:
    left: Corners = ((-30.0, -1.0), (0.0, -1.0), (0.0, 1.0), (-30.0, 1.0))
    right: Corners = ((0.0, -1.0), (30.0, -1.0), (30.0, 1.0), (0.0, 1.0))
    whole: Corners = ((-30.0, -1.0), (30.0, -1.0), (30.0, 1.0), (-30.0, 1.0))
    joined = plane_way_m(environment(left, right), (5.0, -10.0), (3.0, 10.0))
    assert joined == pytest.approx(
        plane_way_m(environment(whole), (5.0, -10.0), (3.0, 10.0)), abs=SLACK_M
    )


def test_what_an_end_is_inside_of_makes_no_detour() -> None:
    scene = environment(BLOCK)
    assert detour(10.0, 40.0, 0.0, scene.around((40.0, 40.0, 0.0))) == (0.0, 0.0)
    assert detour(40.0, 40.0, 0.0, scene.around((50.0, 50.0, 0.0))) == (0.0, 0.0)
    # But another obstacle does.
    both = environment(BLOCK, SQUARE).around((40.0, 40.0, 0.0))
    assert detour(-20.0, -20.0, 0.0, both)[0] > 0.0


def test_out_of_a_closed_yard_it_goes_straight() -> None:
    yard = [
        ((-20.0, -20.0), (20.0, -20.0), (20.0, -15.0), (-20.0, -15.0)),
        ((-20.0, 15.0), (20.0, 15.0), (20.0, 20.0), (-20.0, 20.0)),
        ((-20.0, -16.0), (-15.0, -16.0), (-15.0, 16.0), (-20.0, 16.0)),
        ((15.0, -16.0), (20.0, -16.0), (20.0, 16.0), (15.0, 16.0)),
    ]
    surroundings = environment(*yard).around((0.0, 0.0, 0.0))
    assert surroundings.corners.shape == (0, 3)
    assert is_blocked(0.0, 0.0, 50.0, 0.0, surroundings.edges)
    assert detour(50.0, 0.0, 0.0, surroundings) == (0.0, 0.0)


@settings(deadline=None)
@given(scenes(), points, points)
def test_ways_are_those_of_the_way_finder(scene: list[Corners], a: Point, b: Point) -> None:
    outside(scene, a, b)
    corners = WayFinder(FreeSpace(None, scene)).way(a, b)
    assert corners is not None
    expected_m = sum(math.dist(*leg) for leg in pairwise((a, *corners)))
    assert plane_way_m(environment(*scene), a, b) == pytest.approx(expected_m, abs=SLACK_M)


@settings(deadline=None)
@given(scenes(), points, points)
def test_ways_are_as_long_from_either_end_and_never_shorter_than_straight(
    scene: list[Corners], a: Point, b: Point
) -> None:
    outside(scene, a, b)
    there_m, back_m = (plane_way_m(environment(*scene), *ends) for ends in ((a, b), (b, a)))
    assert there_m == pytest.approx(back_m, abs=SLACK_M)
    assert there_m >= math.dist(a, b)


@settings(deadline=None)
@given(scenes(), points, points, points)
def test_no_way_by_a_third_place_is_shorter(
    scene: list[Corners], a: Point, b: Point, c: Point
) -> None:
    outside(scene, a, b, c)
    around = environment(*scene)
    by_c_m = plane_way_m(around, a, c) + plane_way_m(around, c, b)
    assert plane_way_m(around, a, b) <= by_c_m + SLACK_M


@settings(deadline=None)
@given(scenes(), points, points, st.floats(0.0, 2.0 * math.pi), st.floats(1e-3, 0.5))
def test_ways_are_continuous_in_the_open(
    scene: list[Corners], a: Point, b: Point, heading_rad: float, step_m: float
) -> None:
    """Moved by a step, no way changes by more, into and out of shadows as well."""
    moved = (b[0] + step_m * math.cos(heading_rad), b[1] + step_m * math.sin(heading_rad))
    outside(scene, a, b, moved)
    around = environment(*scene)
    assume(not is_blocked(*b, *moved, around.edges))
    change_m = plane_way_m(around, a, moved) - plane_way_m(around, a, b)
    assert abs(change_m) <= step_m + SLACK_M


@settings(deadline=None)
@given(shadows())
def test_a_pull_is_towards_a_corner_in_sight(shadow: tuple[list[Corners], Point, Point]) -> None:
    scene, a, b = shadow
    outside(scene, a, b)
    around = environment(*scene)
    assert is_blocked(*a, *b, around.edges)
    _, pull_rad = detour(*b, 0.0, around.around((*a, 0.0)))
    bearing_rad = math.atan2(a[1] - b[1], a[0] - b[0]) + pull_rad
    corners = [corner for polygon in scene for corner in turning_corners(polygon)]
    seen = [corner for corner in corners if not is_blocked(*b, *corner, around.edges)]
    turns = [
        math.remainder(math.atan2(n - b[1], e - b[0]) - bearing_rad, 2.0 * math.pi) for e, n in seen
    ]
    assert min(map(abs, turns)) < 1e-6


# Ways over


def test_a_low_roof_is_gone_over_without_a_pull() -> None:
    surroundings = environment(SQUARE, height_m=6.0).around((30.0, 0.0, 0.0))
    excess_m, pull_rad = detour(-20.0, 0.0, 7.0, surroundings)
    # From the emitter up to the near edge of the roof; from there the sensor is in sight.
    way = math.hypot(20.0, 6.0) + math.hypot(30.0, 1.0)
    assert excess_m == pytest.approx(way - math.hypot(50.0, 7.0))
    assert pull_rad == 0.0


@settings(deadline=None)
@given(shadows(), heights, heights, st.floats(0.5, 40.0))
def test_a_shadow_of_a_roof_begins_at_zero(
    shadow: tuple[list[Corners], Point, Point], up_a: float, up_b: float, height_m: float
) -> None:
    """A string lifted over roofs is longer by at most twice what they stand above the line."""
    scene, a, b = shadow
    outside(scene, a, b)
    along = (b[0] - a[0], b[1] - a[1])
    lifts_m = []
    for (pe, pn), (qe, qn) in (edge for polygon in scene for edge in edges(polygon)):
        aside = [along[0] * (n - a[1]) - along[1] * (e - a[0]) for e, n in ((pe, pn), (qe, qn))]
        if aside[0] == aside[1] or aside[0] * aside[1] > 0.0:
            continue
        met = aside[0] / (aside[0] - aside[1])
        position = (pe + met * (qe - pe), pn + met * (qn - pn))
        if math.dist(nearest_on_segment(a, b, position), position) < 1e-6:
            share = math.dist(a, position) / math.dist(a, b)
            lifts_m.append(max(0.0, height_m - (up_a + share * (up_b - up_a))))
    scene_of_roofs = environment(*scene, height_m=height_m)
    excess_m = way_m(scene_of_roofs, (*a, up_a), (*b, up_b)) - math.dist((*a, up_a), (*b, up_b))
    assert 0.0 <= excess_m <= 2.0 * sum(lifts_m) + SLACK_M


def test_a_high_roof_is_gone_around() -> None:
    surroundings = environment(SQUARE, height_m=60.0).around((30.0, 0.0, 0.0))
    excess_m, pull_rad = detour(-20.0, 0.0, 6.0, surroundings)
    plane_m = math.dist((30.0, 0.0), (10.0, 10.0)) + 20.0 + math.dist((-10.0, 10.0), (-20.0, 0.0))
    expected_m = math.hypot(plane_m, 6.0) - math.hypot(50.0, 6.0)
    assert excess_m == pytest.approx(expected_m, abs=SLACK_M)
    assert abs(pull_rad) == pytest.approx(math.pi / 4.0, abs=SLACK_M)


def test_over_several_roofs_the_string_is_taut() -> None:
    at_m, tops_m = np.array([40.0, 10.0, 20.0, 30.0]), np.array([5.0, 3.0, 8.0, 2.0])
    corners = [(0.0, 0.0), (20.0, 8.0), (40.0, 5.0), (50.0, 0.0)]
    expected_m = sum(math.dist(*leg) for leg in pairwise(corners))
    assert taut_m(at_m, tops_m, 0.0, 50.0, 0.0) == pytest.approx(expected_m)
    assert taut_m(at_m[:0], tops_m[:0], 1.0, 3.0, 5.0) == pytest.approx(5.0)
    assert taut_m(at_m, tops_m, 1.0, 0.0, 5.0) == 4.0


@given(st.lists(st.tuples(st.floats(0.5, 49.5), heights), max_size=6), heights, heights)
def test_a_string_is_as_long_from_either_end(
    roofs: list[tuple[float, float]], start_up: float, end_up: float
) -> None:
    at_m, tops_m = np.array([r[0] for r in roofs]), np.array([r[1] for r in roofs])
    there_m = taut_m(at_m, tops_m, start_up, 50.0, end_up)
    back_m = taut_m(50.0 - at_m, tops_m, end_up, 50.0, start_up)
    assert there_m == pytest.approx(back_m, abs=1e-9)
    assert there_m >= math.hypot(50.0, end_up - start_up) - 1e-9


def test_nothing_goes_over_what_has_no_height() -> None:
    low = environment(SQUARE, height_m=1.0).around((12.0, 0.0, 0.0))
    high = environment(SQUARE).around((12.0, 0.0, 0.0))
    assert detour(-12.0, 0.0, 0.5, low)[0] < 0.5 < detour(-12.0, 0.0, 0.5, high)[0]


def test_from_a_roof_behind_a_tower_it_goes_straight() -> None:
    """No way around leaves a roof, and none leads over a tower without a height."""
    tower: Corners = ((20.0, -5.0), (25.0, -5.0), (25.0, 5.0), (20.0, 5.0))
    scene = Environment(
        [ObstacleParams(corners_enu_m=SQUARE, height_m=8.0), ObstacleParams(corners_enu_m=tower)]
    )
    assert is_blocked_in_space(0.0, 0.0, 8.0, 40.0, 0.0, 8.0, scene.edges)
    assert detour(40.0, 0.0, 8.0, scene.around((0.0, 0.0, 8.0))) == (0.0, 0.0)
