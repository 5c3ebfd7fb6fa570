"""Any measurements in any order and with any delay leave a valid covariance, and nothing raises."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams

pytestmark = pytest.mark.slow

SEQUENCES, LENGTH = 20, 40
STEPS_S = (0.0, 1e-9, 0.05, 0.2, 1.0, 30.0, 86_400.0, 1e7, -0.05, -0.9, -5.0, -1e6)
"""Between two measurements: none, hardly any, usual, a day, and back."""
RANGES_M = (1e-3, 0.5, 40.0, 400.0, 1999.0)
SIGMAS = (1e-6, 0.5, 50.0)


def _sequence(
    rng: np.random.Generator, dtype: type[np.floating]
) -> list[tuple[RangingMeasurement, PositionEnu, float]]:
    """Measurements, where they were made, and when they are taken in."""
    measured, now_s = [], 1000.0

    def value(choices: tuple[float, ...]) -> float:
        return float(dtype(rng.choice(choices) * rng.uniform(0.5, 1.0)))

    for _ in range(LENGTH):
        now_s += float(dtype(rng.choice(STEPS_S)))
        has_range, has_bearing = rng.random(2) < 0.8
        position = rng.normal(0.0, rng.choice([0.0, 20.0, 1e4]), 3)
        one = RangingMeasurement(
            emitter_id=1,
            measured_at_s=now_s + float(rng.choice([0.0, -0.5, 0.05])),
            range_m=value(RANGES_M) if has_range or not has_bearing else None,
            range_sigma_m=value(SIGMAS) if rng.random() < 0.5 else None,
            bearing_enu_rad=float(dtype(rng.uniform(-3.14, 3.14))) if has_bearing else None,
            bearing_sigma_rad=value(SIGMAS) if rng.random() < 0.5 else None,
        )
        measured.append((one, (float(position[0]), float(position[1]), float(position[2])), now_s))
    return measured


def _check(tracker: TargetTracker, now_s: float) -> None:
    for hypothesis in tracker.hypotheses:
        covariance = hypothesis.state.covariance
        assert np.isfinite(hypothesis.state.mean).all()
        assert np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0)
        np.linalg.cholesky(covariance)
    estimate = tracker.estimate(now_s)
    assert estimate is None or math.isfinite(estimate.r95_m)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("drift", [0.0, 0.5])
def test_any_sequence_is_survived(dtype: type[np.floating], drift: float) -> None:
    rng = np.random.default_rng(7)
    accepted = 0
    for _ in range(SEQUENCES):
        tracker = TargetTracker(
            TrackerParams(filter=FilterParams(process_noise_m_per_sqrt_s=drift))
        )
        for measurement, position, now_s in _sequence(rng, dtype):
            tracker.fuse(measurement, position, now_s)
            _check(tracker, now_s)
        accepted += tracker.accepted
    assert accepted > 0.3 * SEQUENCES * LENGTH
