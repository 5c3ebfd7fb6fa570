from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.geometry.obstacles import (
    GRAZE_M,
    FreeSpace,
    between,
    moved_left,
    share_in_capsule,
)
from companion.geometry.polygons import Point, depth_m, nearest_on_segment

SQUARE = ((0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0))
HOUSE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))

positions = st.tuples(st.floats(-150.0, 150.0), st.floats(-150.0, 150.0))


@st.composite
def stars(draw: st.DrawFn, least_m: float, most_m: float) -> tuple[Point, ...]:
    """A star-shaped polygon, convex or not, in either direction."""
    centre = draw(st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0)))
    radii = draw(st.lists(st.floats(least_m, most_m), min_size=3, max_size=8))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    polygon = tuple(
        (
            centre[0] + radius * math.cos(first + 2.0 * math.pi * i / len(radii)),
            centre[1] + radius * math.sin(first + 2.0 * math.pi * i / len(radii)),
        )
        for i, radius in enumerate(radii)
    )
    return polygon if draw(st.booleans()) else polygon[::-1]


@st.composite
def spaces(draw: st.DrawFn) -> FreeSpace:
    fence = draw(st.none() | stars(50.0, 150.0))
    keep_outs = draw(st.lists(stars(3.0, 30.0), max_size=4))
    return FreeSpace(fence, keep_outs, draw(st.sampled_from([0.0, 0.5, 3.0])))


@pytest.mark.parametrize(
    ("point", "allowed"),
    [
        ((5.0, 5.0), True),
        ((2.0, 5.0), True),
        ((1.9, 5.0), False),
        ((8.0, 15.0), True),
        ((8.1, 15.0), False),
        ((15.0, 15.0), False),
        ((8.5, 8.5), True),  # the corner of the house is rounded
        ((8.6, 8.6), False),
        ((-5.0, 5.0), False),
        ((math.nan, 5.0), False),
    ],
)
def test_free_is_inside_and_outside_by_the_margin(point: Point, allowed: bool) -> None:
    assert FreeSpace(SQUARE, [HOUSE], 2.0).allows(point) is allowed
    assert FreeSpace(SQUARE[::-1], [HOUSE[::-1]], 2.0).allows(point) is allowed


@given(spaces(), positions)
def test_only_edges_nearby_decide_and_that_is_enough(space: FreeSpace, point: Point) -> None:
    fences = space.borders[: len(space.borders) - len(space.keep_out_enu_m)]
    depths_m = [depth_m(fence, point) for fence in fences]
    depths_m += [-depth_m(keep_out, point) for keep_out in space.keep_out_enu_m]
    assert space.allows(point) is all(depth >= max(space.margin_m, GRAZE_M) for depth in depths_m)


@pytest.mark.parametrize("point", [HOUSE[0], HOUSE[2], (15.0, 10.0), (0.0, 20.0), SQUARE[1]])
def test_without_a_margin_a_border_is_still_forbidden(point: Point) -> None:
    """A leg that begins there is not clear, so that nothing could be flown from it."""
    space = FreeSpace(SQUARE, [HOUSE], 0.0)
    assert not space.allows(point)
    assert not space.is_clear(point, point)
    nearest = space.nearest_allowed(point)
    assert nearest is not None
    assert space.is_clear(nearest, nearest)


def test_without_a_fence_everything_else_is_free() -> None:
    space = FreeSpace(None, [HOUSE], 1.0)
    assert space.allows((1e6, 1e6))
    assert not space.allows((15.0, 15.0))
    assert space.is_clear((0.0, 0.0), (0.0, 40.0))
    assert not space.is_clear((0.0, 15.0), (40.0, 15.0))


@pytest.mark.parametrize(
    ("start", "end", "is_clear"),
    [
        ((5.0, 5.0), (35.0, 5.0), True),
        ((5.0, 15.0), (35.0, 15.0), False),
        ((5.0, 8.0), (35.0, 8.0), True),  # grazes the margin of the house
        ((5.0, 8.1), (35.0, 8.1), False),
        ((15.0, 15.0), (15.1, 15.0), False),
        ((5.0, 5.0), (5.0, 45.0), False),
        ((45.0, 5.0), (46.0, 5.0), False),
        ((5.0, 5.0), (5.0, 5.0), True),
    ],
)
def test_a_leg_is_clear_if_all_of_it_is(start: Point, end: Point, is_clear: bool) -> None:
    assert FreeSpace(SQUARE, [HOUSE], 2.0).is_clear(start, end) is is_clear


def test_a_leg_is_cut_into_what_is_free_of_it() -> None:
    pieces = FreeSpace(SQUARE, [HOUSE], 2.0).pieces((-10.0, 15.0), (50.0, 15.0))
    ends = [end for piece in pieces for end in piece]
    assert [east for east, _ in ends] == pytest.approx([2.0, 8.0, 22.0, 38.0])
    assert list(FreeSpace(None).pieces((0.0, 0.0), (1.0, 0.0))) == [((0.0, 0.0), (1.0, 0.0))]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(spaces(), positions, positions)
