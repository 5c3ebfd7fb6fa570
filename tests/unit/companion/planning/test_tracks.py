from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.geometry.obstacles import FreeSpace, between
from companion.geometry.polygons import Point, contains, distance_to_border_m, nearest_on_segment
from companion.planning.search_tracks import (
    MIN_LEG_M,
    Leg,
    Track,
    clipped,
    expanding_square,
    heading_of_fewest_lanes_rad,
    parallel_track,
    sector_search,
)
from tests.unit.companion.geometry.test_obstacles import stars

FIELD = ((0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0))
HORSESHOE = (
    (0.0, 0.0),
    (60.0, 0.0),
    (60.0, 60.0),
    (40.0, 60.0),
    (40.0, 20.0),
    (20.0, 20.0),
    (20.0, 60.0),
    (0.0, 60.0),
)
EAST_RAD, NORTH_RAD = math.radians(90.0), 0.0


def _lanes(
    area: tuple[Point, ...],
    spacing_m: float,
    heading_rad: float = EAST_RAD,
    entry: Point = (0.0, 0.0),
    spaces: tuple[FreeSpace, ...] = (),
) -> Track:
    inside = (FreeSpace(area), *spaces)
    return parallel_track(area, 0.0, spacing_m, heading_rad, inside, entry)


def _ends(track: Track) -> list[Point]:
    return [
        (round(position[0], 3) + 0.0, round(position[1], 3) + 0.0)
        for leg in track
        for position in (leg.start_enu_m, leg.end_enu_m)
    ]


def _hop_m(track: Track) -> float:
    """Flown between legs."""
    return sum(math.dist(a.end_enu_m, b.start_enu_m) for a, b in pairwise(track))


def _distance_m(track: Track, position: Point) -> float:
    return min(
        math.dist(position, nearest_on_segment(leg.start_enu_m, leg.end_enu_m, position))
        for leg in track
    )


def test_the_lanes_of_a_field() -> None:
    track = _lanes(FIELD, 20.0)
    assert _ends(track) == [
        (0.0, 10.0),
        (100.0, 10.0),
        (100.0, 30.0),
        (0.0, 30.0),
        (0.0, 50.0),
        (100.0, 50.0),
    ]


def test_the_lanes_of_the_study_begin_half_a_spacing_inside() -> None:
    square = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0))
    track = _lanes(square, 5.0)
    assert [leg.start_enu_m[1] for leg in track] == pytest.approx(
        [2.5 + 5.0 * lane for lane in range(20)]
    )


def test_lanes_are_moved_together_where_they_would_not_fit() -> None:
    track = _lanes(FIELD, 25.0)
    assert [leg.start_enu_m[1] for leg in track] == pytest.approx([10.0, 30.0, 50.0])


@pytest.mark.parametrize(
    ("entry", "first"),
    [
        ((-5.0, -5.0), ((0.0, 10.0), (100.0, 10.0))),
        ((120.0, 0.0), ((100.0, 10.0), (0.0, 10.0))),
        ((0.0, 90.0), ((0.0, 50.0), (100.0, 50.0))),
        ((120.0, 90.0), ((100.0, 50.0), (0.0, 50.0))),
    ],
)
def test_it_begins_at_the_nearest_corner(entry: Point, first: tuple[Point, Point]) -> None:
    assert tuple(_ends(_lanes(FIELD, 20.0, entry=entry))[:2]) == first


def test_lanes_lie_along_the_longer_side() -> None:
    assert math.sin(heading_of_fewest_lanes_rad(FIELD)) == pytest.approx(1.0)
    turned = tuple((-north, east) for east, north in FIELD)
    assert abs(math.cos(heading_of_fewest_lanes_rad(turned))) == pytest.approx(1.0)


def test_an_area_narrower_than_its_margins_has_no_lanes() -> None:
    assert parallel_track(FIELD, 31.0, 5.0, EAST_RAD, (), (0.0, 0.0)) == ()


def test_the_arms_of_a_horseshoe_are_flown_one_after_the_other() -> None:
    track = _lanes(HORSESHOE, 10.0)
    assert len(track) == 2 + 4 + 4
    assert _hop_m(track) < 3 * 60.0  # between lanes of one arm 10 m, and once between the arms
    back_and_forth = [leg.start_enu_m[0] < 30.0 for leg in track[2:]]
    assert back_and_forth in ([True] * 4 + [False] * 4, [False] * 4 + [True] * 4)


