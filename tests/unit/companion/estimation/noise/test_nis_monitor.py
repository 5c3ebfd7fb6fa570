"""NIS, NEES and the bands that their means must lie in."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from companion.estimation.filters.target_filter import FilterState, ModalityReport, UpdateReport
from companion.estimation.innovations import InnovationNoise, mean_band

START, LIMITS = InnovationNoise.starting(4.0), np.full((3, 2), np.inf)
STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))
ROW = ModalityReport(1.0, 1.0, 1.0, 1.0, 1.0, 0.1)


def _report(nis: float, dof: int) -> UpdateReport:
    rows = [ROW if index < dof else None for index in range(3)]
    return UpdateReport(STATE, tuple(rows[:3]), nis, True)


def _monitor(rng: np.random.Generator, count: int, excess: float = 1.0) -> InnovationNoise:
    monitor = START
    for dof in rng.integers(1, 4, count):
        monitor = monitor.after(_report(excess * float(rng.chisquare(dof)), int(dof)), LIMITS)
    return monitor


@pytest.mark.parametrize(
    ("dof", "count", "rel"),
    [(2.0, 200, 0.002), (1.0, 50, 0.005), (2.0, 10, 0.01), (1.0, 5, 0.05), (4.0, 1, 0.1)],
)
def test_the_band_is_that_of_the_chi_square_table(dof: float, count: int, rel: float) -> None:
    expected = chi2.ppf([0.025, 0.975], dof * count) / count
    assert mean_band(dof, count) == pytest.approx(tuple(expected), rel=rel)


def test_a_band_is_never_below_zero() -> None:
    low, high = mean_band(1.0, 1.0)
    assert 0.0 <= low < 0.1
    assert high == pytest.approx(float(chi2.ppf(0.975, 1)), rel=0.05)


def test_before_the_first_update_nothing_is_known() -> None:
    assert START.nis is None
    assert not START.is_overconfident


def test_the_mean_is_per_degree_of_freedom() -> None:
    monitor = START.after(_report(6.0, 3), LIMITS).after(_report(2.0, 1), LIMITS)
    assert monitor.nis == pytest.approx(2.0, rel=0.01)


def test_a_consistent_filter_is_seldom_called_overconfident() -> None:
    calls = [_monitor(np.random.default_rng(seed), 400).is_overconfident for seed in range(100)]
    assert sum(calls) <= 8  # 2.5 % above the band


@pytest.mark.parametrize(("excess", "expected"), [(2.0, True), (1.5, True), (0.3, False)])
def test_an_overconfident_one_is_found_out(excess: float, expected: bool) -> None:
    for seed in range(10):
        monitor = _monitor(np.random.default_rng(seed), 400, excess)
        assert monitor.is_overconfident is expected
        assert monitor.nis == pytest.approx(excess, rel=0.3)


def test_what_is_long_past_is_forgotten() -> None:
    rng = np.random.default_rng(2)
    monitor = _monitor(rng, 400, 5.0)
    for _ in range(2000):
        monitor = monitor.after(_report(float(rng.chisquare(2)), 2), LIMITS)
    assert not monitor.is_overconfident