def test_pieces_and_clearness_agree_with_dense_samples(
    space: FreeSpace, start: Point, end: Point
) -> None:
    pieces = list(space.pieces(start, end))
    for a, b in pieces:
        assert all(space.allows(between(a, b, step / 20.0)) for step in range(1, 20))
    free_m = sum(math.dist(a, b) for a, b in pieces)
    samples = [space.allows(between(start, end, (step + 0.5) / 400.0)) for step in range(400)]
    assert free_m == pytest.approx(
        math.dist(start, end) * sum(samples) / 400.0, abs=math.dist(start, end) / 20.0
    )
    if space.is_clear(start, end):
        assert all(samples) or space.margin_m == 0.0
    if not all(samples):
        assert not space.is_clear(start, end)


@settings(max_examples=60, deadline=None)
@given(spaces(), positions)
def test_no_allowed_point_of_a_fine_grid_is_nearer(space: FreeSpace, point: Point) -> None:
    nearest = space.nearest_allowed(point)
    grid = [(-150.0 + 7.5 * i, -150.0 + 7.5 * j) for i in range(41) for j in range(41)]
    if nearest is None:
        assert not any(space.allows(other) for other in grid)
        return
    assert space.allows(nearest)
    reach_m = math.dist(nearest, point)
    assert all(math.dist(g, point) >= reach_m - 1e-4 or not space.allows(g) for g in grid)


@pytest.mark.parametrize(
    ("point", "nearest"),
    [
        ((11.0, 15.0), (8.0, 15.0)),
        ((19.0, 15.5), (22.0, 15.5)),
        ((9.9, 9.9), (10.0 - math.sqrt(2.0), 10.0 - math.sqrt(2.0))),
        ((30.0, 60.0), (30.0, 38.0)),
        ((5.0, 5.0), (5.0, 5.0)),
    ],
)
def test_the_nearest_allowed_point(point: Point, nearest: Point) -> None:
    assert FreeSpace(SQUARE, [HOUSE], 2.0).nearest_allowed(point) == pytest.approx(
        nearest, abs=1e-5
    )


def test_in_the_nook_between_two_rounded_corners() -> None:
    """Two masts 3 m apart, 2 m clear of both: the nearest position is where the circles meet."""
    masts = [
        ((-1.6, 0.0), (-1.5, -0.05), (-1.5, 0.05)),
        ((1.5, -0.05), (1.6, 0.0), (1.5, 0.05)),
    ]
    found = FreeSpace(None, masts, 2.0).nearest_allowed((0.0, 0.3))
    assert found is not None
    assert abs(found[0]) < 1e-3
    assert found[1] == pytest.approx(math.sqrt(4.0 - 2.25), abs=0.1)


def test_where_nothing_is_left_there_is_no_nearest_point() -> None:
    assert FreeSpace(SQUARE, (), 25.0).nearest_allowed((20.0, 20.0)) is None
    covered = ((-5.0, -5.0), (50.0, -5.0), (50.0, 50.0), (-5.0, 50.0))
    assert FreeSpace(SQUARE, [covered], 0.0).nearest_allowed((20.0, 20.0)) is None


def test_repeated_corners_are_dropped() -> None:
    assert FreeSpace((SQUARE[0], *SQUARE)).fence_enu_m == SQUARE


def test_the_end_of_a_way_is_exact() -> None:
    a, b = (0.1, 0.2), (0.7, 1e17)
    assert between(a, b, 0.0) == a
    assert between(a, b, 1.0) == b


def test_moved_to_the_left() -> None:
    assert moved_left((0.0, 0.0), (0.0, 5.0), 2.0) == ((-2.0, 0.0), (-2.0, 5.0))


def test_shares_in_a_capsule() -> None:
    edge = ((0.0, 0.0), (10.0, 0.0))
    assert share_in_capsule((5.0, -4.0), (5.0, 4.0), edge, 2.0) == pytest.approx((0.25, 0.75))
    assert share_in_capsule((-8.0, 0.0), (18.0, 0.0), edge, 1.0) == pytest.approx((7 / 26, 19 / 26))
    assert share_in_capsule((-8.0, 3.0), (18.0, 3.0), edge, 1.0) is None
    assert share_in_capsule((-2.0, -4.0), (-2.0, 4.0), edge, 1.0) is None
    still = share_in_capsule((5.0, 0.5), (5.0, 0.5), edge, 1.0)
    assert still == (-math.inf, math.inf)
    assert share_in_capsule((5.0, 1.5), (5.0, 1.5), edge, 1.0) is None


@given(positions, positions, positions, positions, st.floats(0.1, 20.0))
def test_a_leg_is_in_a_capsule_exactly_between_its_shares(
    start: Point, end: Point, a: Point, b: Point, radius_m: float
) -> None:
    assume(math.dist(a, b) > 1e-3)
    share = share_in_capsule(start, end, (a, b), radius_m)
    for step in range(41):
        t = step / 40.0
        point = between(start, end, t)
        distance = math.dist(point, nearest_on_segment(a, b, point))
        if share is not None and share[0] + 1e-6 < t < share[1] - 1e-6:
            assert distance <= radius_m + 1e-6
        if share is None or t < share[0] - 1e-6 or t > share[1] + 1e-6:
            assert distance >= radius_m - 1e-6
