from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.geometry.obstacles import GRAZE_M
from companion.geometry.polygons import Point, deepest_point, depth_m
from companion.guard.limits import Fence

SQUARE = ((0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0))
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

positions = st.tuples(st.floats(-400.0, 400.0), st.floats(-400.0, 400.0))


@st.composite
def fences(draw: st.DrawFn) -> Fence:
    """A star-shaped fence, convex or not, in either direction, with a margin that fits."""
    radii = draw(st.lists(st.floats(20.0, 200.0), min_size=3, max_size=8))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    polygon = tuple(
        (
            radius * math.cos(first + 2.0 * math.pi * i / len(radii)),
            radius * math.sin(first + 2.0 * math.pi * i / len(radii)),
        )
        for i, radius in enumerate(radii)
    )
    margin_m = draw(st.floats(0.0, 0.9)) * depth_m(polygon, deepest_point(polygon))
    return Fence(polygon if draw(st.booleans()) else polygon[::-1], margin_m)


@pytest.mark.parametrize(
    ("polygon", "margin_m", "problem"),
    [
        (SQUARE[:2], 0.0, "at least 3 corners"),
        ((*SQUARE[:3], (math.nan, 40.0)), 0.0, "not a finite number"),
        ((*SQUARE[:3], (0.0, math.inf)), 0.0, "not a finite number"),
        (((0.0, 0.0), (40.0, 40.0), (40.0, 0.0), (0.0, 40.0)), 0.0, "cross each other"),
        (((0.0, 0.0), (40.0, 0.0), (80.0, 0.0)), 0.0, "^a fence encloses no area"),
        (((0.0, 0.0), (0.9, 0.0), (0.9, 0.9), (0.0, 0.9)), 0.0, "encloses no area"),
        (
            tuple((math.cos(k / 32), math.sin(k / 32)) for k in range(201)),
            0.0,
            "201 corners in all",
        ),
        ((*SQUARE, *SQUARE), 0.0, "touch or cross"),
        ((*SQUARE[:3], (0.0, 1e7)), 0.0, "farther than 1000 km"),
        (SQUARE, -0.1, "^the margin of a fence must be 0 or more$"),
        (SQUARE, math.nan, "must be 0 or more"),
        (SQUARE, 20.0, "margin of 20 m leaves nothing"),
        (SQUARE, depth_m(SQUARE, deepest_point(SQUARE)), "leaves nothing"),
        (SQUARE, math.inf, "leaves nothing"),
    ],
)
def test_a_fence_that_encloses_nothing_usable_is_refused(
    polygon: tuple[Point, ...], margin_m: float, problem: str
) -> None:
    with pytest.raises(ValueError, match=problem):
        Fence(polygon, margin_m)


def test_a_fence_may_have_two_hundred_corners_with_those_of_its_keep_outs() -> None:
    ring = tuple((20.0 + math.cos(k / 32), 20.0 + math.sin(k / 32)) for k in range(196))
    assert not Fence(SQUARE, 1.0, (ring,)).allows((20.0, 20.0))
    with pytest.raises(
        ValueError, match="201 corners in all, with those of keep_out_enu_m; at most 200"
    ):
        Fence((*SQUARE, (0.0, 20.0)), 1.0, (ring,))


@pytest.mark.parametrize("side_m", [1.0, 1.1])
def test_a_fence_of_a_square_metre_or_a_little_more_is_one(side_m: float) -> None:
    square = ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m))
    assert Fence(square, 0.0).allows((0.5, 0.5))


def test_fences_are_equal_by_what_they_were_made_of_and_say_only_that() -> None:
    assert Fence(SQUARE, 3.0) == Fence(SQUARE, 3.0)
    assert "FreeSpace" not in repr(Fence(SQUARE, 3.0))


@pytest.mark.parametrize(
    ("point", "allowed", "inside"),
    [
        ((20.0, 20.0), True, True),
        ((3.0, 20.0), True, True),
        ((2.9, 20.0), False, True),
        ((-0.1, 20.0), False, False),
        ((math.nan, 20.0), False, False),
        ((math.inf, 20.0), False, False),
    ],
)
def test_the_margin_is_inside_the_border(point: Point, allowed: bool, inside: bool) -> None:
    fence = Fence(SQUARE, 3.0)
    assert fence.allows(point) is allowed
    assert (depth_m(fence.polygon_enu_m, point) > 0.0) is inside


