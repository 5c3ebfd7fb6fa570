from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.geometry.coordinates import (
    LocalOrigin,
    bearing_enu_from_ned,
    bearing_ned_from_enu,
    enu_from_ned,
    ned_from_enu,
    wrap_pi,
)

_metres = st.floats(-1e5, 1e5)
_triples = st.tuples(_metres, _metres, _metres)
_angles = st.floats(-50.0, 50.0)


def test_north_is_the_second_of_enu_and_down_is_minus_up() -> None:
    assert ned_from_enu((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert enu_from_ned((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)


@given(_triples)
def test_ned_and_enu_are_inverse(triple: tuple[float, float, float]) -> None:
    assert enu_from_ned(ned_from_enu(triple)) == triple


@pytest.mark.parametrize(
    ("heading_deg", "enu_deg"), [(0, 90), (90, 0), (180, -90), (270, 180), (45, 45), (-90, 180)]
)
def test_compass_directions(heading_deg: float, enu_deg: float) -> None:
    assert bearing_enu_from_ned(math.radians(heading_deg)) == pytest.approx(math.radians(enu_deg))


@given(_angles)
def test_bearings_are_inverse(angle_rad: float) -> None:
    there_and_back = bearing_ned_from_enu(bearing_enu_from_ned(angle_rad))
    assert abs(wrap_pi(there_and_back - angle_rad)) < 1e-12


@given(_angles)
def test_a_wrapped_angle_is_the_same_direction_in_the_half_open_circle(angle_rad: float) -> None:
    wrapped = wrap_pi(angle_rad)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle_rad), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle_rad), abs=1e-9)


@pytest.mark.parametrize("angle_rad", [math.pi, -math.pi, 3 * math.pi, -3 * math.pi])
def test_half_a_turn_is_always_plus_pi(angle_rad: float) -> None:
    assert wrap_pi(angle_rad) == pytest.approx(math.pi)
    assert wrap_pi(angle_rad) > 0.0


@given(
    st.floats(-80.0, 80.0),
    st.floats(-180.0, 180.0),
    st.tuples(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3), st.floats(-100.0, 500.0)),
)
def test_a_local_point_survives_the_way_to_latitude_and_longitude(
    latitude_deg: float, longitude_deg: float, point_enu_m: tuple[float, float, float]
) -> None:
    origin = LocalOrigin(latitude_deg, longitude_deg, 488.0)
    back = origin.enu_from_geodetic(*origin.geodetic_from_enu(point_enu_m))
    assert math.dist(back, point_enu_m) < 1e-4
