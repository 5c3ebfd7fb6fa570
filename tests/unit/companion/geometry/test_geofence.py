from __future__ import annotations

import math

import pytest

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import (
    CIRCLE_CORNERS,
    DISTORTION,
    GeoArea,
    GeoFence,
    LatLon,
    LocalFence,
    NamedArea,
    corner_problem,
    difference,
    fence_of,
)
from companion.geometry.polygons import Point, contains, depth_m
from companion.guard.limits import Fence

ZURICH = LocalOrigin(47.397742, 8.545594, 488.0)
SQUARE = ((-100.0, -100.0), (100.0, -100.0), (100.0, 100.0), (-100.0, 100.0))
HOUSE = ((10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0))


def on_globe(corners: tuple[Point, ...], origin: LocalOrigin = ZURICH) -> GeoArea:
    positions = [origin.geodetic_from_enu((east, north, 0.0)) for east, north in corners]
    return GeoArea(tuple((lat, lon) for lat, lon, _ in positions))


def named(area: GeoArea, path: str = "it", *, is_inclusion: bool = True) -> NamedArea:
    return NamedArea(path, is_inclusion, area)


def flat(*corners: Point) -> list[float]:
    return [value for corner in corners for value in corner]


class TestLocal:
    def test_polygons_come_back_where_they_were_drawn(self) -> None:
        local = GeoFence(on_globe(SQUARE), (on_globe(HOUSE),)).local(ZURICH)
        assert flat(*local.polygon_enu_m) == pytest.approx(flat(*SQUARE), abs=1e-3)
        assert flat(*local.keep_out_enu_m[0]) == pytest.approx(flat(*HOUSE), abs=1e-3)
        assert local.distortion_m == pytest.approx(DISTORTION * math.hypot(100.0, 100.0), abs=1e-3)

    @pytest.mark.parametrize(
        ("latitude_deg", "longitude_deg"),
        [(0.0, 180.0), (10.0, -179.9995), (-45.0, 179.9999), (0.0, 0.0005), (84.99, 0.0)],
    )
    def test_the_antimeridian_and_the_equator_are_nothing_special(
        self, latitude_deg: float, longitude_deg: float
    ) -> None:
        origin = LocalOrigin(latitude_deg, longitude_deg, 10.0)
        fence = fence_of([named(on_globe(SQUARE, origin))])
        assert flat(*fence.local(origin).polygon_enu_m) == pytest.approx(flat(*SQUARE), abs=1e-2)

    def test_a_circle_is_cut_on_the_safe_side(self) -> None:
        centre = on_globe(((20.0, -30.0),)).corners_deg
        both = GeoFence(GeoArea(centre, 50.0), (GeoArea(centre, 50.0),)).local(ZURICH)
        inside, outside = both.polygon_enu_m, both.keep_out_enu_m[0]
        assert len(inside) == len(outside) == CIRCLE_CORNERS
        assert max(math.dist(c, (20.0, -30.0)) for c in inside) == pytest.approx(50.0, abs=1e-3)
        assert depth_m(inside, (20.0, -30.0)) >= 0.996 * 50.0
        assert depth_m(outside, (20.0, -30.0)) == pytest.approx(50.0, abs=1e-3)
        for turn in range(360):
            rim = (
                20.0 + 50.0 * math.cos(math.radians(turn)),
                -30.0 + 50.0 * math.sin(math.radians(turn)),
            )
            assert depth_m(inside, rim) <= 1e-3
            assert depth_m(outside, rim) >= -1e-3

    def test_a_fence_elsewhere_is_refused(self) -> None:
        fence = GeoFence(on_globe(SQUARE))
        with pytest.raises(ValueError, match="a corner of the fence is 111 km from the"):
            fence.local(LocalOrigin(46.4, 8.545594, 488.0))

    def test_its_centre_is_near(self) -> None:
        fence = GeoFence(on_globe(SQUARE))
        assert contains(fence.local(fence.centre).polygon_enu_m, (100.0, 100.0))


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "problem"),
    [
        (47.0, 8.0, None),
        (0.0, 8.0, None),
        (47.0, 0.0, None),
        (85.0, -180.0, None),
        (0.0, 0.0, "0/0 means"),
        (math.nan, 8.0, "not a finite number"),
        (47.0, math.inf, "not a finite number"),
        (90.1, 8.0, "not a latitude and longitude in degrees"),
        (47.0, 180.1, "not a latitude and longitude in degrees"),
        (473977420.0, 85455940.0, "not a latitude and longitude in degrees"),
        (85.1, 8.0, "too near to a pole"),
        (-90.0, 8.0, "too near to a pole"),
    ],
)
def test_places(latitude_deg: float, longitude_deg: float, problem: str | None) -> None:
    found = corner_problem(latitude_deg, longitude_deg)
    assert found is None if problem is None else problem in str(found)


BOW_TIE = (SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3])


def ring(count: int, radius_m: float = 100.0) -> tuple[Point, ...]:
    turns = [2.0 * math.pi * index / count for index in range(count)]
    return tuple((radius_m * math.cos(turn), radius_m * math.sin(turn)) for turn in turns)


