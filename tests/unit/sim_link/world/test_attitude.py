"""Turned frames, and how a multicopter leans."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import PositionEnu
from sim_link.world.point_mass import (
    DRAG_PER_S,
    LEVEL,
    EulerAngles,
    MulticopterParams,
    PointMass,
    WindParams,
    leaning,
    seen_from,
)

STEP_S = 0.02
ANGLES = st.floats(-3.0, 3.0)


def hovering(wind: WindParams, drag_per_s: float | None = None) -> PointMass:
    body = PointMass(MulticopterParams(drag_per_s=drag_per_s), wind, (0.0, 0.0, 50.0))
    for _ in range(200):
        drift = 0.1 * wind.east_mps, 0.1 * wind.north_mps
        body.step((-drift[0], -drift[1], 0.0), None, STEP_S)
    return body


def test_a_level_frame_sees_what_is_there() -> None:
    assert seen_from(LEVEL, (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("attitude", "outer", "seen"),
    [
        (EulerAngles(yaw_rad=math.pi / 2), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),  # east, nose to it
        (EulerAngles(yaw_rad=math.pi / 2), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),  # north is left
        (EulerAngles(pitch_rad=-math.pi / 2), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),  # nose down
        (EulerAngles(pitch_rad=0.1), (0.0, 0.0, -1.0), (math.sin(0.1), 0.0, -math.cos(0.1))),
        (EulerAngles(roll_rad=0.1), (0.0, 0.0, 1.0), (0.0, math.sin(0.1), math.cos(0.1))),
    ],
)
def test_yaw_is_clockwise_pitch_lifts_the_nose_roll_sinks_the_right(
    attitude: EulerAngles, outer: PositionEnu, seen: PositionEnu
) -> None:
    assert seen_from(attitude, outer) == pytest.approx(seen, abs=1e-12)


@given(ANGLES, ANGLES, ANGLES, st.tuples(ANGLES, ANGLES, ANGLES))
def test_lengths_stay(roll: float, pitch: float, yaw: float, vector: PositionEnu) -> None:
    seen = seen_from(EulerAngles(roll, pitch, yaw), vector)
    assert math.hypot(*seen) == pytest.approx(math.hypot(*vector), abs=1e-9)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, -2.5])
def test_the_thrust_points_along_the_bodys_vertical(yaw_rad: float) -> None:
    """Seen from the leaning body, gravity and acceleration together are straight down."""
    forward, right, gravity = 1.4, -0.9, 9.80665
    roll, pitch = leaning(forward, right, gravity)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    north, east = forward * cos - right * sin, forward * sin + right * cos
    seen = seen_from(EulerAngles(roll, pitch, yaw_rad), (-north, -east, gravity))
    assert seen[:2] == pytest.approx((0.0, 0.0), abs=0.01)


def test_still_air_leaves_the_attitude_of_the_acceleration_alone() -> None:
    body = PointMass(MulticopterParams(), WindParams(), (0.0, 0.0, 50.0))
    body.step((5.0, 0.0, 0.0), None, STEP_S)
    assert body.attitude.roll_rad == pytest.approx(math.atan2(4.0, 9.80665))
    for _ in range(500):
        body.step((5.0, 0.0, 0.0), None, STEP_S)
    assert body.attitude.roll_rad == pytest.approx(0.0, abs=1e-6)


def test_ten_metres_a_second_of_wind_lean_it_by_ten_degrees_into_the_wind() -> None:
    roll, pitch, _ = hovering(WindParams(east_mps=10.0)).attitude
    assert math.degrees(roll) == pytest.approx(-10.0, abs=0.5)
    assert pitch == pytest.approx(0.0, abs=1e-6)
    roll, pitch, _ = hovering(WindParams(north_mps=10.0)).attitude
    assert math.degrees(pitch) == pytest.approx(10.0, abs=0.5)  # wind from behind: nose up
    assert roll == pytest.approx(0.0, abs=1e-6)


def test_flying_with_the_wind_it_does_not_lean() -> None:
    body = PointMass(
        MulticopterParams(), WindParams(east_mps=5.0, let_through=0.0), (0.0, 0.0, 50.0)
    )
    for _ in range(500):
        body.step((5.0, 0.0, 0.0), None, STEP_S)
    assert body.attitude.roll_rad == pytest.approx(0.0, abs=1e-4)


def test_the_drag_that_is_given_counts_in_still_air_too() -> None:
    body = PointMass(MulticopterParams(drag_per_s=DRAG_PER_S), WindParams(), (0.0, 0.0, 50.0))
    for _ in range(500):
        body.step((0.0, 10.0, 0.0), None, STEP_S)
    assert math.degrees(body.attitude.pitch_rad) == pytest.approx(-10.0, abs=0.5)
    assert hovering(WindParams(east_mps=10.0), 0.0).attitude[:2] == pytest.approx((0, 0), abs=1e-6)


def test_on_the_ground_it_stands_level() -> None:
    body = PointMass(MulticopterParams(), WindParams(east_mps=12.0), (0.0, 0.0, 0.0))
    body.step(None, None, STEP_S)
    assert body.attitude == LEVEL
