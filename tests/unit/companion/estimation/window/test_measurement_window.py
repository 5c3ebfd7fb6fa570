"""The bounded memory: what it keeps when it is full, and what it gives up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.estimation.window.map_kernels import COLUMNS, SEQUENCE
from companion.estimation.window.optimizer import KEPT_SHARE, MeasurementWindow, kept_by_thinning
from companion.kernel import Matrix

SIGMA = (1.0, 0.1, 0.2)
ORIGIN = (0.0, 0.0)


def _add(window: MeasurementWindow, position: PositionEnu, range_m: float) -> Matrix:
    return window.add(np.array([*position, range_m, math.nan, math.nan, *SIGMA, 0.0]), ORIGIN)


def _around(window: MeasurementWindow, count: int, radius_m: float = 5.0) -> None:
    for index in range(count):
        phi = 2.0 * math.pi * index / count
        _add(window, (radius_m * math.cos(phi), radius_m * math.sin(phi), 10.0), 50.0)


def test_rows_are_laid_out_as_the_kernels_take_them() -> None:
    window = MeasurementWindow(32)
    assert len(window.rows) == 0
    assert window.rows.shape == (0, COLUMNS)
    z = (50.0, math.nan, -0.3)
    for step in range(3):
        assert len(window.add(np.array([1.0, 2.0, step, *z, *SIGMA, 0.0]), ORIGIN)) == 0
    assert len(window.rows) == 3
    expected = [1.0, 2.0, 1.0, 50.0, math.nan, -0.3, 1.0, 0.1, 0.2, 1.0]
    np.testing.assert_array_equal(window.rows[1], expected)


def test_it_is_bounded_and_keeps_the_rare_views() -> None:
    window, dropped = MeasurementWindow(64), 0
    _around(window, 40)
    for index in range(5000):
        dropped += len(_add(window, (5.0, 0.1, 10.0), 51.0 + index))
        assert len(window.rows) <= 64
    assert dropped == 5040 - len(window.rows)
    rows = window.rows
    sectors = np.unique(np.floor(np.arctan2(rows[:, 1], rows[:, 0]) / (math.pi / 8.0)))
    assert len(sectors) >= 15
    hovering = rows[rows[:, 3] > 50.0, 3] - 51.0
    assert np.all(np.diff(hovering) > 0.0)
    old = hovering[hovering < 4900.0]
    assert len(old) >= 5
    assert np.diff(old).max() < 4.0 * np.diff(old).min()


def test_all_that_was_measured_is_held_or_was_given_up() -> None:
    window, given_up = MeasurementWindow(64), []
    rng = np.random.default_rng(2)
    for index in range(1000):
        position = (*rng.uniform(-50.0, 50.0, 2), 10.0)
        given_up += _add(window, position, 1.0 + index)[:, SEQUENCE].tolist()
    everything = sorted([*given_up, *window.rows[:, SEQUENCE]])
    assert everything == list(range(1000))
    np.testing.assert_array_equal(window.rows[:, 3], 1.0 + window.rows[:, SEQUENCE])
    assert (np.diff(window.rows[:, SEQUENCE]) > 0.0).all()


def test_the_newest_measurement_is_always_held() -> None:
    window = MeasurementWindow(32)
    for index in range(200):
        _add(window, (5.0, 0.0, 10.0), 1.0 + index)
        assert window.rows[-1, 3] == 1.0 + index


def test_thinning_makes_room_for_a_while() -> None:
    """A full window is thinned by a share, so that not every measurement pays for it."""
    window = MeasurementWindow(200)
    thinned_at = [
        index for index in range(400) if len(_add(window, (0.1 * index, 0.0, 10.0), 50.0))
    ]
    assert thinned_at[0] == 200
    assert min(np.diff(thinned_at)) >= (1.0 - KEPT_SHARE) * 200 - 1


def test_what_is_given_up_is_a_copy() -> None:
    window = MeasurementWindow(32)
    for index in range(32):
        _add(window, (5.0, 0.0, 10.0), 1.0 + index)
    gone = _add(window, (5.0, 0.0, 10.0), 33.0)
    before = gone.copy()
    for index in range(100):
        _add(window, (5.0, 0.0, 10.0), 100.0 + index)
    np.testing.assert_array_equal(gone, before)


def test_it_knows_whether_it_holds_bearings() -> None:
    window = MeasurementWindow(32)
    assert not window.has_bearings
    _add(window, (1.0, 0.0, 0.0), 5.0)
    assert not window.has_bearings
    window.add(np.array([1.0, 0.0, 0.0, math.nan, 0.3, math.nan, *SIGMA, 0.0]), ORIGIN)
    assert window.has_bearings


@pytest.mark.parametrize("target", [1, 10, 24, 31])
def test_thinning_never_keeps_more_than_asked(target: int) -> None:
    rng = np.random.default_rng(7)
    rows = rng.uniform(0.0, 100.0, (32, COLUMNS))
    rows[:, SEQUENCE] = np.arange(32)
    kept = kept_by_thinning(rows, target, (50.0, 50.0))
    assert 1 <= int(kept.sum()) <= target


def test_views_from_nearer_and_from_farther_are_different_views() -> None:
    """Hovering near the target must not push out the only view from afar on the same side."""
    rows = np.zeros((101, COLUMNS))
    rows[:100, 0], rows[100, 0] = 2.0, 60.0
    rows[:, SEQUENCE] = np.arange(101)
    kept = kept_by_thinning(rows, 20, ORIGIN)
    assert kept[100]
    assert int(kept.sum()) == 20


def test_all_views_lose_alike_where_there_are_more_than_may_be_kept() -> None:
    phi = np.linspace(-math.pi, math.pi, 64, endpoint=False)
    rows = np.zeros((64, COLUMNS))
    rows[:, 0], rows[:, 1] = 20.0 * np.cos(phi), 20.0 * np.sin(phi)
    rows[32:, :2] *= 5.0
    rows[:, SEQUENCE] = np.arange(64)
    kept = np.flatnonzero(kept_by_thinning(rows, 8, ORIGIN))
    assert len(kept) == 8
    assert np.diff(kept).max() <= 2 * np.diff(kept).min()
