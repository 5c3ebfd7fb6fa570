"""The allowed distance from home along a straight way."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.geometry.obstacles import limited_to_reach
from companion.geometry.polygons import Point

HOME = (10.0, 0.0)


@pytest.mark.parametrize(
    ("start", "goal", "reach_m", "end"),
    [
        ((10.0, 0.0), (40.0, 0.0), 50.0, (40.0, 0.0)),
        ((10.0, 0.0), (60.0, 0.0), 50.0, (60.0, 0.0)),
        ((10.0, 0.0), (90.0, 0.0), 50.0, (60.0, 0.0)),
        ((20.0, 0.0), (90.0, 0.0), 50.0, (60.0, 0.0)),
        ((40.0, 40.0), (40.0, 80.0), 50.0, (40.0, 40.0)),
        ((10.0, 30.0), (80.0, 30.0), 50.0, (50.0, 30.0)),
        ((-20.0, 30.0), (120.0, 30.0), 50.0, (50.0, 30.0)),
        ((10.0, -30.0), (45.0, -100.0), 50.0, (19.541, -49.081)),
    ],
)
def test_a_way_ends_where_it_is_too_far_from_home(
    start: Point, goal: Point, reach_m: float, end: Point
) -> None:
    assert limited_to_reach(start, goal, HOME, reach_m) == pytest.approx(end, abs=0.01)


def test_who_is_too_far_already_may_only_come_nearer() -> None:
    start = (110.0, 0.0)
    assert limited_to_reach(start, (120.0, 0.0), HOME, 50.0) == pytest.approx(start)
    assert limited_to_reach(start, (110.0, 10.0), HOME, 50.0) == pytest.approx(start)
    assert limited_to_reach(start, (90.0, 0.0), HOME, 50.0) == (90.0, 0.0)
    assert limited_to_reach(start, (-300.0, 0.0), HOME, 50.0) == pytest.approx((-90.0, 0.0))


positions = st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0))


@given(positions, positions, positions, st.floats(0.0, 400.0))
def test_no_way_leads_too_far_and_none_is_cut_too_soon(
    start: Point, goal: Point, home: Point, reach_m: float
) -> None:
    end = limited_to_reach(start, goal, home, reach_m)
    most_m = max(reach_m, math.dist(start, home))
    assert math.dist(end, home) <= most_m + 1e-6
    assert math.dist(start, end) + math.dist(end, goal) == pytest.approx(math.dist(start, goal))
    if end != goal and math.dist(end, goal) > 1e-3:
        share = 1e-3 / math.dist(end, goal)
        beyond = (end[0] + share * (goal[0] - end[0]), end[1] + share * (goal[1] - end[1]))
        assert math.dist(beyond, home) >= most_m - 1e-6


def test_a_way_along_the_border_of_the_reach_ends_where_it_begins() -> None:
    """Rounding puts this start outside its own distance from home, by less than its resolution."""
    start, home = (9.9, 8.1), (0.0, 0.0)
    aside = (start[0] - 4.0 * start[1], start[1] + 4.0 * start[0])
    assert limited_to_reach(start, aside, home, 1.0) == pytest.approx(start, abs=1e-6)


def test_a_way_whose_square_is_nothing_is_no_way() -> None:
    goal = (5e-169, 0.0)
    assert limited_to_reach((0.0, 0.0), goal, (0.0, 0.0), 0.0) == goal