class TestAreasThatMakeNoFence:
    @pytest.mark.parametrize(
        ("area", "problem"),
        [
            (GeoArea(()), "has 0 corners"),
            (on_globe(SQUARE[:2]), "has 2 corners"),
            (on_globe(BOW_TIE), "two of its edges touch or cross"),
            (on_globe(((0.0, 0.0), (50.0, 0.0), (100.0, 0.0))), "encloses no area"),
            (on_globe(ring(201)), "has 201 corners"),
            (on_globe(((0.0, 0.0), (60e3, 0.0), (0.0, 60e3))), "km wide"),
            (GeoArea(((47.0, 8.0), (47.1, 8.0), (95.0, 8.0))), "corner 3: 95/8 is not a latitude"),
            (GeoArea(((47.0, 8.0),), 0.5), "a radius of 0.5 m"),
            (GeoArea(((47.0, 8.0),), -50.0), "a radius of -50 m"),
            (GeoArea(((47.0, 8.0),), 1e6), "a radius of 1e"),
            (GeoArea(((47.0, 8.0),), math.nan), "a radius of nan m"),
            (GeoArea(((0.0, 0.0),), 50.0), "corner 1: 0/0"),
        ],
    )
    def test_one_that_encloses_nothing(self, area: GeoArea, problem: str) -> None:
        for is_inclusion in (True, False):
            with pytest.raises(ValueError, match=r"^polygons") as error:
                fence_of([named(area, "polygons[7]", is_inclusion=is_inclusion)])
            assert problem in str(error.value)

    def test_nothing_or_only_exclusions(self) -> None:
        for areas in ([], [named(on_globe(HOUSE), is_inclusion=False)]):
            with pytest.raises(ValueError, match="no inclusion area"):
                fence_of(areas)

    def test_two_inclusions(self) -> None:
        with pytest.raises(ValueError, match=r"^second: a second inclusion area"):
            fence_of([named(on_globe(SQUARE)), named(on_globe(HOUSE), "second")])

    def test_too_many_corners_together(self) -> None:
        circles = [named(GeoArea(((47.0, 8.0),), 5.0), is_inclusion=False)] * 6
        with pytest.raises(ValueError, match="220 corners in all"):
            fence_of([named(on_globe(SQUARE)), *circles])
        assert len(fence_of([named(on_globe(SQUARE)), *circles[:5]]).exclusions) == 5


def test_what_a_fence_is_made_of_keeps_its_order() -> None:
    house, square = on_globe(HOUSE), on_globe(SQUARE)
    assert fence_of([named(house, is_inclusion=False), named(square)]) == GeoFence(square, (house,))


def test_the_guard_takes_it() -> None:
    local = GeoFence(on_globe(SQUARE), (on_globe(HOUSE),)).local(ZURICH)
    fence = Fence(local.polygon_enu_m, 3.0, local.keep_out_enu_m)
    assert fence.allows((-50.0, 0.0))
    assert not fence.allows((20.0, 20.0))


OURS = LocalFence(SQUARE, (HOUSE,))


class TestDifference:
    @pytest.mark.parametrize(
        "other",
        [
            OURS,
            LocalFence(SQUARE[::-1], (HOUSE[2:] + HOUSE[:2],)),
            LocalFence((SQUARE[0], (0.0, -100.5), *SQUARE[1:]), (HOUSE,)),
            LocalFence(SQUARE, (tuple((e + 0.9, n) for e, n in HOUSE),)),
        ],
    )
    def test_the_same_border_written_otherwise_is_no_difference(self, other: LocalFence) -> None:
        assert difference(OURS, other, 1.0) is None

    def test_a_border_elsewhere_is_reported_with_place_and_distance(self) -> None:
        wider = LocalFence((SQUARE[0], (140.0, -100.0), (140.0, 100.0), SQUARE[3]), (HOUSE,))
        for one, other in ((OURS, wider), (wider, OURS)):
            text = difference(one, other, 1.0)
            assert text is not None
            assert text.startswith("borders up to 40.0 m apart, at ")
        assert difference(OURS, wider, 40.1) is None

    def test_a_dent_between_corners_is_seen(self) -> None:
        dented = LocalFence((*SQUARE[:2], (100.0, -10.0), (60.0, 0.0), (100.0, 10.0), *SQUARE[2:]))
        text = difference(LocalFence(SQUARE), dented, 1.0)
        assert text == "borders up to 40.0 m apart, at 60 m east, 0 m north"

    def test_a_missing_exclusion_is_reported(self) -> None:
        lacking = difference(OURS, LocalFence(SQUARE), 1.0)
        assert (
            lacking == "exclusion at 10 m east, 10 m north: the autopilot's has no such exclusion"
        )
        more = difference(LocalFence(SQUARE), OURS, 1.0)
        assert more == "exclusion at 10 m east, 10 m north: ours has no such exclusion"
        moved = LocalFence(SQUARE, (tuple((e + 5.0, n) for e, n in HOUSE),))
        text = difference(OURS, moved, 1.0)
        assert text is not None
        assert text.endswith("(the nearest is 5.0 m off)")

    def test_one_exclusion_may_not_stand_for_two(self) -> None:
        far = tuple((e - 60.0, n) for e, n in HOUSE)
        text = difference(LocalFence(SQUARE, (HOUSE,)), LocalFence(SQUARE, (HOUSE, far)), 1.0)
        assert text is not None
        assert "ours has no such exclusion" in text

    def test_kilometres_are_compared_in_time(self) -> None:
        long = ring(100, 15e3)
        assert difference(LocalFence(long), LocalFence(long[::-1]), 1.0) is None


CORNERS_DEG: tuple[LatLon, ...] = on_globe(SQUARE).corners_deg


def test_areas_are_values() -> None:
    assert GeoArea(CORNERS_DEG) == GeoArea(CORNERS_DEG)
    assert hash(GeoFence(GeoArea(CORNERS_DEG))) == hash(GeoFence(GeoArea(CORNERS_DEG)))
