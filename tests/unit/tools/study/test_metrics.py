from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.target_estimate import r95_of_covariance_m
from tools.study.metrics import (
    nees,
    nees_band,
    r95_m,
    steps_to_settle,
)
from tools.study.trials import RunTally


@pytest.mark.parametrize(
    ("rmse", "steps"),
    [
        ([9.0, 2.4, 3.0, 2.4, 1.0], 4),
        ([1.0, 1.0], 1),
        ([9.0, 2.5, 1.0], 3),
        ([9.0, 1.0, 2.5], None),
        ([9.0, 1.0, np.nan], None),
    ],
)
def test_settled_is_after_the_last_step_above(rmse: list[float], steps: int | None) -> None:
    assert steps_to_settle(np.array(rmse)) == steps


def _ended(*errors_m: float) -> RunTally:
    finals = np.array(errors_m)
    return RunTally(finals.size, *[*[np.ones(1)] * 6, finals])


def test_a_run_that_ends_nowhere_has_diverged() -> None:
    assert _ended(0.1, 2.5, 2.6, np.nan, np.inf).diverged() == 3


def test_the_median_does_not_follow_one_run_and_counts_a_lost_one_as_far_off() -> None:
    assert _ended(0.1, 0.2, 0.3, 0.4, 161.0).median_m == 0.3
    assert _ended(0.1, 0.2, np.nan).median_m == 0.2


def test_nees_is_the_mahalanobis_distance() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        root = rng.normal(size=(2, 2))
        covariance, error = root @ root.T + 0.1 * np.eye(2), rng.normal(size=2)
        entries = np.array([covariance[0, 0], covariance[0, 1], covariance[1, 1]])
        expected = error @ np.linalg.solve(covariance, error)
        assert nees(error, entries) == pytest.approx(expected, rel=1e-9)


def test_the_mean_nees_of_honest_runs_is_in_its_band() -> None:
    low, high = nees_band(200)
    assert (low, high) == pytest.approx((1.733, 2.287), abs=2e-3)  # Bar-Shalom: 2 +- 0.28
    rng = np.random.default_rng(5)
    means = np.mean(np.sum(rng.normal(size=(3000, 200, 2)) ** 2, axis=2), axis=1)
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.015)


def test_the_radius_is_the_companions() -> None:
    rng = np.random.default_rng(6)
    covariances = []
    for _ in range(40):
        root = rng.normal(size=(2, 2)) * rng.choice([0.01, 1.0, 50.0])
        covariances.append(root @ root.T)
    entries = np.array([[c[0, 0], c[0, 1], c[1, 1]] for c in covariances])
    expected = [r95_of_covariance_m(covariance) for covariance in covariances]
    np.testing.assert_allclose(r95_m(entries), expected, rtol=2e-5)


def test_the_radius_of_no_uncertainty_is_zero() -> None:
    assert r95_m(np.zeros(3)) == 0.0