def test_a_keep_out_parts_the_lanes() -> None:
    house = FreeSpace(None, [((40.0, 20.0), (60.0, 20.0), (60.0, 40.0), (40.0, 40.0))], 2.0)
    track = _lanes(FIELD, 20.0, spaces=(house,))
    lane = sorted(end for end in _ends(track) if end[1] == 30.0)
    assert [east for east, _ in lane] == [0.0, 38.0, 62.0, 100.0]


@settings(max_examples=80, deadline=None)
@given(stars(30.0, 100.0), st.floats(5.0, 40.0), st.floats(0.0, 2.0 * math.pi), st.data())
def test_no_place_deep_in_any_area_is_farther_from_a_lane_than_half_the_spacing(
    area: tuple[Point, ...], spacing_m: float, heading_rad: float, data: st.DataObject
) -> None:
    track = _lanes(area, spacing_m, heading_rad)
    position = data.draw(st.tuples(st.floats(-160.0, 160.0), st.floats(-160.0, 160.0)))
    if (
        contains(area, position)
        and distance_to_border_m(area, position) > 0.5 * spacing_m + MIN_LEG_M
    ):
        assert _distance_m(track, position) <= 0.5 * spacing_m + 1e-6


@settings(max_examples=60, deadline=None)
@given(stars(30.0, 100.0), st.floats(5.0, 40.0), st.floats(0.0, 2.0 * math.pi))
def test_every_lane_is_inside_and_flown_once(
    area: tuple[Point, ...], spacing_m: float, heading_rad: float
) -> None:
    track = _lanes(area, spacing_m, heading_rad)
    space = FreeSpace(area)
    for leg in track:
        middle = between(leg.start_enu_m, leg.end_enu_m, 0.5)
        assert space.allows(middle)
        assert sum(_distance_m((other,), middle) < 1e-6 for other in track) == 1


def test_the_legs_of_an_expanding_square() -> None:
    track = expanding_square((0.0, 0.0), 10.0, 20.0, NORTH_RAD, ())
    assert [round(leg.length_m) for leg in track] == [10, 10, 20, 20, 30, 30, 40, 40, 40]
    assert _ends(track)[1:8:2] == [(0.0, 10.0), (10.0, 10.0), (10.0, -10.0), (-10.0, -10.0)]
    assert _ends(track)[-1] == (-20.0, 20.0)  # closed


def test_an_expanding_square_covers_its_square() -> None:
    track = expanding_square((5.0, -3.0), 10.0, 40.0, EAST_RAD, ())
    for i in range(-40, 41, 4):
        for j in range(-40, 41, 4):
            assert _distance_m(track, (5.0 + i, -3.0 + j)) <= 10.0 / math.sqrt(2.0)


def test_an_expanding_square_turns_right() -> None:
    track = expanding_square((0.0, 0.0), 10.0, 30.0, math.radians(20.0), ())
    for one, other in pairwise(track):
        a = (one.end_enu_m[0] - one.start_enu_m[0], one.end_enu_m[1] - one.start_enu_m[1])
        b = (other.end_enu_m[0] - other.start_enu_m[0], other.end_enu_m[1] - other.start_enu_m[1])
        assert a[0] * b[1] - a[1] * b[0] < 0.0
        assert a[0] * b[0] + a[1] * b[1] == pytest.approx(0.0, abs=1e-6)


def test_the_legs_of_a_sector_search() -> None:
    track = sector_search((0.0, 0.0), 60.0, NORTH_RAD, ())
    assert [leg.length_m for leg in track] == pytest.approx([60.0] * 9)
    assert [leg.end_enu_m for leg in track[2::3]] == [(0.0, 0.0)] * 3
    for leg, heading_deg in zip(track, [0, 120, 240, 240, 0, 120, 120, 240, 0], strict=True):
        end = (
            leg.start_enu_m[0] + 60.0 * math.sin(math.radians(heading_deg)),
            leg.start_enu_m[1] + 60.0 * math.cos(math.radians(heading_deg)),
        )
        assert leg.end_enu_m == pytest.approx(end, abs=1e-6)


def test_what_is_cut_short_to_nothing_is_left_out() -> None:
    space = FreeSpace(((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)))
    legs = [Leg((9.8, 5.0), (30.0, 5.0)), Leg((-5.0, 5.0), (5.0, 5.0)), Leg((20, 0), (30, 0))]
    assert _ends(clipped(legs, [space])) == [(0.0, 5.0), (5.0, 5.0)]


def test_a_leg_backwards() -> None:
    assert Leg((1.0, 2.0), (3.0, 4.0)).reversed() == Leg((3.0, 4.0), (1.0, 2.0))
