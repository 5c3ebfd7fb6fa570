"""The true channel: offsets, obstruction and noise, by their statistics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from sim_link.world.radio_channel import MIN_RANGE_M, ChannelDraw, ChannelParams, RadioChannel
from sim_link.world.target import Emitter, EmitterParams

SAMPLES = 20_000
QUIET = ChannelParams(p_nlos=0.0, range_sigma_m=0.0, bearing_sigma_deg=0.0)


@pytest.fixture(scope="module")
def draws() -> list[ChannelDraw]:
    channel = RadioChannel(ChannelParams(), np.random.default_rng(11))
    return [channel.draw() for _ in range(SAMPLES)]


def measure(params: ChannelParams, seed: int, count: int) -> list[RangingMeasurement]:
    channel = RadioChannel(params, np.random.default_rng(seed))
    return [
        channel.measure(Emitter(EmitterParams()), (10.0, 10.0, 20.0), 0.0) for _ in range(count)
    ]


def test_nine_measurements_of_ten_are_obstructed(draws: list[ChannelDraw]) -> None:
    assert np.mean([draw.is_nlos for draw in draws]) == pytest.approx(0.9, abs=0.01)


def test_range_bias_is_exponential_and_never_negative(draws: list[ChannelDraw]) -> None:
    biases = np.array([draw.range_bias_m for draw in draws if draw.is_nlos])
    assert biases.min() >= 0.0
    assert biases.mean() == pytest.approx(8.0, rel=0.03)
    assert biases.std() == pytest.approx(8.0, rel=0.04)
    assert np.median(biases) == pytest.approx(8.0 * math.log(2.0), rel=0.04)


def test_bearing_bias_is_symmetric(draws: list[ChannelDraw]) -> None:
    biases = np.degrees([draw.bearing_bias_rad for draw in draws if draw.is_nlos])
    assert biases.mean() == pytest.approx(0.0, abs=0.15)
    assert biases.std() == pytest.approx(5.0, rel=0.03)


def test_an_open_path_has_no_bias_in_either_modality(draws: list[ChannelDraw]) -> None:
    for draw in draws:
        assert (draw.range_bias_m > 0.0) == (draw.bearing_bias_rad != 0.0) == draw.is_nlos


def test_thermal_noise_is_always_there(draws: list[ChannelDraw]) -> None:
    assert np.std([draw.range_noise_m for draw in draws]) == pytest.approx(1.5, rel=0.03)
    bearing_noise = np.degrees([draw.bearing_noise_rad for draw in draws])
    assert bearing_noise.std() == pytest.approx(2.0, rel=0.03)
    ranges = [draw.range_noise_m for draw in draws]
    assert abs(float(np.corrcoef(ranges, bearing_noise)[0, 1])) < 0.03


def test_without_chance_only_the_offsets_remain() -> None:
    (measurement,) = measure(QUIET, 1, 1)
    assert measurement.range_m == pytest.approx(math.sqrt(40**2 + 40**2 + 20**2) + 1.5)
    assert measurement.bearing_enu_rad == pytest.approx(math.radians(45.0 - 3.0))


def test_does_not_tell_whether_the_path_was_obstructed() -> None:
    for measurement in measure(ChannelParams(), 1, 50):
        assert measurement.line_of_sight is None
        assert measurement.quality is None
        assert measurement.range_sigma_m == 1.5
        assert measurement.bearing_sigma_rad == pytest.approx(math.radians(2.0))


def test_measured_ranges_stay_positive() -> None:
    channel = RadioChannel(ChannelParams(range_offset_m=-500.0), np.random.default_rng(1))
    measurement = channel.measure(Emitter(EmitterParams()), (50.0, 50.0, 10.0), 0.0)
    assert measurement.range_m == MIN_RANGE_M


def test_bearings_wrap() -> None:
    emitter = Emitter(EmitterParams(position_enu_m=(-50.0, -0.1)))
    channel = RadioChannel(ChannelParams(bearing_offset_deg=-10.0), np.random.default_rng(1))
    for _ in range(200):
        bearing = channel.measure(emitter, (0.0, 0.0, 10.0), 0.0).bearing_enu_rad
        assert bearing is not None
        assert -math.pi < bearing <= math.pi


def test_the_same_seed_measures_the_same() -> None:
    assert measure(ChannelParams(), 7, 100) == measure(ChannelParams(), 7, 100)
    assert measure(ChannelParams(), 7, 100) != measure(ChannelParams(), 8, 100)


def test_scenarios_share_their_random_numbers() -> None:
    """Other parameters scale the same draws, so that differences between runs are paired."""
    always = measure(ChannelParams(p_nlos=1.0, range_sigma_m=0.0), 7, 100)
    doubled = measure(ChannelParams(p_nlos=1.0, range_sigma_m=0.0, range_bias_mean_m=16.0), 7, 100)
    base_m = math.sqrt(40**2 + 40**2 + 20**2) + 1.5
    for one, two in zip(always, doubled, strict=True):
        assert one.range_m is not None
        assert two.range_m is not None
        assert two.range_m - base_m == pytest.approx(2.0 * (one.range_m - base_m))
