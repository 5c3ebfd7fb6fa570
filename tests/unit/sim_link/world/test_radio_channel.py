"""The true channel: offsets, obstruction and noise, by their statistics."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import RangingMeasurement
from sim_link.world.environment import (
    ChannelParams,
    Emitter,
    EmitterParams,
    Environment,
    ObstacleParams,
    ShadowParams,
    in_the_field,
)
from sim_link.world.radio_channel import MIN_RANGE_M, ChannelDraw, RadioChannel

SAMPLES = 20_000
QUIET = ChannelParams(p_nlos=0.0, range_sigma_m=0.0, bearing_sigma_deg=0.0)


EMITTER = Emitter(EmitterParams())
BLOCK = ObstacleParams(
    corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)), height_m=25.0
)


@pytest.fixture(scope="module")
def draws() -> list[ChannelDraw]:
    channel = RadioChannel(ChannelParams(), np.random.default_rng(11))
    return [channel.draw(EMITTER, (10.0, 10.0, 20.0)) for _ in range(SAMPLES)]


def measure(params: ChannelParams, seed: int, count: int) -> list[RangingMeasurement]:
    channel = RadioChannel(params, np.random.default_rng(seed))
    return [channel.measure(EMITTER, (10.0, 10.0, 20.0), 0.0) for _ in range(count)]


def test_an_emitter_may_have_a_channel_of_its_own() -> None:
    own = in_the_field(msgspec.structs.replace(QUIET, range_offset_m=-2.0, bearing_offset_deg=7.0))
    other = Emitter(EmitterParams(emitter_id=2, channel=own))
    channel = RadioChannel(QUIET, np.random.default_rng(0))
    here = (10.0, 10.0, 20.0)
    common, special = channel.measure(EMITTER, here, 0.0), channel.measure(other, here, 0.0)
    assert common.range_m is not None
    assert special.range_m == pytest.approx(common.range_m - 3.5)
    assert common.bearing_enu_rad is not None
    assert special.bearing_enu_rad == pytest.approx(common.bearing_enu_rad + math.radians(10.0))


def test_nine_measurements_of_ten_are_obstructed(draws: list[ChannelDraw]) -> None:
    assert np.mean([draw.range_bias_m > 0.0 for draw in draws]) == pytest.approx(0.9, abs=0.01)


def test_range_bias_is_exponential_and_never_negative(draws: list[ChannelDraw]) -> None:
    biases = np.array([draw.range_bias_m for draw in draws if draw.range_bias_m > 0.0])
    assert biases.min() >= 0.0
    assert biases.mean() == pytest.approx(8.0, rel=0.03)
    assert biases.std() == pytest.approx(8.0, rel=0.04)
    assert np.median(biases) == pytest.approx(8.0 * math.log(2.0), rel=0.04)


def test_bearing_bias_is_symmetric(draws: list[ChannelDraw]) -> None:
    biases = np.degrees([draw.bearing_bias_rad for draw in draws if draw.range_bias_m > 0.0])
    assert biases.mean() == pytest.approx(0.0, abs=0.15)
    assert biases.std() == pytest.approx(5.0, rel=0.03)


def test_an_open_path_has_no_bias_in_either_modality(draws: list[ChannelDraw]) -> None:
    for draw in draws:
        assert (draw.range_bias_m > 0.0) == (draw.bearing_bias_rad != 0.0)


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
    measurement = channel.measure(EMITTER, (50.0, 50.0, 10.0), 0.0)
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


def test_obstacles_do_not_change_what_chance_adds_in_the_open() -> None:
    """The same randomness is consumed in and out of the shadow."""
    rngs = np.random.default_rng(5), np.random.default_rng(5)
    plain = RadioChannel(ChannelParams(), rngs[0])
    hidden = RadioChannel(ChannelParams(), rngs[1], Environment([BLOCK]))
    changed = 0
    for step in range(120):
        position = (float(step), 100.0, 15.0)
        without, within = plain.draw(EMITTER, position), hidden.draw(EMITTER, position)
        changed += without != within
        assert (without.range_noise_m, without.bearing_noise_rad) == (
            within.range_noise_m,
            within.bearing_noise_rad,
        )
    assert 20 < changed < 100
    assert rngs[0].bit_generator.state == rngs[1].bit_generator.state


def test_in_the_shadow_the_detour_and_its_direction_are_measured() -> None:
    shadow = ShadowParams(extra_bias_mean_m=0.0, bearing_bias_sigma_deg=0.0)
    channel = RadioChannel(QUIET, np.random.default_rng(1), Environment([BLOCK], shadow))
    seen = channel.measure(EMITTER, (10.0, 20.0, 0.0), 0.0)
    way_m = math.dist((10.0, 20.0), (45.0, 30.0)) + math.dist((45.0, 30.0), (50.0, 50.0))
    assert seen.range_m == pytest.approx(way_m + 1.5, abs=1e-4)
    expected_rad = math.atan2(10.0, 35.0) - math.radians(3.0)
    assert seen.bearing_enu_rad == pytest.approx(expected_rad, abs=1e-4)


def test_each_emitter_has_a_shadow_of_its_own() -> None:
    environment = Environment([BLOCK], ShadowParams(bearing_bias_sigma_deg=0.0))
    other = Emitter(EmitterParams(position_enu_m=(10.0, 55.0)))
    channel = RadioChannel(QUIET, np.random.default_rng(1), environment)
    for _ in range(3):
        assert channel.draw(EMITTER, (10.0, 45.0, 0.0)).range_bias_m > 0.0
        assert channel.draw(other, (10.0, 45.0, 0.0)).range_bias_m == 0.0


def test_preparing_draws_nothing() -> None:
    one, other = (
        RadioChannel(ChannelParams(), np.random.default_rng(1), Environment([BLOCK]))
        for _ in range(2)
    )
    one.prepare(EMITTER)
    for position in ((10.0, 45.0, 5.0), (70.0, 45.0, 5.0)):
        assert one.measure(EMITTER, position, 0.0) == other.measure(EMITTER, position, 0.0)


@given(
    st.tuples(st.floats(-50.0, 150.0), st.floats(-50.0, 150.0), st.floats(0.0, 60.0)),
    st.tuples(st.floats(0.0, 100.0), st.floats(0.0, 100.0)),
    st.integers(0, 1000),
)
def test_without_noise_no_range_is_shorter_than_the_straight_line(
    position: tuple[float, float, float], target: tuple[float, float], seed: int
) -> None:
    params = ChannelParams(range_offset_m=0.0, range_sigma_m=0.0, p_nlos=0.5)
    channel = RadioChannel(params, np.random.default_rng(seed), Environment([BLOCK]))
    emitter = Emitter(EmitterParams(position_enu_m=target))
    range_m = channel.measure(emitter, position, 0.0).range_m
    assert range_m is not None
    assert range_m >= emitter.slant_range_m(position)
