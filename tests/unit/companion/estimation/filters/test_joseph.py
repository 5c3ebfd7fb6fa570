"""The Kalman arithmetic: one row in Joseph form, hard bounds, and what counts as definite."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.filters.kalman import (
    DEFINITE_MARGIN,
    is_positive_definite,
    joseph_row,
    within_bounds,
)
from companion.kernel import Matrix, Vector

SIZES = [4, 5, 6]
UNITS = np.array([30.0, 30.0, 5.0, 0.09, 0.05, 4.0])


def _covariance(rng: np.random.Generator, size: int) -> Matrix:
    root = rng.normal(size=(size, size)) * UNITS[:size, None]
    product: Matrix = root @ root.T + 1e-2 * np.diag(UNITS[:size] ** 2)
    return 0.5 * (product + product.T)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("R", [1e-4, 1.0, 1e4])
def test_a_row_is_the_joseph_form_with_full_matrices(size: int, R: float) -> None:
    rng = np.random.default_rng(size)
    for _ in range(20):
        P, H = _covariance(rng, size), rng.normal(size=size)
        K, updated, S = joseph_row(P, H, R)
        assert pytest.approx(H @ P @ H + R, rel=1e-12) == S
        np.testing.assert_allclose(K, P @ H / S, rtol=1e-12)
        kept = np.eye(size) - np.outer(K, H)
        expected = kept @ P @ kept.T + R * np.outer(K, K)
        np.testing.assert_allclose(updated, expected, rtol=0.0, atol=1e-12 * np.trace(P))
        assert np.array_equal(updated, updated.T)


def test_any_gain_would_do_for_the_joseph_form_but_this_one_is_the_least() -> None:
    rng = np.random.default_rng(1)
    P, H, R = _covariance(rng, 4), rng.normal(size=4), 2.0
    K, updated, _ = joseph_row(P, H, R)
    for _ in range(20):
        other = K + 0.1 * rng.normal(size=4)
        kept = np.eye(4) - np.outer(other, H)
        spread = kept @ P @ kept.T + R * np.outer(other, other)
        assert np.trace(spread) > np.trace(updated)


def test_a_row_that_sees_nothing_changes_nothing() -> None:
    P = _covariance(np.random.default_rng(2), 5)
    K, updated, S = joseph_row(P, np.zeros(5), 3.0)
    assert not K.any()
    assert updated.tobytes() == P.tobytes()
    assert S == 3.0


# -- Bounds --------------------------------------------------------------------------------------


def _bounded(mean: Vector, P: Matrix, bounds: dict[int, tuple[float, float]]) -> Vector:
    lower, upper = np.full(mean.size, -np.inf), np.full(mean.size, np.inf)
    for index, (low, high) in bounds.items():
        lower[index], upper[index] = low, high
    projected: Vector = within_bounds(mean, P, lower, upper)
    return projected


def test_within_its_bounds_a_mean_is_left_alone() -> None:
    mean, P = np.array([1.0, 2.0, 3.0, 0.0]), _covariance(np.random.default_rng(3), 4)
    assert _bounded(mean, P, {}) is mean
    assert _bounded(mean, P, {2: (0.0, 3.0), 3: (0.0, 0.0)}) is mean


@pytest.mark.parametrize("index", [2, 3])
def test_over_a_bound_it_becomes_the_most_probable_mean_on_it(index: int) -> None:
    rng = np.random.default_rng(index)
    for _ in range(10):
        P, mean = _covariance(rng, 4), rng.normal(size=4) * UNITS[:4]
        bound = float(mean[index] - 0.7 * UNITS[index])
        found = _bounded(mean, P, {index: (-np.inf, bound)})
        assert found[index] <= bound
        assert found[index] == pytest.approx(bound, rel=1e-14)
        others = [i for i in range(4) if i != index]
        L = np.linalg.inv(P)
        # Least (x - mean)' L (x - mean) with x[index] held: the conditional mean.
        shift = -np.linalg.solve(
            L[np.ix_(others, others)], L[others, index] * (bound - mean[index])
        )
        np.testing.assert_allclose(found[others], mean[others] + shift, rtol=1e-8, atol=1e-10)


def test_several_bounds_hold_exactly_and_the_rest_follows() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        P, mean = _covariance(rng, 5), 3.0 * rng.normal(size=5) * UNITS[:5]
        bounds = {2: (-2.0, 2.0), 3: (-0.05, 0.05), 4: (-0.04, 0.04)}
        found = _bounded(mean, P, bounds)
        inside = [low <= mean[index] <= high for index, (low, high) in bounds.items()]
        assert all(low <= found[index] <= high for index, (low, high) in bounds.items())
        assert all(inside) or (found[:2] != mean[:2]).all()


def test_the_given_mean_is_not_written_to() -> None:
    mean, P = np.array([1.0, 2.0, 9.0, 0.0]), _covariance(np.random.default_rng(4), 4)
    mean.setflags(write=False)
    assert _bounded(mean, P, {2: (0.0, 3.0)})[2] == 3.0
    assert mean[2] == 9.0


# -- Definiteness --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_a_covariance_of_any_units_is_definite(size: int) -> None:
    P = _covariance(np.random.default_rng(6), size)
    for exponent in (-60, -8, 0, 8, 60):
        units = 10.0 ** (exponent * np.linspace(0.0, 1.0, size))
        assert is_positive_definite(np.zeros(size), P * np.outer(units, units))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("index", range(4))
def test_what_is_not_finite_is_not_definite(bad: float, index: int) -> None:
    mean, P = np.zeros(4), np.eye(4)
    mean[index] = bad
    assert not is_positive_definite(mean, P)
    P[index, index] = bad
    assert not is_positive_definite(np.zeros(4), P)


def _with_correlation(least_eigenvalue: float) -> Matrix:
    """Two components whose correlation leaves this much in the other direction."""
    P = np.diag([4.0, 9.0, 1.0, 0.01])
    P[0, 1] = P[1, 0] = 6.0 * (1.0 - least_eigenvalue)
    return P


@pytest.mark.parametrize("least", [-1.0, -1e-6, 0.0, 0.1 * DEFINITE_MARGIN])
def test_what_rounding_could_make_indefinite_counts_as_indefinite(least: float) -> None:
    assert not is_positive_definite(np.zeros(4), _with_correlation(least))


@pytest.mark.parametrize("least", [10.0 * DEFINITE_MARGIN, 1e-9, 0.5])
def test_what_is_certain_counts_as_definite(least: float) -> None:
    assert is_positive_definite(np.zeros(4), _with_correlation(least))
