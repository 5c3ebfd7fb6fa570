"""The true track of a flight of any length is kept in bounded room."""

from __future__ import annotations

import numpy as np
import pytest

from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.vehicle import MAX_TRACK_POINTS, TRACK_PERIOD_S, FlightRecorder, SimVehicle


def recorded(seconds: float) -> FlightRecorder:
    vehicle, recorder = SimVehicle(Scenario(), np.random.default_rng(1)), FlightRecorder()
    for step in range(round(seconds / TRACK_PERIOD_S)):
        vehicle.aircraft.time_s = step * TRACK_PERIOD_S
        recorder.take(vehicle)
    return recorder


def test_a_short_flight_has_two_points_a_second() -> None:
    times = [point[0] for point in recorded(60.0).track]
    assert np.diff(times) == pytest.approx(TRACK_PERIOD_S)
    assert len(times) == 120


def test_a_long_flight_is_kept_whole_and_coarser() -> None:
    seconds = 3.4 * MAX_TRACK_POINTS * TRACK_PERIOD_S
    track = recorded(seconds).track
    times = [point[0] for point in track]
    assert MAX_TRACK_POINTS // 2 < len(track) <= MAX_TRACK_POINTS
    assert times[0] == 0.0
    assert times[-1] > seconds - 4.0 * TRACK_PERIOD_S - 1.0
    assert np.diff(times) == pytest.approx(4.0 * TRACK_PERIOD_S)
