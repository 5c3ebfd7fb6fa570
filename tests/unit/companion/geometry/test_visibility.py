from __future__ import annotations

import heapq
import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.geometry.obstacles import NODE_SLACK_M, FreeSpace, WayFinder, between
from companion.geometry.polygons import Point
from tests.unit.companion.geometry.test_obstacles import positions, stars

SQUARE = ((0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0))
HOUSE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))
HORSESHOE = (
    (0.0, 0.0),
    (60.0, 0.0),
    (60.0, 60.0),
    (40.0, 60.0),
    (40.0, 10.0),
    (18.0, 10.0),
    (18.0, 60.0),
    (0.0, 60.0),
)
GRID_M = 5.0


@st.composite
def finders(draw: st.DrawFn) -> WayFinder:
    fence = draw(st.none() | stars(50.0, 150.0))
    keep_outs = draw(st.lists(stars(3.0, 40.0), max_size=4))
    return WayFinder(FreeSpace(fence, keep_outs, draw(st.sampled_from([1e-6, 0.5, 3.0]))))


def _length_m(start: Point, way: tuple[Point, ...]) -> float:
    return sum(math.dist(a, b) for a, b in zip((start, *way), way, strict=False))


def test_a_clear_way_is_straight() -> None:
    finder = WayFinder(FreeSpace(SQUARE, [HOUSE], 1.0))
    assert finder.way((5.0, 5.0), (35.0, 5.0)) == ((35.0, 5.0),)


def test_around_a_house() -> None:
    finder = WayFinder(FreeSpace(SQUARE, [HOUSE], 1.0))
    way = finder.way((5.0, 14.0), (25.0, 14.0))
    assert way is not None
    assert len(way) == 5  # two nodes at each of two corners, and the goal
    assert all(north < 10.0 or position == way[-1] for position in way for north in position[1:])
    arcs_m = math.pi  # two quarters of a circle of 1 m
    shortest_m = 10.0 + 2.0 * math.hypot(4.0, 4.0) + arcs_m
    assert _length_m((5.0, 14.0), way) == pytest.approx(shortest_m, rel=0.05)


def test_from_one_arm_of_a_horseshoe_to_the_other() -> None:
    finder = WayFinder(FreeSpace(HORSESHOE, (), 3.0))
    way = finder.way((9.0, 50.0), (50.0, 50.0))
    assert way is not None
    assert min(north for _, north in way) == pytest.approx(7.0, abs=1e-3)


def test_a_spike_is_gone_around() -> None:
    spike = ((0.0, 0.0), (20.0, -0.1), (20.0, 0.1))
    finder = WayFinder(FreeSpace(None, [spike], 1.0))
    way = finder.way((10.0, 5.0), (10.0, -5.0))
    assert way is not None
    assert min(east for east, _ in way) == pytest.approx(-1.0, abs=0.1)


def test_behind_closed_walls_there_is_no_way() -> None:
    moat = FreeSpace(SQUARE, [((15.0, -1.0), (25.0, -1.0), (25.0, 41.0), (15.0, 41.0))], 1.0)
    assert WayFinder(moat).way((5.0, 5.0), (35.0, 5.0)) is None


def test_the_nodes_keep_the_margin() -> None:
    finder = WayFinder(FreeSpace(SQUARE, [HOUSE], 2.0))
    assert len(finder.nodes) == 8
    for node in finder.nodes:
        assert finder.space.allows(node)
        assert not FreeSpace(SQUARE, [HOUSE], 2.2).allows(node)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(finders(), positions, positions)
def test_every_leg_of_a_way_is_free_and_it_ends_at_the_goal(
    finder: WayFinder, start: Point, goal: Point
) -> None:
    begin, end = finder.space.nearest_allowed(start), finder.space.nearest_allowed(goal)
    assume(begin is not None and end is not None)
    assert begin is not None
    assert end is not None
    way = finder.way(begin, end)
    if way is None:
        return
    assert way[-1] == end
    looser = FreeSpace(
        finder.space.fence_enu_m,
        finder.space.keep_out_enu_m,
        finder.space.margin_m - 1e-8,
    )
    for a, b in zip((begin, *way), way, strict=False):
        assert all(looser.allows(between(a, b, step / 50.0)) for step in range(51))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(finders(), positions, positions)
def test_replanned_at_every_corner_it_arrives(finder: WayFinder, start: Point, goal: Point) -> None:
    position, end = finder.space.nearest_allowed(start), finder.space.nearest_allowed(goal)
    assume(position is not None and end is not None)
    assert position is not None
    assert end is not None
    left_m = math.inf
    for _ in range(len(finder.nodes) + 1):
        way = finder.way(position, end)
        assume(way is not None)
        assert way is not None
        assert _length_m(position, way) < left_m + NODE_SLACK_M
        left_m = _length_m(way[0], way[1:])
        position = way[0]
        if position == end:
            return
    pytest.fail("it goes round in circles")


def _grid_way_m(space: FreeSpace, start: Point, goal: Point) -> float | None:
    """The shortest way along the clear legs of a grid, by Dijkstra; None if there is none."""

    def near(position: Point) -> list[Point]:
        east, north = (round(v / GRID_M) for v in position)
        around = [(east + i, north + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return [(GRID_M * i, GRID_M * j) for i, j in around]

    queue, seen = [(0.0, start)], set[Point]()
    while queue:
        flown_m, here = heapq.heappop(queue)
        if here in seen:
            continue
        seen.add(here)
        if here == goal:
            return flown_m
        ends = [goal] if math.dist(here, goal) <= 2.0 * GRID_M else []
        for there in [*near(here), *ends]:
            is_new = there not in seen and max(map(abs, there)) <= 250.0
            if is_new and space.is_clear(here, there):
                heapq.heappush(queue, (flown_m + math.dist(here, there), there))
    return None


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(finders(), positions, positions)
def test_no_way_along_a_grid_is_shorter(finder: WayFinder, start: Point, goal: Point) -> None:
    begin, end = finder.space.nearest_allowed(start), finder.space.nearest_allowed(goal)
    assume(begin is not None and end is not None)
    assert begin is not None
    assert end is not None
    # A little more margin, as the arcs are gone around and not along.
    wider = FreeSpace(
        finder.space.fence_enu_m, finder.space.keep_out_enu_m, 1.09 * finder.space.margin_m
    )
    along_m = _grid_way_m(wider, begin, end)
    assume(along_m is not None)
    assert along_m is not None
    way = finder.way(begin, end)
    assert way is not None
    assert _length_m(begin, way) <= along_m + 1e-6
