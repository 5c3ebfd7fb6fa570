"""Detection of a jump of the vehicle's own navigation."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import Attitude, PositionEnu, VehicleState
from companion.guard.gate import Motion
from companion.guidance.events import VehicleMoved
from companion.guidance.health.position_jumps import (
    MAX_ACCELERATION_MPS2,
    MAX_GAP_S,
    may_breach,
    position_jump_m,
    yaw_jump_rad,
)
from companion.guidance.vehicle_track import VehicleTrack
from tests.unit.companion.guard.gate_helpers import HOME, LIMITS
from tests.unit.companion.guidance.scripted import ScriptedFlight


def state(
    time_s: float, position: PositionEnu, speed: PositionEnu = (0.0, 0.0, 0.0)
) -> VehicleState:
    return VehicleState(time_s, position, speed)


@pytest.mark.parametrize("step_m", [0.7, 1.0, 7.0, 50.0])
@pytest.mark.parametrize("dt_s", [0.02, 0.1, 0.25])
def test_a_step_that_no_velocity_explains_is_a_jump(step_m: float, dt_s: float) -> None:
    before = state(10.0, (0.0, 0.0, 20.0), (5.0, 0.0, 0.0))
    after = state(10.0 + dt_s, (5.0 * dt_s, step_m, 20.0), (5.0, 0.0, 0.0))
    assert position_jump_m(before, after) == pytest.approx((0.0, step_m, 0.0))


@given(st.integers(0, 2**32 - 1), st.floats(0.01, MAX_GAP_S), st.floats(0.0, 0.07))
def test_no_flight_is_one_however_it_is_flown_and_however_rarely_it_is_reported(
    seed: int, gap_s: float, noise_m: float
) -> None:
    rng = np.random.default_rng(seed)
    dt_s, position, speed = gap_s / 20.0, np.zeros(3), rng.uniform(-15.0, 15.0, 3)
    last = state(0.0, (0.0, 0.0, 0.0), (float(speed[0]), float(speed[1]), float(speed[2])))
    for step in range(1, 101):
        push = rng.normal(size=3)
        push *= MAX_ACCELERATION_MPS2 * rng.random() / np.linalg.norm(push)
        position, speed = position + dt_s * (speed + 0.5 * dt_s * push), speed + dt_s * push
        if step % 20 == 0:
            reported = position + np.clip(noise_m * rng.normal(size=3), -0.14, 0.14)
            now = VehicleState(
                step * dt_s,
                (float(reported[0]), float(reported[1]), float(reported[2])),
                (float(speed[0]), float(speed[1]), float(speed[2])),
            )
            assert position_jump_m(last, now) is None
            last = now


def watched(noise_m: float, step_m: float = 0.0) -> list[Mapping[str, object]]:
    """Return jumps found in a minute at rest, reported at 20 Hz, with a jump after half of it."""
    flight = ScriptedFlight().ready()
    flight.has_position = flight.has_ranging = False
    rng = np.random.default_rng(1)
    for number in range(1200):
        flight.fly(0.05)
        east, north, up = (noise_m * rng.normal(size=3)).tolist()
        position = (east + (step_m if number >= 600 else 0.0), north, 20.0 + up)
        flight.give(VehicleMoved(flight.now_s, state(flight.now_s, position)))
    return flight.records("own_jump")


@pytest.mark.parametrize("noise_m", [0.0, 0.03, 0.1])
def test_positions_that_are_noisy_all_the_time_do_not_jump(noise_m: float) -> None:
    assert watched(noise_m) == []


@pytest.mark.parametrize(("noise_m", "step_m"), [(0.0, 0.6), (0.03, 1.0), (0.1, 2.0)])
def test_a_jump_is_found_in_the_noise(noise_m: float, step_m: float) -> None:
    assert len(watched(noise_m, step_m)) == 1


def test_after_a_long_gap_nothing_is_compared() -> None:
    before, after = state(0.0, (0.0, 0.0, 0.0)), state(MAX_GAP_S + 0.1, (80.0, 0.0, 0.0))
    assert position_jump_m(before, after) is None
    assert position_jump_m(before, state(-0.1, (80.0, 0.0, 0.0))) is None
    assert yaw_jump_rad((0.0, 0.0), (MAX_GAP_S + 0.1, 3.0)) is None


@pytest.mark.parametrize("turn_deg", [30.0, -30.0, 170.0])
@pytest.mark.parametrize("from_deg", [0.0, 175.0])
def test_a_heading_that_turns_at_once_is_a_jump(turn_deg: float, from_deg: float) -> None:
    from_rad, turn_rad = math.radians(from_deg), math.radians(turn_deg)
    jump = yaw_jump_rad((1.0, from_rad), (1.1, from_rad + turn_rad))
    assert jump == pytest.approx(turn_rad)


@given(st.floats(0.01, MAX_GAP_S), st.floats(-1.0, 1.0))
def test_a_vehicle_that_turns_as_fast_as_it_can_does_not_jump(dt_s: float, share: float) -> None:
    turn_rad = share * math.radians(120.0) * dt_s
    assert yaw_jump_rad((0.0, 3.0), (dt_s, 3.0 + turn_rad)) is None


def test_the_past_moves_along_and_the_time_about_the_jump_is_not_trusted() -> None:
    track = VehicleTrack()
    track.add(state(10.0, (0.0, 0.0, 20.0)))
    track.add_attitude(10.0, Attitude(3.0))
    track.shift((7.0, -1.0, 2.0))
    track.turn(0.5)
    track.add(state(10.1, (7.0, -1.0, 22.0)))
    assert track.position_at(10.05) == pytest.approx((7.0, -1.0, 22.0))
    track.exclude(10.0, 12.1)
    assert track.position_at(10.05) is None
    attitude = track.attitude_at(10.0)
    assert attitude is not None
    assert attitude.yaw_ned_rad == pytest.approx(3.5 - 2.0 * math.pi)
    assert track.is_trusted_at(10.0)
    assert not track.is_trusted_at(10.05)
    assert not track.is_trusted_at(12.0)
    assert track.is_trusted_at(12.1)
    track.exclude(11.0, 13.0)
    assert not track.is_trusted_at(10.05)
    track.exclude(20.0, 22.0)
    assert track.is_trusted_at(12.5)


@pytest.mark.parametrize(
    ("position", "jump_m", "breaches"),
    [
        ((90.0, 0.0, 30.0), (80.0, 0.0, 0.0), False),
        ((101.0, 0.0, 30.0), (80.0, 0.0, 0.0), True),
        ((99.0, 0.0, 30.0), (80.0, 0.0, 0.0), False),
        ((150.0, 0.0, 30.0), (4.9, 0.0, 4.0), False),
        ((150.0, 0.0, 30.0), (3.0, 4.1, 0.0), True),
        ((0.0, 0.0, 30.0), (0.0, 0.0, 5.0), False),
        ((0.0, 0.0, 30.0), (0.0, 0.0, 5.1), True),
        ((0.0, 0.0, 70.0), (0.0, 0.0, 5.0), False),
        ((0.0, 0.0, 70.1), (0.0, 0.0, 5.0), True),
        ((0.0, 0.0, 90.0), (9.0, 0.0, -2.9), False),
        ((0.0, 0.0, 14.5), (0.0, 0.0, -3.1), True),
    ],
)
def test_what_may_be_flown_by_a_position_that_jumped(
    position: PositionEnu, jump_m: PositionEnu, *, breaches: bool
) -> None:
    """Back inside the margin (5 m), or 3 sigma in height (3 m); no lower than the floor (5 m)."""
    assert may_breach(LIMITS, Motion(position, (0.0, 0.0, 0.0), HOME), jump_m) is breaches
