"""Ranges in a wrong unit are detected by own motion; honest ones never are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import SampleHistory
from companion.estimation.unit_check import (
    DECISION_LOG_ODDS,
    FACTORS,
    RANGES,
    Sample,
    UnitCheck,
    _Window,
)

MAX_RANGE_M = 2000.0
RATE_HZ = 10.0
SPEED_MPS = 5.0
TARGET: PositionEnu = (50.0, 50.0, 0.0)
Track = Literal["radial", "abeam", "hover", "orbit"]


@dataclass(frozen=True, slots=True)
class Radio:
    sigma_m: float
    p_nlos: float
    bias_m: float
    offset_m: float


CANONICAL = Radio(1.5, 0.9, 8.0, 1.5)
UWB = Radio(0.05, 0.0, 0.0, 0.2)
CELL = Radio(11.3, 0.7, 15.0, 15.0)
NOISELESS = Radio(0.0, 0.0, 0.0, 0.0)


def _position(track: Track, time_s: float, height_m: float) -> PositionEnu:
    far = SPEED_MPS * time_s
    if track == "orbit":
        turned = far / 25.0
        return (50.0 + 25.0 * math.cos(turned), 50.0 + 25.0 * math.sin(turned), height_m)
    east, north = {"radial": (1.0, 1.0), "abeam": (1.0, -1.0), "hover": (0.0, 0.0)}[track]
    root = math.sqrt(0.5) * far
    return (10.0 + east * root, 10.0 + north * root, height_m)


def _samples(
    radio: Radio, track: Track, height_m: float, seconds: float, seed: int
) -> list[Sample]:
    rng = np.random.default_rng(seed)
    samples = []
    for step in range(round(seconds * RATE_HZ)):
        time_s = step / RATE_HZ
        position = _position(track, time_s, height_m)
        range_m = math.dist(position, TARGET) + radio.offset_m + radio.sigma_m * rng.normal()
        range_m += radio.bias_m * rng.exponential() * (rng.random() < radio.p_nlos)
        samples.append(Sample(time_s, max(float(range_m), 0.01), position))
    return samples


def _condemned_s(history: SampleHistory, samples: list[Sample], factor: float) -> float | None:
    """Return the time when ranges times a factor are condemned; absurd ones are refused before."""
    for sample in samples:
        if factor * sample.value <= MAX_RANGE_M:
            history.add(sample._replace(value=factor * sample.value))
        if history.check.is_rejected:
            return sample.time_s
    return None


def _history(params: FilterParams | None = None) -> SampleHistory:
    return SampleHistory(RANGES, UnitCheck(params or FilterParams(), MAX_RANGE_M))


@pytest.mark.parametrize("factor", [0.001, 0.01, 1.0 / 57.3])
@pytest.mark.parametrize("track", ["radial", "abeam", "orbit"])
@pytest.mark.parametrize("radio", [CANONICAL, UWB, NOISELESS])
@pytest.mark.parametrize("height_m", [8.0, 20.0])
def test_a_larger_unit_is_reported_within_two_seconds_of_motion(
    factor: float, track: Track, radio: Radio, height_m: float
) -> None:
    for seed in range(3):
        condemned_s = _condemned_s(_history(), _samples(radio, track, height_m, 3.0, seed), factor)
        assert condemned_s is not None
        assert condemned_s <= 2.0


def test_above_what_the_offset_allows_hovering_is_enough() -> None:
    hovering = _samples(CANONICAL, "hover", 20.0, 3.0, 1)
    assert _condemned_s(_history(), hovering, 0.01) is not None
    bounded = FilterParams(range_offset_min_m=-3.0, range_offset_max_m=3.0, range_sigma_m=0.15)
    low = _samples(UWB, "hover", 8.0, 3.0, 1)
    assert _condemned_s(_history(bounded), low, 0.01) is not None
    assert _condemned_s(_history(), low, 0.01) is None  # an offset of -8 m is possible there


@pytest.mark.parametrize("radio", [CANONICAL, UWB])
def test_a_smaller_unit_scatters_or_runs_away(radio: Radio) -> None:
    """Nearer than 35 m even 57.3 times the range is not absurd."""
    flown = [s for s in _samples(radio, "radial", 10.0, 12.0, 2) if s[1] < 34.0]
    began_s = flown[0][0]
    condemned_s = _condemned_s(_history(), flown, 57.3)
    assert condemned_s is not None
    assert condemned_s - began_s <= 3.0


@pytest.mark.parametrize("track", ["radial", "abeam", "orbit", "hover"])
@pytest.mark.parametrize("radio", [CANONICAL, UWB, NOISELESS])
@pytest.mark.parametrize("height_m", [1.0, 20.0])
def test_metres_are_never_condemned(track: Track, radio: Radio, height_m: float) -> None:
    for seed in range(3):
        samples = _samples(radio, track, height_m, 30.0, 10 + seed)
        assert _condemned_s(_history(), samples, 1.0) is None


def _in_steps(radio: Radio, track: Track, step_m: float, seed: int) -> list[Sample]:
    """Return samples in the steps of a cell, twice a second."""
    samples = _samples(radio, track, 20.0, 60.0, seed)[::5]
    return [sample._replace(value=(sample.value // step_m + 0.5) * step_m) for sample in samples]


@pytest.mark.parametrize("track", ["radial", "abeam", "orbit", "hover"])
@pytest.mark.parametrize("step_m", [39.04, 78.07])
def test_metres_in_configured_steps_are_never_rejected(track: Track, step_m: float) -> None:
    configured = FilterParams(range_step_m=step_m, range_offset_sigma_m=0.6 * step_m)
    for seed in range(5):
        for radio in (CELL, NOISELESS):
            steps = _in_steps(radio, track, step_m, seed)
            assert _condemned_s(_history(configured), steps, 1.0) is None


def test_ranges_that_flicker_by_two_steps_are_wild_only_without_configured_steps() -> None:
    flicker = [Sample(0.5 * i, 39.0 + 156.0 * (i % 2), (0.1 * i, 0.0, 20.0)) for i in range(40)]
    assert _condemned_s(_history(FilterParams(range_step_m=78.0)), flicker, 1.0) is None
    assert _condemned_s(_history(), flicker, 1.0) is not None


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_outliers_are_another_matter(share: float) -> None:
    rng = np.random.default_rng(5)
    outliers = [
        sample._replace(value=sample.value + float(rng.exponential(40.0)) * (rng.random() < share))
        for sample in _samples(CANONICAL, "radial", 20.0, 30.0, 3)
    ]
    assert _condemned_s(_history(), outliers, 1.0) is None


@pytest.mark.parametrize("factor", [0.01, 57.3])
def test_in_flight_a_new_unit_is_reported_and_so_is_its_end(factor: float) -> None:
    history = _history()
    samples = [s for s in _samples(CANONICAL, "radial", 8.0, 14.0, 4) if s[1] < 60.0]
    third = len(samples) // 3
    assert _condemned_s(history, samples[:third], 1.0) is None
    near = [
        sample._replace(value=min(sample.value, 30.0 + sample.value / 10.0))
        for sample in samples[third : 2 * third]
    ]
    condemned_s = _condemned_s(history, near, factor)
    assert condemned_s is not None
    assert condemned_s - near[0].time_s <= 3.0
    for sample in samples[2 * third :]:
        history.add(sample)
    assert not history.check.is_rejected


def test_ranges_that_scatter_like_no_radio_in_another_unit_are_in_metres() -> None:
    """Reflections of 3 m would be 170 m at least, which no motion explains better."""
    rng = np.random.default_rng(7)
    history = _history()
    check = history.check
    assert isinstance(check, UnitCheck)
    positions = np.array([(0.3 * i, 0.0, 20.0) for i in range(30)])
    window = _Window(30.0 + 3.0 * rng.normal(size=30), positions)
    assert check._likeliest(window, FACTORS, DECISION_LOG_ODDS)[1] == -math.inf


def test_hovering_does_not_acquit() -> None:
    history = _history()
    assert _condemned_s(history, _samples(UWB, "radial", 8.0, 3.0, 1), 0.01) is not None
    for time_s, range_m, *_ in _samples(UWB, "hover", 8.0, 60.0, 2):
        history.add(Sample(3.0 + time_s, 0.01 * range_m, (20.0, 20.0, 8.0)))
    assert history.check.is_rejected
