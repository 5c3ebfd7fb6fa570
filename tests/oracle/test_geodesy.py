"""Local coordinates against geographiclib's geodesics on the same ellipsoid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic

from companion.domain import Autopilot
from companion.geometry.coordinates import LocalOrigin, Projection, wrap_pi

EARTH_RADIUS_M = 6_371_000.0

POSITIONS_DEG = [
    (47.397742, 8.545594),  # Zurich
    (0.0, 0.0),
    (-33.86, 151.21),
    (64.15, -21.94),
    (-54.8, -68.3),
    (12.0, 179.9999),  # the date line inside the area
]


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), POSITIONS_DEG)
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


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), POSITIONS_DEG)
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


def on_sphere(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Return the unit vector of a position on a sphere."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    return np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), POSITIONS_DEG)
@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 90.0, 180.0, 225.0, 300.0])
@pytest.mark.parametrize("distance_m", [1.0, 150.0, 1000.0, 20_000.0])
def test_px4_keeps_distance_and_direction_from_the_origin_on_its_sphere(
    latitude_deg: float, longitude_deg: float, azimuth_deg: float, distance_m: float
) -> None:
    """Azimuthal equidistant: the great circle's length and first azimuth, found with vectors."""
    origin = LocalOrigin(latitude_deg, longitude_deg, 0.0, Projection.SPHERE)
    azimuth = math.radians(azimuth_deg)
    east_m, north_m = distance_m * math.sin(azimuth), distance_m * math.cos(azimuth)
    lat, lon, alt_m = origin.geodetic_from_enu((east_m, north_m, 12.0))
    start, end = on_sphere(latitude_deg, longitude_deg), on_sphere(lat, lon)
    pole = np.array([0.0, 0.0, 1.0])
    east = np.cross(pole, start)
    east /= np.linalg.norm(east)
    north = np.cross(start, east)
    angle = math.atan2(float(np.linalg.norm(np.cross(start, end))), float(start @ end))
    assert EARTH_RADIUS_M * angle == pytest.approx(distance_m, rel=1e-6)
    off_rad = wrap_pi(math.atan2(float(end @ east), float(end @ north)) - azimuth)
    assert off_rad == pytest.approx(0.0, abs=1e-6)
    assert alt_m == 12.0
    assert origin.enu_from_geodetic(lat, lon, alt_m) == pytest.approx(
        (east_m, north_m, 12.0), abs=1e-6
    )


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), POSITIONS_DEG)
def test_ardupilot_counts_degrees(latitude_deg: float, longitude_deg: float) -> None:
    """0.0111319 m a unit of 1e-7 degrees; east by the cosine of the latitude in the middle."""
    origin = LocalOrigin(latitude_deg, longitude_deg, 100.0, Projection.FLAT)
    for north_e7, east_e7 in ((1000, 0), (90_000, -70_000), (-50_000, 120_000)):
        lat, lon = latitude_deg + north_e7 * 1e-7, longitude_deg + east_e7 * 1e-7
        cosine = math.cos(math.radians(latitude_deg + north_e7 * 0.5e-7))
        enu_m = (0.011131884502145034 * east_e7 * cosine, 0.011131884502145034 * north_e7, 3.0)
        assert origin.enu_from_geodetic(lat, lon, 103.0) == pytest.approx(enu_m, abs=1e-6)
        position = origin.geodetic_from_enu(enu_m)
        off_deg = math.remainder(position[1] - lon, 360.0)
        assert (position[0] - lat, off_deg) == pytest.approx((0.0, 0.0), abs=1e-11)
        assert -180.0 <= position[1] <= 180.0


def test_px4_is_off_the_ellipsoid_as_it_was_seen_to_be() -> None:
    """LOCAL and GLOBAL_POSITION_INT of PX4 1.15.2 by WGS84: 0.36 m apart at 124 m."""
    px4 = LocalOrigin(47.397742, 8.545594, 488.0, Autopilot.PX4.projection)
    ellipsoid = LocalOrigin(47.397742, 8.545594, 488.0)
    shown = px4.geodetic_from_enu((120.0, 30.0, 20.0))
    off_m = math.dist(ellipsoid.enu_from_geodetic(*shown)[:2], (120.0, 30.0))
    assert off_m == pytest.approx(0.36, abs=0.01)


@pytest.mark.parametrize("projection", Projection)
def test_what_pairs_showed_beyond_the_projection_is_kept_both_ways(projection: Projection) -> None:
    origin = LocalOrigin(47.4, 8.5, 488.0, projection, (2.0, -1.0, 0.5), (1.002, 0.999))
    position = origin.geodetic_from_enu((300.0, -400.0, 20.0))
    assert origin.enu_from_geodetic(*position) == pytest.approx((300.0, -400.0, 20.0), abs=1e-6)
    plain = LocalOrigin(47.4, 8.5, 488.0, projection).enu_from_geodetic(*position)
    assert plain == pytest.approx((298.0 / 1.002, -399.0 / 0.999, 19.5), abs=1e-6)
