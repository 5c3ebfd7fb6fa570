"""Bearings in degrees, or divided, are told by their scatter; honest ones never are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.estimation.screen import BearingCheck

SIGMA_RAD = math.radians(2.0)
TARGET = (50.0, 50.0)
Sample = tuple[float, float, PositionEnu]


def _samples(
    seconds: float, seed: int, speed_mps: float = 5.0, aside_m: float = 3.0
) -> list[Sample]:
    """Flown past the target, ten a second, nine of ten bent by 5 degrees."""
    rng = np.random.default_rng(seed)
    samples = []
    for step in range(round(10 * seconds)):
        far = math.sqrt(0.5) * speed_mps * 0.1 * step
        place = (10.0 + far, 10.0 + far - aside_m, 20.0)
        bearing = math.atan2(TARGET[1] - place[1], TARGET[0] - place[0])
        bearing += SIGMA_RAD * rng.normal()
        bearing += math.radians(5.0) * rng.normal() * (rng.random() < 0.9)
        samples.append((0.1 * step, math.remainder(bearing, 2.0 * math.pi), place))
    return samples


def _condemned_s(check: BearingCheck, samples: list[Sample], factor: float) -> float | None:
    for time_s, bearing_rad, place in samples:
        scaled = factor * bearing_rad
        if abs(scaled) <= math.pi:
            check.add(time_s, scaled, SIGMA_RAD, place)
        if check.is_rejected:
            return time_s
    return None


@pytest.mark.parametrize("seed", range(5))
def test_bearings_in_radians_are_never_condemned(seed: int) -> None:
    assert _condemned_s(BearingCheck(), _samples(30.0, seed), 1.0) is None


@pytest.mark.parametrize("factor", [0.001, 0.01, 1.0 / 57.3])
def test_divided_they_stand_still(factor: float) -> None:
    check = BearingCheck()
    told_s = _condemned_s(check, _samples(5.0, 1), factor)
    assert told_s is not None
    assert told_s <= 2.5
    assert check.is_quiet


def test_hovering_they_may_stand_still() -> None:
    assert _condemned_s(BearingCheck(), _samples(30.0, 1, speed_mps=0.0), 0.001) is None


def test_multiplied_they_turn_at_random() -> None:
    """North by two degrees is a turn of 114 then; what is beyond half a turn is absurd anyway."""
    rng = np.random.default_rng(1)
    near_north = [(0.1 * i, SIGMA_RAD * float(rng.normal()), (0.0, 0.0, 20.0)) for i in range(60)]
    check = BearingCheck()
    assert _condemned_s(check, near_north, 57.3) is not None
    assert check.is_random


def test_it_is_over_when_they_make_sense_again() -> None:
    check = BearingCheck()
    assert _condemned_s(check, _samples(5.0, 1), 0.01) is not None
    for time_s, bearing_rad, place in _samples(4.0, 2):
        check.add(5.0 + time_s, bearing_rad, SIGMA_RAD, place)
    assert not check.is_rejected
    assert _condemned_s(check, [(20.0 + t, b, p) for t, b, p in _samples(5.0, 3)], 0.01)
