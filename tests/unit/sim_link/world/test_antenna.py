"""Output of antennas: geometry without noise, and the law of the noise."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import PositionEnu
from sim_link.world.point_mass import LEVEL, Components, EulerAngles
from sim_link.world.radio_channel import (
    AntennaModelParams,
    Printed,
    bent,
    direction_enu,
    printed,
    seen_by_antenna,
    turned_about_vertical,
)

QUIET = (0.0, 0.0, 0.0)
PLANAR, LINE, TWO_AXIS = (
    AntennaModelParams(kind="planar"),
    AntennaModelParams(kind="line"),
    AntennaModelParams(kind="two_axis"),
)
DOWN = AntennaModelParams(kind="two_axis", mount_deg=(0.0, -90.0, 0.0))
SIGMA_RAD = math.radians(3.0)
ANGLES = st.floats(-math.pi, math.pi)
SLOPES = st.floats(-1.5, 1.5)


def towards(azimuth_deg: float, elevation_deg: float) -> Components:
    """East, north, up of an azimuth clockwise from north."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return (level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation))


def shown(
    direction: Components,
    params: AntennaModelParams,
    attitude: EulerAngles = LEVEL,
    offset: float = 0.0,
) -> Printed:
    u = seen_by_antenna(direction, attitude, params, offset)
    said = printed(u, params, 0.0, QUIET)
    assert said is not None
    return said


def scatter(
    direction: Components, params: AntennaModelParams, of: Callable[[Printed], float]
) -> float:
    """Degrees of standard deviation of what is printed."""
    rng = np.random.default_rng(4)
    u = seen_by_antenna(direction, LEVEL, params, 0.0)
    said = [printed(u, params, SIGMA_RAD, tuple(rng.standard_normal(3))) for _ in range(8000)]
    return float(np.degrees(np.std([of(each) for each in said if each is not None])))


def test_directions_are_unit_vectors() -> None:
    assert direction_enu((1.0, 2.0, 3.0), (1.0, 6.0, 0.0)) == pytest.approx((0.0, 0.8, -0.6))
    assert direction_enu((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)) == (0.0, 0.0, 1.0)


@given(ANGLES, SLOPES)
def test_a_level_planar_array_prints_the_azimuth(azimuth: float, elevation: float) -> None:
    direction = towards(math.degrees(azimuth), math.degrees(elevation))
    said = shown(direction, PLANAR)
    assert math.remainder(said.bearing_rad - azimuth, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert (said.elevation_rad, said.is_array_angle) == (None, False)


@pytest.mark.parametrize("elevation_deg", [0.0, -30.0, -60.0, -75.0])
def test_its_noise_grows_towards_the_nadir(elevation_deg: float) -> None:
    sigma_deg = scatter(towards(0.0, elevation_deg), PLANAR, lambda said: said.bearing_rad)
    law_deg = 3.0 / math.cos(math.radians(elevation_deg))
    assert sigma_deg == pytest.approx(law_deg, rel=0.04)


def test_straight_below_it_prints_anything() -> None:
    sigma_deg = scatter(towards(0.0, -90.0), PLANAR, lambda said: said.bearing_rad)
    assert sigma_deg == pytest.approx(360.0 / math.sqrt(12.0), rel=0.05)


def test_a_line_prints_no_azimuth_below() -> None:
    said = shown(towards(40.0, -60.0), LINE)
    assert math.degrees(said.bearing_rad) == pytest.approx(18.7, abs=0.05)
    assert (said.elevation_rad, said.is_array_angle) == (None, True)
    level = shown(towards(40.0, 0.0), LINE)
    assert math.degrees(level.bearing_rad) == pytest.approx(40.0)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 50.0])
def test_its_noise_grows_along_it(angle_deg: float) -> None:
    sigma_deg = scatter(towards(angle_deg, 0.0), LINE, lambda said: said.bearing_rad)
    assert sigma_deg == pytest.approx(3.0 / math.cos(math.radians(angle_deg)), rel=0.07)


def test_at_its_end_the_noise_is_clamped() -> None:
    said = printed((0.0, 1.0, 0.0), LINE, 1.0, (0.0, 2.0, 0.0))
    assert said is not None
    assert said.bearing_rad == pytest.approx(math.pi / 2)


@given(ANGLES, SLOPES)
def test_what_is_behind_is_printed_as_its_mirror_image(azimuth: float, elevation: float) -> None:
    direction = towards(math.degrees(azimuth), math.degrees(elevation))
    mirror = (direction[0], -direction[1], direction[2])
    for params in (LINE, TWO_AXIS):
        assert shown(direction, params) == pytest.approx(shown(mirror, params))


