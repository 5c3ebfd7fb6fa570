from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.geometry.polygons import (
    Point,
    area_m2,
    contains,
    deepest_point,
    depth_m,
    distance_to_border_m,
    edges,
    is_simple,
    nearest_on_segment,
    polygon_problem,
    segments_cross,
)

SQUARE = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)]
HOOK = [(0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (20.0, 30.0), (20.0, 10.0), (0.0, 10.0)]
BOW_TIE = [(0.0, 0.0), (10.0, 10.0), (10.0, 0.0), (0.0, 10.0)]

_coordinates = st.floats(-1000.0, 1000.0)
_points = st.tuples(_coordinates, _coordinates)


@st.composite
def star_shaped(draw: st.DrawFn) -> list[Point]:
    """A simple polygon about a centre that sees every corner, convex or not."""
    centre = draw(_points)
    count = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(1.0, 500.0), min_size=count, max_size=count))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    corners = [
        (
            centre[0] + radius * math.cos(first + 2.0 * math.pi * i / count),
            centre[1] + radius * math.sin(first + 2.0 * math.pi * i / count),
        )
        for i, radius in enumerate(radii)
    ]
    return corners if draw(st.booleans()) else corners[::-1]


@pytest.mark.parametrize(
    ("polygon", "point", "inside"),
    [
        (SQUARE, (5.0, 5.0), True),
        (SQUARE, (-1.0, 5.0), False),
        (SQUARE, (5.0, 11.0), False),
        (SQUARE, (11.0, 10.0), False),
        (HOOK, (25.0, 25.0), True),
        (HOOK, (10.0, 20.0), False),
        (HOOK, (10.0, 5.0), True),
        (HOOK[::-1], (25.0, 25.0), True),
        (HOOK[::-1], (10.0, 20.0), False),
    ],
)
def test_inside_and_outside(polygon: list[Point], point: Point, inside: bool) -> None:
    assert contains(polygon, point) is inside


@pytest.mark.parametrize(
    ("polygon", "point", "depth"),
    [(SQUARE, (5.0, 4.0), 4.0), (SQUARE, (-3.0, -4.0), -5.0), (HOOK, (10.0, 20.0), -10.0)],
)
def test_depth_is_positive_inside_and_negative_outside(
    polygon: list[Point], point: Point, depth: float
) -> None:
    assert depth_m(polygon, point) == pytest.approx(depth)


def test_edges_close_the_polygon() -> None:
    assert list(edges(SQUARE))[-1] == (SQUARE[3], SQUARE[0])


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("point", [(5.0, 1.0), (9.0, 5.0), (5.0, 9.0), (1.0, 5.0)])
def test_every_edge_counts_whichever_corner_is_the_first(point: Point, first: int) -> None:
    """The closing edge is a border like any other."""
    turned = SQUARE[first:] + SQUARE[:first]
    for polygon in (turned, turned[::-1]):
        assert distance_to_border_m(polygon, point) == pytest.approx(1.0)
        assert depth_m(polygon, point) == pytest.approx(1.0)
        assert contains(polygon, point)


def test_areas() -> None:
    assert area_m2(SQUARE) == pytest.approx(100.0)
    assert area_m2(HOOK) == pytest.approx(500.0)
    assert area_m2(HOOK[::-1]) == pytest.approx(500.0)


def test_an_edge_without_length_is_its_point() -> None:
    assert nearest_on_segment((1.0, 2.0), (1.0, 2.0), (9.0, 9.0)) == (1.0, 2.0)


def test_segments_that_cross_and_that_do_not() -> None:
    assert segments_cross((0, 0), (10, 10), (0, 10), (10, 0))
    assert not segments_cross((0, 0), (10, 10), (11, 0), (20, 0))
    assert not segments_cross((0, 0), (10, 0), (10, 0), (20, 5))
    assert not segments_cross((0, 0), (10, 0), (0, 1), (10, 1))


def test_simple_and_self_crossing_polygons() -> None:
    assert is_simple(SQUARE)
    assert is_simple(HOOK)
    assert not is_simple(BOW_TIE)


BOW_THROUGH_A_CORNER = [(0.0, 0.0), (120.0, 120.0), (100.0, 0.0), (50.0, 50.0), (0.0, 100.0)]
PINCH = [(0.0, 0.0), (50.0, 50.0), (100.0, 0.0), (100.0, 100.0), (50.0, 50.0), (0.0, 100.0)]
SPIKE = [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (5.0, 9.0), (5.0, 20.0), (5.0, 9.0), (0.0, 9.0)]
BACK_AND_FORTH = [(0.0, 0.0), (9.0, 0.0), (5.0, 0.0), (9.0, 9.0), (0.0, 9.0)]
RING_TWICE = SQUARE + SQUARE
CLOSED_RING_TWICE = [*SQUARE, SQUARE[0], *SQUARE, SQUARE[0]]
NEEDLE = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (5.0, 0.0005), (0.0, 10.0)]


