"""The objective over a whole recording."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.window.window_map import MIN_MEASUREMENTS
from companion.kernel import Matrix
from tests.unit.companion.estimation.batch_map import batch_map, rows_of
from tests.unit.companion.estimation.walks import (
    OFFSET_M,
    TARGET,
    measurement_of,
    params,
    reflected,
    walk,
)


def _recorded(rows: Matrix) -> list[tuple[RangingMeasurement, PositionEnu]]:
    return [measurement_of(row, 0.1 * index) for index, row in enumerate(rows)]


def test_rows_are_the_measurements_in_order() -> None:
    rows = walk(np.random.default_rng(1), 20, elevations=True)
    rows[3, 4] = np.nan
    found = rows_of(_recorded(rows), params())
    turns = (found[:, 4] - rows[:, 4]) / (2.0 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    np.testing.assert_array_equal(np.delete(found, 4, axis=1), np.delete(rows, 4, axis=1))


@pytest.mark.parametrize("bearings", [True, False])
def test_a_recording_is_solved_from_nowhere(bearings: bool) -> None:
    rng = np.random.default_rng(2)
    rows = reflected(rng, walk(rng, bearings=bearings), 0.5)
    found = batch_map(_recorded(rows), params(range_k_long=1.0))
    assert found is not None
    error = found.best.mean[:2] - TARGET
    assert float(error @ np.linalg.solve(found.best.covariance[:2, :2], error)) < 9.2
    assert found.optima[0][0] > 0.95
    assert found.best.mean[2] == pytest.approx(OFFSET_M, abs=1.5)
    assert not found.observability.is_collinear


def test_a_straight_recording_has_two_answers() -> None:
    rows = walk(np.random.default_rng(4), bearings=False, straight=True)
    found = batch_map(_recorded(rows), params())
    assert found is not None
    assert found.observability.is_collinear
    (p, one), (q, other) = found.optima
    assert p + q == pytest.approx(1.0)
    assert p == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(one.mean[:2], other.mean[:2] * [1.0, -1.0], atol=0.1)


def test_too_little_is_no_answer() -> None:
    rows = walk(np.random.default_rng(1))
    assert batch_map(_recorded(rows[: MIN_MEASUREMENTS - 1]), params()) is None
    assert batch_map([], params()) is None


def test_from_a_single_place_there_is_no_answer() -> None:
    rows = walk(np.random.default_rng(1), bearings=False)
    rows[:, :2], rows[:, 3] = 0.0, 47.0
    assert batch_map(_recorded(rows), params(range_offset_sigma_m=1e3)) is None