def test_an_array_that_does_not_fold_hears_no_direction_from_behind() -> None:
    params = msgspec.structs.replace(TWO_AXIS, folds=False)
    assert printed((0.8, 0.0, 0.6), params, 0.0, QUIET) is not None
    assert printed((-0.8, 0.0, 0.6), params, 0.0, QUIET) is None


@pytest.mark.parametrize(("off_deg", "is_heard"), [(0.0, True), (59.0, True), (61.0, False)])
def test_nothing_is_measured_beyond_the_field_of_view(off_deg: float, is_heard: bool) -> None:
    params = msgspec.structs.replace(LINE, field_of_view_deg=120.0)
    off = math.radians(off_deg)
    said = printed((math.cos(off), 0.0, math.sin(off)), params, 0.0, QUIET)
    assert (said is not None) is is_heard


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_two_axes_looking_down_tell_the_direction(right_m: float, forward_m: float) -> None:
    """From 2 m above: right is the antenna's right, ahead of the nose is above its boresight."""
    said = shown(direction_enu((0.0, 0.0, 2.0), (right_m, forward_m, 0.0)), DOWN)
    slant_m = math.hypot(2.0, right_m, forward_m)
    assert said.elevation_rad is not None
    assert math.sin(said.bearing_rad) == pytest.approx(right_m / slant_m, abs=1e-9)
    assert math.sin(said.elevation_rad) == pytest.approx(forward_m / slant_m, abs=1e-9)


def test_their_noise_is_the_same_all_around_the_boresight() -> None:
    for direction in (towards(0.0, -90.0), towards(0.0, -75.0), towards(90.0, -75.0)):
        for of in (lambda said: said.bearing_rad, lambda said: said.elevation_rad or 0.0):
            assert scatter(direction, DOWN, of) == pytest.approx(3.0, rel=0.06)


def test_a_lean_turns_the_azimuth_of_what_is_nearly_below() -> None:
    """The emitter 10 degrees off the nadir ahead, the vehicle rolled by 10 degrees."""
    said = shown(towards(0.0, -80.0), PLANAR, EulerAngles(roll_rad=math.radians(10.0)))
    assert math.degrees(said.bearing_rad) == pytest.approx(45.0, abs=1.0)
    assert shown(towards(0.0, -80.0), PLANAR).bearing_rad == pytest.approx(0.0, abs=1e-12)


@given(ANGLES, st.floats(-0.4, 0.4))
def test_the_vehicles_heading_and_the_mount_come_off(yaw: float, offset: float) -> None:
    """An offset, counter-clockwise positive, takes from what is counted clockwise."""
    params = msgspec.structs.replace(PLANAR, mount_deg=(0.0, 0.0, 25.0))
    said = shown(towards(70.0, -20.0), params, EulerAngles(yaw_rad=yaw), offset)
    expected = math.radians(70.0 - 25.0) - yaw - offset
    assert math.remainder(said.bearing_rad - expected, math.tau) == pytest.approx(0.0, abs=1e-9)


@given(ANGLES, SLOPES, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_bend_is_an_angle_in_space(azimuth: float, slope: float, aside: float, up: float) -> None:
    direction = towards(math.degrees(azimuth), math.degrees(slope))
    turned = bent(direction, aside, up)
    assert math.hypot(*turned) == pytest.approx(1.0)
    cosine = sum(a * b for a, b in zip(direction, turned, strict=True))
    assert cosine == pytest.approx(math.cos(math.hypot(aside, up)), abs=1e-9)


@pytest.mark.parametrize("elevation_deg", [0.0, -60.0])
def test_it_turns_the_azimuth_by_more_near_the_nadir(elevation_deg: float) -> None:
    east, north, _ = bent(towards(90.0, elevation_deg), 0.01, 0.0)
    turn = math.atan2(north, east)  # counter-clockwise
    assert turn == pytest.approx(0.01 / math.cos(math.radians(elevation_deg)), rel=0.001)
    assert bent(towards(90.0, -10.0), 0.0, 0.01)[2] > towards(90.0, -10.0)[2]


def test_straight_below_any_side_is_aside() -> None:
    below: PositionEnu = (0.0, 0.0, -1.0)
    assert bent(below, 0.0, 0.0) == below
    assert bent(below, 0.1, 0.0)[2] == pytest.approx(-math.cos(0.1))


def test_a_turn_about_the_vertical_keeps_the_elevation() -> None:
    direction = towards(90.0, -50.0)
    turned = turned_about_vertical(direction, math.radians(30.0))
    assert turned == pytest.approx(towards(60.0, -50.0))