@pytest.mark.parametrize(
    "polygon",
    [BOW_THROUGH_A_CORNER, PINCH, SPIKE, BACK_AND_FORTH, RING_TWICE, CLOSED_RING_TWICE, NEEDLE],
)
def test_a_border_that_touches_itself_is_not_simple(polygon: list[Point]) -> None:
    """Any corner may be given first, in either direction."""
    for first in range(len(polygon)):
        turned = polygon[first:] + polygon[:first]
        assert not is_simple(turned)
        assert not is_simple(turned[::-1])


@pytest.mark.parametrize(
    "polygon",
    [
        [*SQUARE, SQUARE[0]],
        [SQUARE[0], *SQUARE, (0.0, 10.0)],
        [*SQUARE, (0.0, 0.0005)],
        [*SQUARE[:3], (5.0, 10.0), (0.0, 10.0)],
        [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (5.0, 0.0015), (0.0, 10.0)],
    ],
)
def test_a_corner_given_again_and_one_on_an_edge_are_harmless(polygon: list[Point]) -> None:
    for first in range(len(polygon)):
        turned = polygon[first:] + polygon[:first]
        assert is_simple(turned)
        assert is_simple(turned[::-1])


@pytest.mark.parametrize(
    ("polygon", "problem"),
    [
        (SQUARE, None),
        (SQUARE[:2], "at least 3 corners"),
        ([*SQUARE[:3], (math.nan, 5.0)], "not a finite number"),
        ([*SQUARE[:3], (0.0, -math.inf)], "not a finite number"),
        ([*SQUARE[:3], (-1e6, 10.0)], None),
        ([*SQUARE[:3], (0.0, 1.000001e6)], "farther than 1000 km from the origin"),
        ([*SQUARE[:3], (-1e300, 10.0)], "farther than 1000 km from the origin"),
        (RING_TWICE, "touch or cross"),
        ([(0.0, 0.0), (40.0, 0.0), (80.0, 0.0)], "encloses no area"),
        ([(0.0, 0.0), (20.0, 0.0), (0.0, 10.0)], None),
        ([(0.0, 0.0), (19.9, 0.0), (0.0, 10.0)], "encloses no area"),
    ],
)
def test_what_is_wrong_with_a_polygon_of_at_least_a_hundred_square_metres(
    polygon: list[Point], problem: str | None
) -> None:
    found = polygon_problem(polygon, 100.0)
    assert (found is None) if problem is None else (found is not None and problem in found)


@given(star_shaped(), _points)
def test_the_start_corner_and_the_direction_do_not_matter(
    polygon: list[Point], point: Point
) -> None:
    assume(distance_to_border_m(polygon, point) > 1e-6)
    inside = contains(polygon, point)
    assert contains(polygon[::-1], point) is inside
    assert contains(polygon[1:] + polygon[:1], point) is inside


@given(star_shaped(), _points, _points)
def test_depth_changes_no_faster_than_one_moves(
    polygon: list[Point], first: Point, second: Point
) -> None:
    change = abs(depth_m(polygon, first) - depth_m(polygon, second))
    assert change <= math.dist(first, second) + 1e-6


@given(star_shaped())
def test_star_shaped_polygons_are_simple_and_have_an_inside(polygon: list[Point]) -> None:
    assert is_simple(polygon)
    assert area_m2(polygon) > 0.0


@pytest.mark.parametrize("polygon", [SQUARE, HOOK, HOOK[::-1]])
def test_the_deepest_point_is_well_inside(polygon: list[Point]) -> None:
    assert depth_m(polygon, deepest_point(polygon)) > 4.0


@given(_points, _points, _points)
def test_the_nearest_point_of_a_segment_is_nearer_than_its_ends(
    start: Point, end: Point, point: Point
) -> None:
    nearest = nearest_on_segment(start, end, point)
    distance = math.dist(nearest, point)
    assert distance <= min(math.dist(start, point), math.dist(end, point)) + 1e-6
    along = math.dist(start, nearest) + math.dist(nearest, end)
    assert along == pytest.approx(math.dist(start, end), abs=1e-6)