@pytest.mark.parametrize(
    ("point", "nearest"),
    [
        ((10.0, 20.0), (10.0, 20.0)),
        ((1.0, 50.0), (3.0, 50.0)),
        ((59.0, 50.0), (57.0, 50.0)),  # not over the gap to the other arm, where there is more room
        ((-30.0, 5.0), (3.0, 5.0)),
        ((-30.0, -40.0), (3.0, 3.0)),
        ((29.0, 90.0), (15.0, 57.0)),
        ((17.0, 9.0), (18.0 - 1.5 * math.sqrt(2), 10.0 - 1.5 * math.sqrt(2))),
    ],
)
def test_the_way_back_is_the_nearest_one(point: Point, nearest: Point) -> None:
    found = Fence(HORSESHOE, 3.0).nearest_allowed(point)
    assert math.dist(found, point) == pytest.approx(math.dist(nearest, point), abs=1e-5)
    if point not in ((17.0, 9.0), (29.0, 90.0)):
        assert found == pytest.approx(nearest, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(fences(), positions)
def test_no_allowed_point_of_a_fine_grid_is_nearer(fence: Fence, point: Point) -> None:
    """Brute force over the bounding box."""
    nearest = fence.nearest_allowed(point)
    assert fence.allows(nearest)
    reach_m = math.dist(nearest, point)
    for i in range(41):
        for j in range(41):
            other = (-200.0 + 10.0 * i, -200.0 + 10.0 * j)
            assert math.dist(other, point) >= reach_m - 1e-4 or not fence.allows(other)


@settings(max_examples=60, deadline=None)
@given(fences(), positions, positions)
def test_the_way_is_followed_as_far_as_it_is_allowed(
    fence: Fence, start: Point, goal: Point
) -> None:
    """Brute force along the way: everything before the end is allowed, what follows is not."""
    start = fence.nearest_allowed(start)
    end = fence.limited(start, goal)
    assert fence.allows(end)
    length_m, flown_m = math.dist(start, goal), math.dist(start, end)
    assert flown_m <= length_m + 1e-9
    for step in range(1, 200):
        share = step / 200 * flown_m / length_m if length_m else 0.0
        way = (start[0] + share * (goal[0] - start[0]), start[1] + share * (goal[1] - start[1]))
        # The search steps by a quarter of the margin: it may graze a corner's circle that deep.
        assert depth_m(fence.polygon_enu_m, way) >= 0.99 * fence.margin_m - 0.02
    if end != goal:
        share = (flown_m + 1e-3) / length_m
        beyond = (start[0] + share * (goal[0] - start[0]), start[1] + share * (goal[1] - start[1]))
        assume(flown_m + 1e-3 < length_m)
        assert depth_m(fence.polygon_enu_m, beyond) < fence.margin_m + 1e-3


def test_an_allowed_goal_is_reached_exactly() -> None:
    fence = Fence(SQUARE, 3.0)
    assert fence.limited((10.0, 10.0), (30.0, 35.0)) == (30.0, 35.0)
    assert fence.limited((10.0, 10.0), (10.0, 10.0)) == (10.0, 10.0)


def test_a_way_that_grazes_a_keep_out_by_rounding_is_followed_to_its_end() -> None:
    goal = (30.0, 7.0 + 0.5 * GRAZE_M)
    assert Fence(SQUARE, 3.0, (HOUSE,)).limited((4.0, goal[1]), goal) == goal


def test_no_rounding_makes_a_goal_in_the_margin_an_allowed_one() -> None:
    fence = Fence(SQUARE, 3.0)
    assert fence.allows(fence.limited((20.0, 20.0), (20.0, 3.0 - 0.5 * GRAZE_M)))


def test_an_allowed_goal_behind_a_notch_is_not() -> None:
    """From one arm of the horseshoe to the other: the setpoint stops before the gap."""
    east, north = Fence(HORSESHOE, 3.0).limited((9.0, 50.0), (50.0, 50.0))
    assert (east, north) == pytest.approx((15.0, 50.0), abs=1e-6)


def test_a_start_that_is_not_allowed_goes_inwards_whatever_the_goal() -> None:
    fence = Fence(SQUARE, 3.0)
    for goal in ((20.0, 20.0), (-1e9, 20.0)):
        assert fence.limited((-5.0, 20.0), goal) == pytest.approx((3.0, 20.0), abs=1e-5)


@pytest.mark.parametrize("position", [(1e308, -1e308), (math.inf, 0.0), (math.nan, math.nan)])
def test_an_absurd_place_still_has_a_way_back(position: Point) -> None:
    for fence in (Fence(HORSESHOE, 3.0), Fence(SQUARE, 3.0)):
        assert fence.allows(fence.nearest_allowed(position))


def test_repeated_corners_are_harmless() -> None:
    fence = Fence((SQUARE[0], *SQUARE), 3.0)
    assert fence.nearest_allowed((-5.0, 20.0)) == pytest.approx((3.0, 20.0), abs=1e-5)


HOUSE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))


