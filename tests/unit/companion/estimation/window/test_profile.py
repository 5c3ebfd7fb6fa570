"""Uncertainty beyond the linearised one: where the cost rises by less or more than it says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.estimation.stepwise import Steps, finish
from companion.estimation.window.map_kernels import (
    map_cost,
    map_descent,
    measured_innovations,
    normal_equations,
)
from companion.estimation.window.sandwich import (
    MIN_RISE_SHARE,
    STRETCHES,
    Valley,
    fit_covariance,
)
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import params

A = np.diag([1.0 / 9.0, 1.0, 4.0, 100.0])
COVARIANCE = np.asarray(np.linalg.inv(A))
MEAN = np.array([40.0, 25.0, 1.0, 0.0])


Cost = Callable[[Vector], float]


def _valley(cost: Cost, *, noise: float = 1.0, is_white: bool = False) -> Valley:
    def profiled(x: Vector) -> Steps[float]:
        yield 0
        return cost(x)

    return Valley(cost, profiled, noise, is_white)


def fitted(cost: Cost, covariance: Matrix = COVARIANCE, curvature: Matrix = A) -> Matrix:
    return finish(fit_covariance(covariance, curvature, MEAN, _valley(cost)))


def _quadratic(share: float = 1.0) -> Cost:
    """A cost whose rise is a share of what the curvature promises."""

    def cost(x: Vector) -> float:
        return 7.0 + share * 0.5 * float((x - MEAN) @ A @ (x - MEAN))

    return cost


def _plain(x: Vector) -> float:
    """A cost that does not rise at all."""
    return 7.0 + 0.0 * float(x[0])


@pytest.mark.parametrize("share", [1.0, 0.99 / MIN_RISE_SHARE, 1.01 * MIN_RISE_SHARE])
def test_where_the_cost_keeps_its_promise_nothing_changes(share: float) -> None:
    assert fitted(_quadratic(share)) is COVARIANCE


@pytest.mark.parametrize("share", [0.4, 0.1, 0.05])
def test_where_it_is_flatter_the_longest_axis_is_longer(share: float) -> None:
    wider = fitted(_quadratic(share))
    needed = float(np.sqrt(MIN_RISE_SHARE / share))
    assert np.sqrt(wider[0, 0] / COVARIANCE[0, 0]) == pytest.approx(needed)
    white = _valley(_quadratic(share), is_white=True)
    coarse = finish(fit_covariance(COVARIANCE, A, MEAN, white))
    assert needed <= np.sqrt(coarse[0, 0] / COVARIANCE[0, 0]) <= 1.5 * needed
    others = wider - COVARIANCE
    others[0, 0] = 0.0
    assert np.abs(others).max() < 1e-12


def test_one_flat_side_is_enough() -> None:
    def cost(x: Vector) -> float:
        return _quadratic(1.0 if x[0] < MEAN[0] else 0.1)(x)

    assert COVARIANCE[0, 0] < fitted(cost)[0, 0] < fitted(_quadratic(0.1))[0, 0]


@pytest.mark.parametrize("share", [0.4, 0.1])
def test_halves_of_two_widths_have_their_own_second_moment(share: float) -> None:
    """Drawn from a valley whose one side is flat, each side as often as it is wide."""

    def cost(x: Vector) -> float:
        return _quadratic(1.0 if x[0] < MEAN[0] else share)(x)

    wide = float(np.sqrt(MIN_RISE_SHARE / share))
    rng = np.random.default_rng(3)
    side = np.where(rng.random(200_000) < wide / (1.0 + wide), wide, -1.0)
    drawn = 3.0 * side * np.abs(rng.normal(size=200_000))
    wider = fitted(cost)
    assert wider[0, 0] == pytest.approx(np.mean(drawn**2), rel=0.02)


def test_a_plain_without_end_is_stretched_as_far_as_it_goes() -> None:
    wider = fitted(_plain)
    assert np.sqrt(wider[0, 0] / COVARIANCE[0, 0]) == pytest.approx(STRETCHES[-1])


def test_correlated_components_follow() -> None:
    P = np.array(COVARIANCE)
    P[0, 2] = P[2, 0] = 1.2
    wider = fitted(_plain, P, np.asarray(np.linalg.inv(P)))
    assert wider[0, 2] / wider[0, 0] == pytest.approx(P[0, 2] / P[0, 0])
    assert np.linalg.eigvalsh(wider)[0] > 0.0
    assert np.array_equal(wider, wider.T)


def test_without_uncertainty_there_is_nothing_to_stretch() -> None:
    nothing = np.zeros((4, 4))
    assert fitted(_plain, nothing) is nothing


def test_bearings_from_far_away_do_not_end_where_the_curvature_says() -> None:
    """Beyond the target lines of sight are nearly parallel: it may be farther, hardly nearer."""
    rng, p = np.random.default_rng(1), params(bearing_k=None)
    rows = np.full((60, 10), np.nan)
    rows[:, 0], rows[:, 1], rows[:, 2] = np.linspace(0.0, 6.0, 60), 0.0, 0.0
    rows[:, 4] = np.arctan2(80.0, 3.0 - rows[:, 0]) + 0.05 * rng.normal(size=60)
    rows[:, 6:9], rows[:, 9] = (1.0, 0.05, 0.1), np.arange(60)
    sigmas = rows[:, 6:9].T.copy()
    known = np.diag([0.0, 0.0, 1e6, 1e8])
    prior = (known, np.zeros(4), p.model)
    start = np.array([3.0, 60.0, 0.0, 0.0])
    mean, *_ = map_descent(rows, start, 1e-3, 25, p.thresholds, p.bounds, *prior)
    offs = measured_innovations(rows, mean, p.model)
    curvature, _, _ = normal_equations(rows, mean, offs, sigmas, p.thresholds, *prior)
    covariance = np.asarray(np.linalg.inv(curvature))

    def cost(x: Vector) -> float:
        offs = measured_innovations(rows, x, p.model)
        return float(map_cost(rows, offs, x, sigmas, p.thresholds, *prior))

    wider = finish(fit_covariance(covariance, curvature, mean, _valley(cost)))
    assert wider[1, 1] > 1.3**2 * covariance[1, 1]
    assert wider[0, 0] < 1.3**2 * covariance[0, 0]


def test_a_profiled_cost_is_held_to_the_profiled_curvature() -> None:
    """Correlated errors tilt the covariance against the curvature: no flat valley."""
    curvature = np.array(A)
    curvature[0, 2] = curvature[2, 0] = 0.6
    tilted = np.array(COVARIANCE)
    tilted[0, 2] = tilted[2, 0] = 1.2

    def cost(x: Vector) -> float:
        return 0.5 * float((x - MEAN) @ curvature @ (x - MEAN))

    def profiled(x: Vector) -> Steps[float]:
        yield 0
        return 0.5 * float(x[0] - MEAN[0]) ** 2 / float(np.linalg.inv(curvature)[0, 0])

    assert finish(fit_covariance(tilted, curvature, MEAN, Valley(cost, profiled, 1.0))) is tilted


@pytest.mark.parametrize("is_white", [True, False])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_where_the_cost_is_steeper_than_the_noise_explains_the_axis_is_shorter(
    noise: float, is_white: bool
) -> None:
    """A rise with the fourth power, as across a path on which the target lies."""
    at_edge = 2.45 * 3.0

    def cost(x: Vector) -> float:
        across = x - np.array([x[0] - MEAN[0], 0.0, 0.0, 0.0]) - MEAN
        return float(900.0 * ((x[0] - MEAN[0]) / at_edge) ** 4 + 0.5 * (across @ A @ across))

    valley = _valley(cost, noise=noise, is_white=is_white)
    shorter = finish(fit_covariance(COVARIANCE, A, MEAN, valley))
    wanted = 0.5 * 2.45**2 * noise / MIN_RISE_SHARE
    factor = (wanted / 900.0) ** 0.25
    assert np.sqrt(shorter[0, 0] / COVARIANCE[0, 0]) == pytest.approx(factor, rel=0.05)
    assert np.linalg.eigvalsh(shorter)[0] > 0.0


def test_one_steep_side_shrinks_alone() -> None:
    def cost(x: Vector) -> float:
        return _quadratic(1.0 if x[0] < MEAN[0] else 100.0)(x)

    assert 0.25 * COVARIANCE[0, 0] < fitted(cost)[0, 0] < COVARIANCE[0, 0]
