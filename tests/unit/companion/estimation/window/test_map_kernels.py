"""The MAP problem: its cost, its gradient, and the minimum that the solver finds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from companion.estimation.filters.kalman import asymmetric_huber_loss
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.map_kernels import (
    DAMPING_START,
    MAX_ITERATIONS,
    map_cost,
    map_descent,
    map_step,
    measured_innovations,
    normal_equations,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import START, params, reflected, truth, walk

CASES: dict[str, FilterParams] = {
    "one-sided": params(),
    "asymmetric": params(range_k_long=1.0, range_k_short=3.0),
    "quadratic": params(range_k_long=None, bearing_k=None),
    "height": params(target_height_sigma_m=3.0),
    "scale and height": params(range_scale_sigma=0.05, target_height_sigma_m=3.0),
}


class Problem:
    """The kernels' arguments for a walk, and its objective as a function of the state alone.

    Args:
        p: The filter's params; the vehicle knows its position, so that sigmas do not move.
        rows: (n, 10).
    """

    def __init__(self, p: FilterParams, rows: Matrix) -> None:
        self.rows, self.model = rows, p.model
        self.thresholds, self.bounds = p.thresholds, p.bounds
        mean, sigmas = p.prior
        self.information = np.diag(np.where(np.arange(mean.size) < 2, 0.0, 1.0 / sigmas**2))
        self.pull = self.information @ mean
        self.start = np.append(START, mean[4:])

    def sigmas(self, mean: Vector) -> Matrix:
        found: Matrix = row_sigmas(self.rows, mean, self.model)
        return found

    def offs(self, mean: Vector) -> Matrix:
        found: Matrix = measured_innovations(self.rows, mean, self.model)
        return found

    def cost(self, mean: Vector) -> float:
        prior = (self.information, self.pull, self.model)
        sigmas = self.sigmas(mean)
        return float(map_cost(self.rows, self.offs(mean), mean, sigmas, self.thresholds, *prior))

    def system(self, mean: Vector) -> tuple[Matrix, Vector]:
        prior = (self.information, self.pull, self.model)
        A, descent, _ = normal_equations(
            self.rows, mean, self.offs(mean), self.sigmas(mean), self.thresholds, *prior
        )
        return A, descent

    def step(self, mean: Vector, damping: float) -> tuple[Vector, float]:
        prior = (self.information, self.pull, self.model)
        moved, offs, after, *_ = map_step(
            self.rows, mean, self.offs(mean), damping, self.thresholds, self.bounds, *prior
        )
        np.testing.assert_array_equal(offs, self.offs(moved))
        return moved, after

    def minimum(self, start: Vector) -> tuple[Vector, float]:
        prior = (self.information, self.pull, self.model)
        most = MAX_ITERATIONS
        mean, *_ = map_descent(
            self.rows, start, DAMPING_START, most, self.thresholds, self.bounds, *prior
        )
        return mean, self.cost(mean)


def _problem(p: FilterParams, seed: int = 1, share: float = 0.4) -> Problem:
    """A walk with reflections and with gaps in every modality."""
    rng = np.random.default_rng(seed)
    rows = reflected(rng, walk(rng, 120, elevations=True), share)
    rows[:, 3:6][rng.random((120, 3)) < 0.2] = np.nan
    return Problem(p, rows)


@pytest.fixture(params=CASES)
def p(request: pytest.FixtureRequest) -> FilterParams:
    return CASES[request.param]


def test_the_cost_is_the_sum_of_the_losses_and_of_the_prior(p: FilterParams) -> None:
    problem = _problem(p)
    mean = problem.start
    u = row_residuals(problem.rows, mean, problem.sigmas(mean), problem.model)
    losses = sum(
        asymmetric_huber_loss(float(v), *problem.thresholds[modality])
        for modality in range(3)
        for v in u[modality]
    )
    prior = 0.5 * mean @ problem.information @ mean - problem.pull @ mean
    assert problem.cost(mean) == pytest.approx(losses + prior, rel=1e-12)


def test_the_descent_is_the_slope_of_the_cost(p: FilterParams) -> None:
    problem = _problem(p)
    A, descent = problem.system(problem.start)
    for index, unit in enumerate(np.eye(problem.start.size)):
        h = 1e-6
        slope = (
            problem.cost(problem.start + h * unit) - problem.cost(problem.start - h * unit)
        ) / (2.0 * h)
        assert descent[index] == pytest.approx(-slope, rel=1e-5, abs=1e-3)
    assert np.array_equal(A, A.T) or np.allclose(A, A.T, rtol=1e-12)
    assert np.linalg.eigvalsh(A)[0] > 0.0


def test_what_was_not_measured_neither_costs_nor_pulls(p: FilterParams) -> None:
    problem = _problem(p)
    silent = np.array(problem.rows[:30])
    silent[:, 3:6] = np.nan
    more = Problem(p, np.concatenate([problem.rows, silent]))
    assert more.cost(problem.start) == pytest.approx(problem.cost(problem.start), rel=1e-12)
    for one, other in zip(more.system(problem.start), problem.system(problem.start), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_it_finds_the_minimum_that_scipy_finds_from_the_same_start(
    p: FilterParams, seed: int
) -> None:
    problem = _problem(p, seed)
    units = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 1.0])[: problem.start.size]
    found = minimize(
        lambda s: problem.cost(problem.start + units * s),
        np.zeros(units.size),
        method="BFGS",
        options={"gtol": 1e-6},
    )
    mean, cost = problem.minimum(problem.start)
    assert cost <= float(found.fun) + 1e-6
    np.testing.assert_allclose((mean - problem.start) / units, found.x, rtol=0.0, atol=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_with_bounds_too(seed: int) -> None:
    p = params(range_offset_min_m=0.0, range_offset_max_m=1.0, bearing_offset_max_deg=1.0)
    problem = _problem(p, seed)
    units = np.array([1.0, 1.0, 1.0, 0.02])
    inside = np.clip((problem.bounds - problem.start) / units, -1e3, 1e3)
    found = minimize(
        lambda s: problem.cost(problem.start + units * s),
        np.zeros(4),
        method="L-BFGS-B",
        bounds=list(zip(*inside, strict=True)),
        options={"ftol": 1e-14, "gtol": 1e-7},
    )
    mean, cost = problem.minimum(problem.start)
    assert (problem.bounds[0] <= mean).all()
    assert (mean <= problem.bounds[1]).all()
    assert cost <= float(found.fun) + 1e-6
    np.testing.assert_allclose((mean - problem.start) / units, found.x, rtol=0.0, atol=2e-3)


def test_a_start_out_of_bounds_is_brought_in_first() -> None:
    p = params(range_offset_min_m=0.0, range_offset_max_m=1.0)
    problem = _problem(p)
    mean, _ = problem.minimum(np.array([35.0, 20.0, 50.0, 0.0]))
    assert mean[2] == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_plain_reweighted_gauss_newton_descends(p: FilterParams, seed: int) -> None:
    """Undamped, from next to the target: each step majorises the losses, so none goes up."""
    problem = _problem(p, seed)
    mean, costs = problem.start, []
    for _ in range(30):
        costs.append(problem.cost(mean))
        mean = mean + np.linalg.solve(*problem.system(mean))
    assert (np.diff(costs) <= 1e-9 * np.abs(costs[1:])).all()
    assert costs[-1] == pytest.approx(problem.minimum(problem.start)[1], abs=1e-2)


@pytest.mark.parametrize("away_m", [0.0, 30.0, 300.0])
def test_no_damped_step_goes_up(p: FilterParams, away_m: float) -> None:
    problem = _problem(p)
    mean, damping = problem.start + np.eye(problem.start.size)[1] * away_m, 1e-3
    for _ in range(15):
        moved, damping = problem.step(mean, damping)
        assert problem.cost(moved) <= problem.cost(mean)
        mean = moved


def test_at_the_minimum_a_step_stays() -> None:
    problem = _problem(params())
    mean, _ = problem.minimum(problem.start)
    for _ in range(100):
        moved, _ = problem.step(mean, 1e-3)
        if moved is mean:
            break
        mean = moved
    again, damping = problem.step(mean, 1e-3)
    assert again is mean
    assert damping > 1e6


def test_a_gaussian_prior_joins() -> None:
    """An overwhelming one is the answer; an equal one moves it half way."""
    problem = _problem(params(range_k_long=None, bearing_k=None), share=0.0)
    free, _ = problem.minimum(problem.start)
    elsewhere = free + np.array([0.05, -0.04, 0.02, 0.001])
    A, _ = problem.system(free)
    for times, share in ((1e9, 1.0), (1.0, 0.5)):
        joined = _problem(params(range_k_long=None, bearing_k=None), share=0.0)
        joined.information = joined.information + times * A
        joined.pull = joined.pull + times * A @ elsewhere
        mean, _ = joined.minimum(free)
        np.testing.assert_allclose(mean - free, share * (elsewhere - free), rtol=0.05, atol=1e-6)


def test_a_noiseless_walk_is_solved_exactly() -> None:
    p = params(
        range_scale_sigma=1.0,
        target_height_sigma_m=1e3,
        range_offset_sigma_m=1e4,
        bearing_offset_sigma_deg=1e4,
    )
    rows = walk(np.random.default_rng(1), elevations=True, noise=0.0, height_m=3.0, scale=0.04)
    mean, cost = Problem(p, rows).minimum(np.append(START, [0.0, 0.0]))
    expected = truth(6)
    expected[4:] = 0.04, 3.0
    np.testing.assert_allclose(mean, expected, rtol=0.0, atol=1e-3)
    assert cost == pytest.approx(0.0, abs=1e-3)


def test_own_position_counts_in_every_sigma() -> None:
    rows = walk(np.random.default_rng(1), 3)
    rows[0, :3] = [*truth()[:2], 0.0]  # at the target: as from a hand's breadth
    model = FilterParams(own_position_sigma_m=0.3).model
    sigmas = row_sigmas(rows, truth(), model)
    assert sigmas[0] == pytest.approx([math.hypot(0.5, 0.3)] * 3)
    away = truth()[:2] - rows[2, :2]
    ground_m = float(np.hypot(*away))
    assert sigmas[1, 2] == pytest.approx(math.hypot(0.03, 0.3 / ground_m))
    assert sigmas[2, 2] == pytest.approx(math.hypot(0.05, 0.3 / math.hypot(ground_m, 10.0)))
    assert sigmas[1, 0] == pytest.approx(math.hypot(0.03, 0.3 / 0.05))