@pytest.mark.parametrize(
    ("keep_out", "problem"),
    [
        (HOUSE[:2], "keep-out needs at least 3 corners"),
        ((*HOUSE[:3], (math.nan, 0.0)), "keep-out has a corner that is not a finite number"),
        (
            (HOUSE[0], HOUSE[2], HOUSE[1], HOUSE[3]),
            "keep-out has two edges that touch or cross each other",
        ),
        (((0.0, 0.0), (9.0, 0.0), (4.0, 0.0)), "keep-out encloses no area"),
        (HOUSE + HOUSE, "keep-out has two edges that touch or cross"),
        (((-9.0, -9.0), (60.0, -9.0), (60.0, 60.0), (-9.0, 60.0)), "keep-outs leave nothing"),
    ],
)
def test_a_keep_out_that_is_none_or_leaves_nothing_is_refused(
    keep_out: tuple[Point, ...], problem: str
) -> None:
    with pytest.raises(ValueError, match=problem):
        Fence(SQUARE, 3.0, (keep_out,))


def test_borders_that_leave_nothing_of_the_fence_are_named() -> None:
    beside = ((90.0, 0.0), (99.0, 0.0), (99.0, 9.0))
    with pytest.raises(ValueError, match=r"^its other borders leave nothing of the fence$"):
        Fence(SQUARE, 3.0, also_inside_enu_m=(beside,))


def test_a_mast_may_be_a_keep_out() -> None:
    mast = ((10.0, 10.0), (10.1, 10.0), (10.1, 10.1), (10.0, 10.1))
    assert not Fence(SQUARE, 3.0, (mast,)).allows((12.0, 10.0))


def test_setpoints_keep_the_margin_to_keep_outs() -> None:
    fence = Fence(SQUARE, 3.0, (HOUSE,))
    assert fence.allows((15.0, 7.0))
    assert not fence.allows((15.0, 7.1))
    assert fence.limited((5.0, 15.0), (35.0, 15.0)) == pytest.approx((7.0, 15.0))
    assert fence.limited((15.0, 12.0), (15.0, 35.0)) == pytest.approx((15.0, 7.0), abs=1e-5)
    assert fence.nearest_allowed((19.0, 15.0)) == pytest.approx((23.0, 15.0), abs=1e-5)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(fences(), positions, st.floats(3.0, 30.0), positions, positions)
def test_no_step_ends_in_a_keep_out(
    fence: Fence, centre: Point, radius_m: float, start: Point, goal: Point
) -> None:
    keep_out = tuple(
        (centre[0] + radius_m * math.cos(k), centre[1] + radius_m * math.sin(k)) for k in range(6)
    )
    try:
        with_house = Fence(fence.polygon_enu_m, fence.margin_m, (keep_out,))
    except ValueError:
        return  # it leaves nothing
    assert with_house.allows(with_house.limited(start, goal))
    assert with_house.allows(with_house.limited(with_house.nearest_allowed(start), goal))
