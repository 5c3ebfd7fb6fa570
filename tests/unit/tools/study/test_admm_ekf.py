"""The splitting: its proximal map, where it converges to, and what it costs to stop early."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from companion.domain import RangingMeasurement
from companion.estimation.filters.kalman import (
    AsymmetricHuberEkf,
    asymmetric_huber_influence,
    asymmetric_huber_loss,
)
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.kernel import Matrix, Vector
from tools.study.admm_ekf import AdmmEkf, AdmmParams, proximal_residual, split

THRESHOLDS = {
    "one-sided": np.array([[1.5, math.inf], [1.5, 1.5], [1.5, 1.5]]),
    "asymmetric": np.array([[1.0, 3.0], [1.5, 1.5], [0.7, 0.7]]),
    "quadratic": np.full((3, 2), math.inf),
}


@pytest.mark.parametrize("penalty", [0.2, 1.0, 5.0])
@pytest.mark.parametrize(("k_long", "k_short"), [(1.5, 1.5), (1.0, 3.0), (1.5, math.inf)])
def test_the_proximal_map_is_a_minimum(penalty: float, k_long: float, k_short: float) -> None:
    for a in np.linspace(-12.0, 12.0, 49):

        def objective(v: float, a: float = float(a)) -> float:
            return float(asymmetric_huber_loss(v, k_long, k_short) + 0.5 * penalty * (a - v) ** 2)

        found = proximal_residual(float(a), k_long, k_short, penalty)
        least = minimize_scalar(objective, bracket=(-15.0, 15.0), tol=1e-12)
        assert found == pytest.approx(float(least.x), abs=1e-6)
        slope = asymmetric_huber_influence(found, k_long, k_short) - penalty * (a - found)
        assert slope == pytest.approx(0.0, abs=1e-12)


def _problem(rng: np.random.Generator, size: int) -> tuple[Matrix, Matrix, Vector, Vector]:
    """A prior covariance, whitened partials and innovations, and inflations."""
    root = rng.normal(size=(size, size))
    P = root @ root.T + 0.1 * np.eye(size)
    return P, rng.normal(size=(3, size)), 4.0 * rng.normal(size=3), rng.uniform(1.0, 4.0, 3)


def _cost(
    d: Vector, P: Matrix, H: Matrix, y: Vector, thresholds: Matrix, inflation: Vector
) -> float:
    losses = [
        asymmetric_huber_loss(float(v), *thresholds[row]) / inflation[row]
        for row, v in enumerate(y - H @ d)
    ]
    return float(0.5 * d @ np.linalg.solve(P, d) + sum(losses))


@pytest.mark.parametrize("size", [4, 6])
@pytest.mark.parametrize("name", THRESHOLDS)
def test_iterated_long_enough_it_is_the_minimum_of_the_linearised_problem(
    name: str, size: int
) -> None:
    thresholds = THRESHOLDS[name]
    for seed in range(8):
        P, H, y, inflation = _problem(np.random.default_rng(seed), size)
        root = np.linalg.cholesky(P)
        best = minimize(
            lambda s, root=root, p=(P, H, y, thresholds, inflation): _cost(root @ s, *p),
            np.zeros(size),
            method="BFGS",
            options={"gtol": 1e-9, "maxiter": 2000},
        )
        d, v = split(P, H, y, thresholds, inflation, 4000, 1.0)
        found = _cost(d, P, H, y, thresholds, inflation)
        assert found <= float(best.fun) + 1e-9 * (1.0 + float(best.fun))
        np.testing.assert_allclose(d, root @ best.x, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(v, y - H @ d, rtol=0.0, atol=1e-7)


def test_it_ends_where_the_influences_balance_the_prior() -> None:
    """P^-1 d = H^T psi(v) / c is the condition of the minimum."""
    thresholds = THRESHOLDS["asymmetric"]
    for seed in range(20):
        P, H, y, c = _problem(np.random.default_rng(seed), 4)
        d, v = split(P, H, y, thresholds, c, 4000, 1.0)
        psi = [asymmetric_huber_influence(float(v[row]), *thresholds[row]) for row in range(3)]
        np.testing.assert_allclose(np.linalg.solve(P, d), H.T @ (psi / c), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("penalty", [0.1, 0.5, 2.0, 10.0])
def test_the_penalty_decides_how_soon_and_not_where(penalty: float) -> None:
    P, H, y, c = _problem(np.random.default_rng(3), 4)
    thresholds = THRESHOLDS["one-sided"]
    far, _ = split(P, H, y, thresholds, c, 4000, 1.0)
    other, _ = split(P, H, y, thresholds, c, 4000, penalty)
    np.testing.assert_allclose(other, far, rtol=1e-6, atol=1e-6)


def test_few_iterations_stop_short_of_it() -> None:
    P, H, y, c = _problem(np.random.default_rng(3), 4)
    thresholds = THRESHOLDS["one-sided"]
    goal, _ = split(P, H, y, thresholds, c, 4000, 1.0)
    gaps = [
        float(np.linalg.norm(split(P, H, y, thresholds, c, iterations, 1.0)[0] - goal))
        for iterations in (1, 10, 100, 1000)
    ]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[0] > 1e-2 > 1e-4 > gaps[3]


def test_no_innovation_is_no_change() -> None:
    P, H, _, c = _problem(np.random.default_rng(4), 4)
    d, v = split(P, H, np.zeros(3), THRESHOLDS["one-sided"], c, 50, 1.0)
    assert not d.any()
    assert not v.any()


def test_what_was_not_measured_has_no_say() -> None:
    P, H, y, c = _problem(np.random.default_rng(5), 4)
    H[1:], y[1:] = 0.0, 0.0
    d, _ = split(P, H, y, THRESHOLDS["one-sided"], c, 5000, 1.0)
    scale = d / (P @ H[0])
    np.testing.assert_allclose(scale, scale[0], rtol=1e-9)


def _state() -> FilterState:
    return FilterState.of(0.0, np.array([40.0, 20.0, 0.0, 0.0]), np.diag([4.0, 4.0, 1.0, 1e-4]))


def _seen(range_m: float) -> RangingMeasurement:
    return RangingMeasurement(1, 0.0, range_m=range_m, bearing_enu_rad=0.5)


def test_on_the_quadratic_part_its_covariance_is_the_closed_forms() -> None:
    position = (0.0, 0.0, 20.0)
    split_report = AdmmEkf(FilterParams()).update(_state(), _seen(49.5), position)
    closed = AsymmetricHuberEkf(FilterParams()).update(_state(), _seen(49.5), position)
    np.testing.assert_allclose(split_report.state.covariance, closed.state.covariance, rtol=1e-12)


def test_a_reflection_is_weighed_by_what_is_left_of_it() -> None:
    """The closed form weighs by the innovation, the splitting by the residual it ends with."""
    position = (0.0, 0.0, 20.0)
    split_report = AdmmEkf(FilterParams(), AdmmParams(iterations=200)).update(
        _state(), _seen(75.0), position
    )
    closed = AsymmetricHuberEkf(FilterParams()).update(_state(), _seen(75.0), position)
    assert split_report.range is not None
    assert closed.range is not None
    assert closed.range.weight < split_report.range.weight < 1.0


def test_iterations_and_penalty_are_those_configured() -> None:
    position, seen = (0.0, 0.0, 20.0), _seen(75.0)
    means = {
        (iterations, penalty): AdmmEkf(FilterParams(), AdmmParams(iterations, penalty))
        .update(_state(), seen, position)
        .state.mean.tobytes()
        for iterations in (1, 10)
        for penalty in (0.5, 1.0)
    }
    assert len(set(means.values())) == 4
    default = AdmmEkf(FilterParams()).update(_state(), seen, position)
    assert default.state.mean.tobytes() == means[10, 1.0]


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"iterations": 1001}, {"penalty": 0.0}])
def test_what_makes_no_sense_is_refused_where_it_is_read(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, AdmmParams)
