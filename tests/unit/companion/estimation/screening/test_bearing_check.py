"""Bearings in degrees, or divided, are detected by their scatter; honest ones never are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.screen import SampleHistory
from companion.estimation.unit_check import BEARINGS, BearingCheck, Sample

SIGMA_RAD = math.radians(2.0)
TARGET = (50.0, 50.0)


def _samples(
    seconds: float, seed: int, speed_mps: float = 5.0, aside_m: float = 3.0
) -> list[Sample]:
    """Flown past the target, ten a second, nine of ten bent by 5 degrees."""
    rng = np.random.default_rng(seed)
    samples = []
    for step in range(round(10 * seconds)):
        far = math.sqrt(0.5) * speed_mps * 0.1 * step
        position = (10.0 + far, 10.0 + far - aside_m, 20.0)
        bearing = math.atan2(TARGET[1] - position[1], TARGET[0] - position[0])
        bearing += SIGMA_RAD * rng.normal()
        bearing += math.radians(5.0) * rng.normal() * (rng.random() < 0.9)
        wrapped_rad = math.remainder(bearing, 2.0 * math.pi)
        samples.append(Sample(0.1 * step, wrapped_rad, position, SIGMA_RAD))
    return samples


def _history(check: BearingCheck | None = None) -> SampleHistory:
    return SampleHistory(BEARINGS, check or BearingCheck())


def _condemned_s(history: SampleHistory, samples: list[Sample], factor: float) -> float | None:
    for sample in samples:
        scaled = factor * sample.value
        if abs(scaled) <= math.pi:
            history.add(sample._replace(value=scaled))
        if history.check.is_rejected:
            return sample.time_s
    return None


@pytest.mark.parametrize("seed", range(5))
def test_bearings_in_radians_are_never_condemned(seed: int) -> None:
    assert _condemned_s(_history(), _samples(30.0, seed), 1.0) is None


@pytest.mark.parametrize("factor", [0.001, 0.01, 1.0 / 57.3])
def test_divided_they_stand_still(factor: float) -> None:
    check = BearingCheck()
    condemned_s = _condemned_s(_history(check), _samples(5.0, 1), factor)
    assert condemned_s is not None
    assert condemned_s <= 2.5
    assert check.is_quiet


def test_hovering_they_may_stand_still() -> None:
    assert _condemned_s(_history(), _samples(30.0, 1, speed_mps=0.0), 0.001) is None


def test_multiplied_they_turn_at_random() -> None:
    """North by two degrees is a turn of 114 then; what is beyond half a turn is absurd anyway."""
    rng = np.random.default_rng(1)
    near_north = [
        Sample(0.1 * i, SIGMA_RAD * float(rng.normal()), (0.0, 0.0, 20.0), SIGMA_RAD)
        for i in range(60)
    ]
    check = BearingCheck()
    assert _condemned_s(_history(check), near_north, 57.3) is not None
    assert check.is_random


def test_it_is_over_when_they_make_sense_again() -> None:
    history = _history()
    assert _condemned_s(history, _samples(5.0, 1), 0.01) is not None
    for sample in _samples(4.0, 2):
        history.add(sample._replace(time_s=5.0 + sample.time_s))
    assert not history.check.is_rejected
    later = [sample._replace(time_s=20.0 + sample.time_s) for sample in _samples(5.0, 3)]
    assert _condemned_s(history, later, 0.01)
