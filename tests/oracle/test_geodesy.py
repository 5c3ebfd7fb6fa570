"""Local coordinates against geographiclib's geodesics on the same ellipsoid."""

from __future__ import annotations

import math

import pytest
from geographiclib.geodesic import Geodesic

from companion.geometry.coordinates import LocalOrigin, wrap_pi

EARTH_RADIUS_M = 6_371_000.0

PLACES = [
    (47.397742, 8.545594),  # Zurich
    (0.0, 0.0),
    (-33.86, 151.21),
    (64.15, -21.94),
    (-54.8, -68.3),
    (12.0, 179.9999),  # the date line inside the area
]


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), PLACES)
@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 90.0, 180.0, 225.0, 300.0])
@pytest.mark.parametrize("distance_m", [1.0, 150.0, 2000.0])
def test_distance_and_direction_are_those_of_the_geodesic(
    latitude_deg: float, longitude_deg: float, azimuth_deg: float, distance_m: float
) -> None:
    end = Geodesic.WGS84.Direct(latitude_deg, longitude_deg, azimuth_deg, distance_m)
    origin = LocalOrigin(latitude_deg, longitude_deg, 0.0)
    east_m, north_m, up_m = origin.enu_from_geodetic(end["lat2"], end["lon2"], 0.0)
    assert math.hypot(east_m, north_m) == pytest.approx(distance_m, rel=1e-6)
    off_rad = wrap_pi(math.atan2(east_m, north_m) - math.radians(azimuth_deg))
    assert math.degrees(off_rad) == pytest.approx(0.0, abs=1e-4)
    # The plane touches the ellipsoid at the origin and leaves it with the square of the distance.
    assert up_m == pytest.approx(-(distance_m**2) / (2.0 * EARTH_RADIUS_M), abs=0.005)


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), PLACES)
def test_a_local_point_has_the_geodesic_distance_from_the_origin(
    latitude_deg: float, longitude_deg: float
) -> None:
    origin = LocalOrigin(latitude_deg, longitude_deg, 0.0)
    found_deg = origin.geodetic_from_enu((300.0, -400.0, 0.0))
    inverse = Geodesic.WGS84.Inverse(latitude_deg, longitude_deg, found_deg[0], found_deg[1])
    assert inverse["s12"] == pytest.approx(500.0, rel=1e-6)


def test_altitude_is_up() -> None:
    origin = LocalOrigin(47.397742, 8.545594, 488.0)
    east_m, north_m, up_m = origin.enu_from_geodetic(47.397742, 8.545594, 588.0)
    assert (east_m, north_m, up_m) == pytest.approx((0.0, 0.0, 100.0), abs=1e-6)
