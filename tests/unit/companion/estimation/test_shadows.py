"""Shadows of received power: what neighbours repeat, and what a fit hides of their variance."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.filters.target_filter import (
    POWER_LENGTH_M,
    POWER_SHADOW_SIGMA_DB,
    POWER_TOTAL_SIGMA_DB,
)
from companion.estimation.measurement_model import POWER
from companion.estimation.window.map_kernels import (
    COLUMNS,
    POWER_COLUMNS,
    POWER_VALUE,
    POWER_WEIGHT,
)
from companion.estimation.window.sandwich import Scores
from companion.estimation.window.shadows import (
    absorbed_share,
    shadow_cells,
    shadow_noise,
    shadow_weights,
)
from companion.estimation.window.spatial_noise import SpatialNoise
from companion.kernel import Matrix, Vector

SHARE = (POWER_SHADOW_SIGMA_DB / POWER_TOTAL_SIGMA_DB) ** 2
LEVEL_AND_SLOPES = 3
FREE = np.zeros((LEVEL_AND_SLOPES, LEVEL_AND_SLOPES))
"""Information of no prior."""


def track(length_m: float, count: int = 120) -> Matrix:
    """Return rows (n, 13) of powers along a bent track."""
    rows = np.full((count, COLUMNS + POWER_COLUMNS), np.nan)
    along_m = np.linspace(0.0, length_m, count)
    rows[:, 0], rows[:, 1] = along_m, 20.0 * np.sin(along_m / 40.0)
    rows[:, POWER_VALUE] = -80.0
    rows[:, POWER_WEIGHT] = shadow_weights(rows)
    return rows


def drawn(rows: Matrix, rng: np.random.Generator, count: int) -> Matrix:
    """Return errors (count, n) of shadows and fading, in units of their total deviation."""
    apart_m = np.hypot(*(rows[:, None, :2] - rows[None, :, :2]).transpose(2, 0, 1))
    K = SHARE * np.exp(-apart_m / POWER_LENGTH_M) + (1.0 - SHARE) * np.eye(len(rows))
    return np.asarray(rng.standard_normal((count, len(rows))) @ np.linalg.cholesky(K).T)


def fitted(rows: Matrix, errors: Vector) -> tuple[Vector, Matrix, Scores]:
    """Return the weighted fit of a level and two slopes to errors, its inverse, and its scores."""
    n, weights = len(rows), rows[:, POWER_WEIGHT]
    X = np.column_stack([np.ones(n), rows[:, :2] / 30.0])
    W = weights[:, None] * X
    inverse = np.asarray(np.linalg.inv(W.T @ X), dtype=np.float64)
    found = inverse @ W.T @ errors
    u, H = np.zeros((POWER + 1, n)), np.zeros(((POWER + 1) * n, LEVEL_AND_SLOPES))
    u[POWER], H[POWER * n :] = errors - X @ found, X
    is_measured = np.zeros(u.shape, dtype=bool)
    is_measured[POWER] = True
    return found, inverse, Scores(u, u, H, is_measured).weighed(weights)


@pytest.mark.parametrize("length_m", [60.0, 200.0, 800.0])
def test_intervals_under_shadows_hold_from_the_first_places_on(length_m: float) -> None:
    rows = track(length_m)
    inside = np.zeros(LEVEL_AND_SLOPES)
    errors = drawn(rows, np.random.default_rng(1), 400)
    for error in errors:
        found, inverse, scores = fitted(rows, error)
        B = shadow_noise(rows, scores, FREE).variance(scores.entering(POWER))
        inside += np.abs(found) <= 1.96 * np.sqrt(np.diag(inverse @ B @ inverse))
    assert (inside / len(errors) >= 0.93).all()


@pytest.mark.parametrize("length_m", [60.0, 800.0])
def test_residuals_are_short_of_errors_by_the_absorbed_share(length_m: float) -> None:
    rows = track(length_m)
    weights = rows[:, POWER_WEIGHT]
    cell, _, correlation = shadow_cells(rows[:, :2])
    unit = SpatialNoise(cell, SHARE * correlation, 1.0 - SHARE, repetition=1.0)
    errors = drawn(rows, np.random.default_rng(3), 2000)
    scores = [fitted(rows, error)[2] for error in errors]
    left = float(np.mean([np.mean(score.u[POWER] ** 2) for score in scores]))
    share = absorbed_share(unit, scores[0].entering(POWER), weights, 1.0, FREE)
    assert 1.0 - left == pytest.approx(share, abs=0.02)
    assert share > (0.5 if length_m == 60.0 else 0.1)
