"""Bounded-window MAP: the paper's objective over a thinned history, re-linearised.

A recursive filter linearises every measurement once, where it stood at the time; started from a
ring of hypotheses it may settle next to the optimum and be sure of it. The window keeps up to N
measurements that are spread over different views of the target, and solves

    min over x, offsets of  sum rho(u_i) + range_offset^2 / 2 s_r^2 + bearing_offset^2 / 2 s_b^2

by damped, re-weighted Gauss-Newton from the filter's own hypotheses and from one fresh start per
call, which turns around the path from call to call: the cost of a call is bounded by N, and
every optimum is found in the end. Each optimum carries a sandwich covariance A^-1 B A^-1 whose B
counts the correlation of neighbouring residuals (Bartlett weights), because recorded ranges
repeat their errors; its small-sample bias is made up for by the fixed-bandwidth critical value.

Paper: eq. (9). Deviation: when the window is full, it is thinned where the vehicle lingered longest
instead of dropping the oldest, because old measurements often hold the only view from the other
side, and a thousand from one place say little more than a hundred.

Source: N. M. Kiefer and T. J. Vogelsang, Econometric Theory 21 (2005), for the critical value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.estimation.base import FilterParams
from companion.estimation.losses import threshold
from companion.geometry.arrays import Matrix, Vector
from companion.params import Params

MIN_MEASUREMENTS = 12
MAX_ITERATIONS = 25
STEP_TOLERANCE_M = 1e-4
DAMPING_START = 1e-3
DAMPING_MAX = 1e8
MIN_DISTANCE_M = 0.05
BANDWIDTH = 0.2
"""Lags that count as correlated, as a share of the window."""
CRITICAL_RATIO = (1.96 + 2.9694 * BANDWIDTH + 0.416 * BANDWIDTH**2 - 0.5324 * BANDWIDTH**3) / 1.96
MAX_POSITION_SIGMA_M = 200.0
"""An optimum vaguer than this is no place."""
MIN_SLOPE = 0.05
"""Least share of measurements on the quadratic part that curvature is believed to have."""
DEFINITE_SHARE = 1e-3
"""Share of the thermal covariance added to the others, so that they are positive definite."""
SAME_PLACE_M = 0.3
"""Optima nearer than this are one."""


class WindowParams(Params, frozen=True):
    """The window and how often it is solved."""

    enabled: bool = True
    """Whether the filter is checked and polished at all."""
    size: Annotated[int, msgspec.Meta(ge=32, le=4096)] = 256
    """Most measurements kept."""
    every: Annotated[int, msgspec.Meta(ge=1)] = 25
    """Measurements between two solutions."""
    starts: Annotated[int, msgspec.Meta(ge=1, le=64)] = 12
    """Directions of the fresh starts around the path."""


@dataclass(frozen=True, slots=True)
class Optimum:
    """A local minimum of the objective."""

    mean: Vector
    """(4,)"""
    cost: float
    covariance: Matrix
    """(4, 4), with correlation and the sandwich in it."""
    inflation: float
    """How much less the measurements say than white thermal noise would."""


@dataclass(frozen=True, slots=True)
class _Linearised:
    """The whitened problem at one point: residuals u and rows H / sigma, range rows first."""

    u: Vector
    H: Matrix
    order: Vector
    """Time order of the rows, for the correlation of neighbours."""


class WindowMap:
    """Solves the window.

    Args:
        filter_params: Noise, thresholds, priors and bounds, as the filter has them.
    """

    def __init__(self, filter_params: FilterParams) -> None:
        self._p = filter_params
        k_long, k_short = threshold(filter_params.range_k_long), filter_params.range_k_short
        self._range_band = (-threshold(k_short), k_long)
        k_bearing = threshold(filter_params.bearing_k)
        self._bearing_band = (-k_bearing, k_bearing)
        self._prior_information = np.array(
            [
                0.0,
                0.0,
                1.0 / filter_params.range_offset_sigma_m**2,
                1.0 / math.radians(filter_params.bearing_offset_sigma_deg) ** 2,
            ]
        )

    def optima(self, rows: Matrix, starts: Iterable[Vector]) -> list[Optimum]:
        """The distinct minima reached from `starts`, best first.

        Args:
            rows: (n, 8), see `MeasurementWindow`.
            starts: States (4,) to start from.
        """
        found: list[tuple[float, Vector]] = []
        for start in starts:
            solution = self.solve(rows, start)
            if solution is None:
                continue
            mean, cost = solution
            if all(math.dist(mean[:2], other[:2]) > SAME_PLACE_M for _, other in found):
                found.append((cost, mean))
        found.sort(key=lambda pair: pair[0])
        optima = (self._optimum(rows, mean, cost) for cost, mean in found)
        return [optimum for optimum in optima if optimum is not None]

    def solve(self, rows: Matrix, start: Vector) -> tuple[Vector, float] | None:
        """The minimum that a start leads to, with its cost; None if it leads nowhere."""
        mean = self._bounded(np.array(start, dtype=np.float64))
        damping = DAMPING_START
        with np.errstate(all="ignore"):
            for _ in range(MAX_ITERATIONS):
                sigmas = self._sigmas(rows, mean)
                cost = self._cost(rows, mean, sigmas)
                step = self._step(rows, mean, sigmas, cost, damping)
                if step is None:
                    break
                moved_m = math.dist(step[0][:2], mean[:2])
                mean, damping = step
                if moved_m < STEP_TOLERANCE_M:
                    break
            cost = self._cost(rows, mean, self._sigmas(rows, mean))
        if not (np.isfinite(mean).all() and math.isfinite(cost)):
            return None
        return mean, cost

    def start_around(self, rows: Matrix, direction_rad: float, spread: int) -> Vector:
        """A fresh start: off the middle of the path, as far as the ranges say.

        Args:
            rows: (n, 8).
            direction_rad: Where to, counter-clockwise from east.
            spread: Which distance to take where there are no ranges to tell.
        """
        east, north, up = rows[:, 0].mean(), rows[:, 1].mean(), rows[:, 2].mean()
        ranges = rows[~np.isnan(rows[:, 3]), 3]
        if ranges.size:
            rise_m = up - self._p.target_height_m
            distance_m = math.sqrt(max(float(np.median(ranges)) ** 2 - rise_m**2, 1.0))
        else:
            distance_m = 4.0 * 3.0 ** (spread % 3)
        place = (
            east + distance_m * math.cos(direction_rad),
            north + distance_m * math.sin(direction_rad),
        )
        return np.array([*place, 0.0, 0.0])

    def _bounded(self, mean: Vector) -> Vector:
        low = -math.inf if self._p.range_offset_min_m is None else self._p.range_offset_min_m
        high = math.inf if self._p.range_offset_max_m is None else self._p.range_offset_max_m
        mean[2] = min(max(mean[2], low), high)
        return mean

    def _sigmas(self, rows: Matrix, mean: Vector) -> tuple[Vector, Vector]:
        """Standard deviations of all ranges and bearings at `mean`, own position included."""
        own2 = self._p.own_position_sigma_m**2
        ground2 = np.maximum(((mean[:2] - rows[:, :2]) ** 2).sum(axis=1), MIN_DISTANCE_M**2)
        return np.sqrt(rows[:, 5] ** 2 + own2), np.sqrt(rows[:, 6] ** 2 + own2 / ground2)

    def _residuals(
        self, rows: Matrix, mean: Vector, sigmas: tuple[Vector, Vector]
    ) -> tuple[Vector, Vector]:
        """Whitened residuals of all rows, NaN where nothing was measured."""
        away = mean[:2] - rows[:, :2]
        rise = self._p.target_height_m - rows[:, 2]
        slant = np.sqrt((away**2).sum(axis=1) + rise**2)
        bearing = np.arctan2(away[:, 1], away[:, 0]) + mean[3]
        turn = np.remainder(rows[:, 4] - bearing + math.pi, 2.0 * math.pi) - math.pi
        return (rows[:, 3] - slant - mean[2]) / sigmas[0], turn / sigmas[1]

    def _cost(self, rows: Matrix, mean: Vector, sigmas: tuple[Vector, Vector]) -> float:
        ranges, bearings = self._residuals(rows, mean, sigmas)
        prior = 0.5 * float(self._prior_information @ mean**2)
        return (
            _loss_sum(ranges[~np.isnan(ranges)], *self._range_band)
            + _loss_sum(bearings[~np.isnan(bearings)], *self._bearing_band)
            + prior
        )

    def _linearised(self, rows: Matrix, mean: Vector, sigmas: tuple[Vector, Vector]) -> _Linearised:
        ranges, bearings = self._residuals(rows, mean, sigmas)
        away = mean[:2] - rows[:, :2]
        rise = self._p.target_height_m - rows[:, 2]
        ground2 = (away**2).sum(axis=1)
        slant = np.maximum(np.sqrt(ground2 + rise**2), MIN_DISTANCE_M)
        ground2 = np.maximum(ground2, MIN_DISTANCE_M**2)
        one, zero = np.ones(len(rows)), np.zeros(len(rows))
        by_range = np.stack([away[:, 0] / slant, away[:, 1] / slant, one, zero], axis=1)
        by_bearing = np.stack([-away[:, 1] / ground2, away[:, 0] / ground2, zero, one], axis=1)
        has_range, has_bearing = ~np.isnan(ranges), ~np.isnan(bearings)
        index = np.arange(len(rows), dtype=np.float64)
        return _Linearised(
            np.concatenate([ranges[has_range], bearings[has_bearing]]),
            np.concatenate(
                [
                    (by_range / sigmas[0][:, None])[has_range],
                    (by_bearing / sigmas[1][:, None])[has_bearing],
                ]
            ),
            np.concatenate([index[has_range], index[has_bearing]]),
        )

    def _bands(self, rows: Matrix) -> tuple[Vector, Vector]:
        """Lower and upper threshold of every linearised row."""
        n_range = int((~np.isnan(rows[:, 3])).sum())
        n_bearing = int((~np.isnan(rows[:, 4])).sum())
        low = np.repeat([self._range_band[0], self._bearing_band[0]], [n_range, n_bearing])
        high = np.repeat([self._range_band[1], self._bearing_band[1]], [n_range, n_bearing])
        return low, high

    def _step(
        self,
        rows: Matrix,
        mean: Vector,
        sigmas: tuple[Vector, Vector],
        cost: float,
        damping: float,
    ) -> tuple[Vector, float] | None:
        """One damped step that lowers the cost, with the next damping; None if none does."""
        problem = self._linearised(rows, mean, sigmas)
        psi = np.clip(problem.u, *self._bands(rows))
        weight = np.where(problem.u == psi, 1.0, psi / problem.u)
        A = problem.H.T @ (weight[:, None] * problem.H) + np.diag(self._prior_information)
        gradient = problem.H.T @ psi - self._prior_information * mean
        scale = np.diag(np.diag(A) + 1e-9)
        while damping < DAMPING_MAX:
            moved = self._bounded(mean + np.linalg.solve(A + damping * scale, gradient))
            if self._cost(rows, moved, sigmas) < cost:
                return moved, max(damping / 4.0, 1e-9)
            damping *= 8.0
        return None

    def _optimum(self, rows: Matrix, mean: Vector, cost: float) -> Optimum | None:
        """The optimum with its covariance, or None where the measurements name no place."""
        problem = self._linearised(rows, mean, self._sigmas(rows, mean))
        low, high = self._bands(rows)
        psi = np.clip(problem.u, low, high)
        prior = np.diag(self._prior_information)
        is_range = np.arange(len(psi)) < int((~np.isnan(rows[:, 3])).sum())
        slope = np.zeros(len(psi))
        for part in (is_range, ~is_range):
            if part.any():
                slope[part] = max(float(np.mean(psi[part] == problem.u[part])), MIN_SLOPE)
        A = problem.H.T @ (slope[:, None] * problem.H) + prior
        scores = np.zeros((len(rows), 4))
        np.add.at(scores, problem.order.astype(int), problem.H * psi[:, None])
        try:
            A_inverse: Matrix = np.linalg.inv(A).astype(np.float64)
            covariance, B = _sandwich(A_inverse, scores, prior)
            np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return None
        if math.sqrt(float(np.trace(covariance[:2, :2]))) > MAX_POSITION_SIGMA_M:
            return None
        inflation = max(1.0, float(np.trace(B @ A_inverse)) / len(mean))
        return Optimum(mean, cost, covariance, inflation)


def _loss_sum(u: Vector, low: float, high: float) -> float:
    """Sum of the asymmetric Huber loss with thresholds -low and high."""
    psi = np.clip(u, low, high)
    return float(np.sum(psi * (u - 0.5 * psi)))


def _sandwich(A_inverse: Matrix, scores: Matrix, prior: Matrix) -> tuple[Matrix, Matrix]:
    """The covariance A^-1 B A^-1 and its B: thermal, with white or with correlated scores.

    The one that leaves the position least certain is taken: residuals smaller than thermal noise
    promise nothing, correlation makes an estimate worse, and where a short window seems to say
    otherwise it is chance.
    """
    n, k = len(scores), len(prior)
    thermal: Matrix = np.linalg.inv(A_inverse).astype(np.float64)
    white = scores.T @ scores * (n / max(n - k, 1)) + prior
    correlated = CRITICAL_RATIO**2 * _long_run_variance(scores) + prior
    pairs = []
    for B in (thermal, white, correlated):
        covariance = A_inverse @ (B + DEFINITE_SHARE * thermal) @ A_inverse
        pairs.append((0.5 * (covariance + covariance.T), B))
    return max(pairs, key=lambda pair: float(np.trace(pair[0][:2, :2])))


def _long_run_variance(scores: Matrix) -> Matrix:
    """Sum of the scores' autocovariances with Bartlett weights, (k, k), positive semi-definite."""
    n = len(scores)
    bandwidth = max(1, int(BANDWIDTH * n))
    total: Matrix = scores.T @ scores
    for lag in range(1, bandwidth + 1):
        product = scores[lag:].T @ scores[:-lag]
        total = total + (1.0 - lag / (bandwidth + 1.0)) * (product + product.T)
    return total
