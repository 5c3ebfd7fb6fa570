from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import Attitude, PositionEnu, VehicleState
from companion.guidance.vehicle_track import (
    HISTORY_S,
    MAX_EXTRAPOLATION_S,
    MAX_GAP_S,
    VehicleTrack,
    is_plausible,
)


def _state(
    time_s: float,
    position_enu_m: PositionEnu = (0.0, 0.0, 20.0),
    velocity_enu_mps: PositionEnu = (0.0, 0.0, 0.0),
) -> VehicleState:
    return VehicleState(time_s, position_enu_m, velocity_enu_mps)


def _track(*states: VehicleState) -> VehicleTrack:
    track = VehicleTrack()
    for state in states:
        track.add(state)
    return track


def yaw_at(track: VehicleTrack, time_s: float) -> float | None:
    attitude = track.attitude_at(time_s)
    return None if attitude is None else attitude.yaw_ned_rad


def _turning(*yaws: tuple[float, float]) -> VehicleTrack:
    track = VehicleTrack()
    for time_s, yaw_ned_rad in yaws:
        track.add_attitude(time_s, Attitude(yaw_ned_rad))
    return track


def test_an_empty_track_knows_nothing() -> None:
    track = VehicleTrack()
    assert track.latest is None
    assert track.position_at(0.0) is None
    assert yaw_at(track, 0.0) is None


def test_between_two_states_it_interpolates() -> None:
    track = _track(_state(10.0, (0.0, 10.0, 20.0)), _state(10.5, (4.0, 8.0, 21.0)))
    assert track.position_at(10.125) == pytest.approx((1.0, 9.5, 20.25))
    assert track.position_at(10.0) == (0.0, 10.0, 20.0)
    assert track.position_at(10.5) == (4.0, 8.0, 21.0)


@given(st.floats(100.0, 102.0), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
def test_a_straight_flight_is_known_exactly(time_s: float, ve: float, vn: float) -> None:
    states = (
        _state(t, (ve * (t - 100.0), vn * (t - 100.0), 20.0), (ve, vn, 0.0))
        for t in (100.0, 100.4, 101.1, 101.7, 101.8)
    )
    expected = (ve * (time_s - 100.0), vn * (time_s - 100.0), 20.0)
    assert _track(*states).position_at(time_s) == pytest.approx(expected, abs=1e-9)


def test_a_little_beyond_the_newest_it_goes_on_by_the_velocity() -> None:
    track = _track(_state(10.0, (1.0, 2.0, 20.0), (5.0, -2.0, 1.0)))
    assert track.position_at(10.2) == pytest.approx((2.0, 1.6, 20.2))
    assert track.position_at(10.0 + MAX_EXTRAPOLATION_S - 1e-6) is not None
    assert track.position_at(10.0 + MAX_EXTRAPOLATION_S + 1e-6) is None


def test_before_the_oldest_it_does_not_guess() -> None:
    assert _track(_state(10.0), _state(10.1)).position_at(9.999) is None


def test_a_gap_is_not_bridged() -> None:
    track = _track(_state(10.0), _state(10.0 + MAX_GAP_S + 0.01), _state(11.5))
    assert track.position_at(10.5) is None
    assert track.position_at(11.2) is not None
    assert _track(_state(10.0), _state(10.0 + MAX_GAP_S)).position_at(10.5) is not None


def test_a_state_that_comes_late_or_twice_is_ignored() -> None:
    track = _track(_state(10.0), _state(10.2, (2.0, 0.0, 20.0)))
    track.add(_state(10.1, (50.0, 0.0, 20.0)))
    track.add(_state(10.2, (50.0, 0.0, 20.0)))
    assert track.position_at(10.1) == pytest.approx((1.0, 0.0, 20.0))
    assert track.latest == _state(10.2, (2.0, 0.0, 20.0))


def test_only_the_last_seconds_are_remembered() -> None:
    track = _track(*(_state(0.5 * step) for step in range(100)))
    newest_s = 0.5 * 99
    assert track.position_at(newest_s - HISTORY_S) is not None
    assert track.position_at(newest_s - HISTORY_S - 0.01) is None
    for step in range(100):
        track.add_attitude(0.5 * step, Attitude(0.0))
    assert yaw_at(track, newest_s - HISTORY_S) is not None
    assert yaw_at(track, newest_s - HISTORY_S - 0.01) is None


def test_a_cleared_track_starts_again_even_at_an_earlier_time() -> None:
    track = _track(_state(1000.0))
    track.add_attitude(1000.0, Attitude(1.0))
    track.clear()
    assert track.latest is None
    assert yaw_at(track, 1000.0) is None
    track.add(_state(5.0))
    track.add_attitude(5.0, Attitude(2.0))
    assert track.position_at(5.0) == (0.0, 0.0, 20.0)
    assert yaw_at(track, 5.0) == 2.0


@pytest.mark.parametrize(
    ("before_deg", "after_deg", "between_deg"),
    [(0.0, 40.0, 10.0), (40.0, 0.0, 30.0), (170.0, -150.0, 180.0), (-170.0, 150.0, -180.0)],
)
def test_headings_turn_the_short_way(
    before_deg: float, after_deg: float, between_deg: float
) -> None:
    track = _turning((10.0, math.radians(before_deg)), (10.4, math.radians(after_deg)))
    found_rad = yaw_at(track, 10.1)
    assert found_rad is not None
    assert -math.pi < found_rad <= math.pi
    off_deg = math.remainder(math.degrees(found_rad) - between_deg, 360.0)
    assert off_deg == pytest.approx(0.0, abs=1e-9)


def test_headings_have_the_same_limits_as_positions() -> None:
    track = _turning((10.0, 1.0), (10.1, 2.0), (10.05, 3.0), (10.1, 3.0))
    assert yaw_at(track, 9.9) is None
    assert yaw_at(track, 10.05) == pytest.approx(1.5)
    assert yaw_at(track, 10.1 + MAX_EXTRAPOLATION_S - 1e-6) == 2.0
    assert yaw_at(track, 10.1 + MAX_EXTRAPOLATION_S + 1e-6) is None
    track.add_attitude(10.1 + MAX_GAP_S + 0.01, Attitude(2.0))
    assert yaw_at(track, 10.6) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e9])
@pytest.mark.parametrize("axis", range(3))
def test_states_that_mean_nothing_are_reported_from_others(axis: int, value: float) -> None:
    numbers = [0.0, 0.0, 0.0]
    numbers[axis] = value
    bad = (numbers[0], numbers[1], numbers[2])
    assert is_plausible(_state(0.0))
    assert not is_plausible(_state(0.0, bad))
    assert not is_plausible(_state(0.0, velocity_enu_mps=bad))


def test_roll_and_pitch_are_those_between_two_reports() -> None:
    track = VehicleTrack()
    track.add_attitude(10.0, Attitude(3.1, (0.1, -0.2)))
    track.add_attitude(10.1, Attitude(-3.1, (0.3, 0.2)))
    attitude = track.attitude_at(10.05)
    assert attitude is not None
    assert attitude.tilt_rad == pytest.approx((0.2, 0.0))
    assert math.cos(attitude.yaw_ned_rad) == pytest.approx(-1.0)


def test_a_tilt_that_is_not_reported_leaves_the_yaw_known() -> None:
    track = VehicleTrack()
    track.add_attitude(10.0, Attitude(1.0))
    track.add_attitude(10.1, Attitude(1.2, (0.3, 0.2)))
    attitude = track.attitude_at(10.05)
    assert attitude is not None
    assert attitude.tilt_rad is None
    assert attitude.yaw_ned_rad == pytest.approx(1.1)
