"""Partials of range and bearing against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.arrays import Vector
from companion.models.ranging_model import (
    bearing_jacobian,
    bearing_variance,
    predicted_bearing,
    predicted_range,
    range_jacobian,
    range_variance,
)

STEP = 1e-5


def _places(seed: int) -> tuple[Vector, Vector, float]:
    rng = np.random.default_rng(seed)
    mean = np.concatenate([rng.uniform(-80.0, 80.0, 2), rng.normal(size=2) * [3.0, 0.1]])
    sensor = np.array([*rng.uniform(-80.0, 80.0, 2), rng.uniform(2.0, 60.0)])
    return mean, sensor, float(rng.uniform(-3.0, 3.0))


@pytest.mark.parametrize("seed", range(50))
def test_partials_of_the_range(seed: int) -> None:
    mean, sensor, height_m = _places(seed)
    row = range_jacobian(mean, sensor, height_m)
    for index, step in enumerate(np.eye(4) * STEP):
        above = predicted_range(mean + step, sensor, height_m)
        below = predicted_range(mean - step, sensor, height_m)
        assert row[index] == pytest.approx((above - below) / (2.0 * STEP), abs=1e-7)


@pytest.mark.parametrize("seed", range(50))
def test_partials_of_the_bearing(seed: int) -> None:
    mean, sensor, _ = _places(seed)
    row = bearing_jacobian(mean, sensor)
    for index, step in enumerate(np.eye(4) * STEP):
        turn = predicted_bearing(mean + step, sensor) - predicted_bearing(mean - step, sensor)
        assert row[index] == pytest.approx(turn / (2.0 * STEP), abs=1e-7)


def test_a_range_is_slant() -> None:
    target = np.array([3.0, 4.0, 0.5, 0.0])
    assert predicted_range(target, np.array([0.0, 0.0, 12.0]), 0.0) == pytest.approx(13.5)


def test_right_overhead_only_the_offsets_are_seen() -> None:
    mean, sensor = np.array([3.0, 4.0, 0.5, 0.1]), np.array([3.0, 4.0, 0.0])
    assert range_jacobian(mean, sensor, 0.0).tolist() == [0.0, 0.0, 1.0, 0.0]
    assert bearing_jacobian(mean, sensor).tolist() == [0.0, 0.0, 0.0, 1.0]


def test_the_curvature_term_is_the_bias_of_the_linearisation() -> None:
    """A target that is uncertain across the line of sight is farther away than its mean."""
    rng = np.random.default_rng(2)
    across_m, ground_m = 1.5, 40.0
    P = np.diag([0.0, across_m**2, 0.0, 0.0])
    mean, sensor = np.array([ground_m, 0.0, 0.0, 0.0]), np.zeros(3)
    drawn = rng.normal(0.0, across_m, 200_000)
    farther_m = np.hypot(ground_m, drawn) - ground_m
    added = range_variance(P, mean, sensor, 0.0, 1.0, 0.0, True) - 1.0
    assert added == pytest.approx(float(np.mean(farther_m)) ** 2, rel=0.02)
    assert range_variance(P, mean, sensor, 0.0, 1.0, 0.0, False) == 1.0


def test_variances_add_radio_own_position_and_curvature() -> None:
    P = np.diag([3.0, 1.0, 0.0, 0.0])
    mean, sensor = np.array([6.0, 8.0, 0.0, 0.0]), np.zeros(3)
    assert range_variance(P, mean, sensor, 0.0, 1.5, 0.2, True) == pytest.approx(
        1.5**2 + 0.2**2 + (4.0 / 20.0) ** 2
    )
    assert bearing_variance(P, mean, sensor, 0.03, 0.2, True) == pytest.approx(
        0.03**2 + (0.2 / 10.0) ** 2 + (4.0 / 100.0) ** 2
    )
    assert bearing_variance(P, mean, sensor, 0.03, 0.0, False) == pytest.approx(0.03**2)
