"""The paper's objective over a whole run, solved now and then: what corrects a recursive filter.

The filter linearises every measurement once, where it stood at the time, and may be carried away
for good by what it took in while it was wrong. Whenever the history has grown by a share, the
objective over all of it is minimised from the filter's mean and from one fresh start, which turns
around the path from solution to solution. The lower minimum becomes the filter's mean, with the
curvature there as its information.

Paper: eq. (9). This is the window of `companion.estimation.window_map`, which is never full here,
without what makes the tracker's covariance honest (sandwich, rivals, older evidence): the studies'
system `map` in a compiled loop, beside the system `tracker`, which is the companion's own. The
arithmetic of `companion.estimation.map_kernels` is made of whole arrays, because it runs without a
compiler, too; the studies solve the window millions of times, always compiled, in the plane and
with four unknowns, so that one loop over the rows is worth its second writing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.estimation.filters.robust_update import wrapped
from companion.estimation.measurement_model import RANGE_OFFSET
from companion.estimation.window.map_kernels import (
    DAMPING_MAX,
    DAMPING_START,
    MAX_ITERATIONS,
    MIN_DISTANCE_M,
    STEP_TOLERANCE_M,
    hold_at_bounds,
)
from companion.kernel import Matrix, Vector, kernel

EAST, NORTH, RANGE, BEARING = range(4)
"""Columns of a history: the sensor's place, and what it measured there."""

FIRST_COUNT = 4
"""Measurements before the first solution: as many as there are unknowns twice over."""
EARLY_COUNT = 50
EARLY_GROWTH, LATE_GROWTH = 0.15, 0.5
"""The history is solved whenever it has grown by this share, up to `EARLY_COUNT` and after it."""
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
LEAST_RANGE_M = 1.0
EARLY_TOLERANCE_M = 1e-3
"""A step shorter than this ends an early solution: the next one follows soon."""
LEAST_SCALE = 1e-9
"""What damping takes the curvature of something unseen for, as the companion's window does."""
LEAST_PIVOT = 1e-300
BETTER_COST = 1e-6
"""A fresh start's minimum wins if it is lower by this: rounding must not decide."""


class Window(NamedTuple):
    """What the objective takes for granted, as the kernels take it."""

    is_solved: bool
    """False: the filter is left alone."""
    sigma: Vector
    """(3,) thermal noise of range, bearing and elevation."""
    own_sigma_m: float
    """Of the sensor's own place."""
    thresholds: Matrix
    """(3, 2)"""
    bounds: Matrix
    """(2, 4)"""
    information: Matrix
    """(4, 4) of the Gaussian prior."""
    pull: Vector
    """(4,)"""
    prior_mean: Vector
    """(4,)"""


def prior_of(mean: Vector, sigmas: Vector) -> tuple[Matrix, Vector]:
    """Information and pull of the priors of the offsets; the position's is flat (paper, IV-A)."""
    weights = 1.0 / sigmas**2
    weights[:RANGE_OFFSET] = 0.0
    return np.diag(weights), weights * mean


@kernel
def next_solution(count: int) -> int:
    """The number of measurements at which the history is solved again."""
    growth = EARLY_GROWTH if count < EARLY_COUNT else LATE_GROWTH
    return count + max(1, int(growth * count))


@kernel
def fresh_start(rows: Matrix, turn: int, prior_mean: Vector) -> Vector:
    """A state off the middle of the path, as far as the ranges say, in the next direction.

    Args:
        rows: (k, 4).
        prior_mean: (4,).
    """
    direction_rad = GOLDEN_ANGLE_RAD * turn
    distance_m = max(float(np.median(rows[:, RANGE])), LEAST_RANGE_M)
    start = prior_mean.copy()
    start[0] = rows[:, EAST].mean() + distance_m * math.cos(direction_rad)
    start[1] = rows[:, NORTH].mean() + distance_m * math.sin(direction_rad)
    return start


@kernel
def clipped_residual(residual: float, k_long: float, k_short: float) -> float:
    """Influence of a whitened residual: itself between the thresholds."""
    return min(max(residual, -k_short), k_long)


@kernel
def cost_of(rows: Matrix, mean: Vector, window: Window) -> float:
    """The objective at `mean`: robust losses and prior.

    Args:
        rows: (k, 4).
        mean: (4,).
    """
    range_long, range_short = window.thresholds[0, 0], window.thresholds[0, 1]
    bearing_long, bearing_short = window.thresholds[1, 0], window.thresholds[1, 1]
    own2, floor2 = window.own_sigma_m * window.own_sigma_m, MIN_DISTANCE_M * MIN_DISTANCE_M
    range_sigma = math.sqrt(window.sigma[0] * window.sigma[0] + own2)
    bearing2 = window.sigma[1] * window.sigma[1]
    known = np.dot(window.information, mean)
    cost = 0.5 * np.dot(mean, known) - np.dot(window.pull, mean)
    for index in range(rows.shape[0]):
        de, dn = mean[0] - rows[index, EAST], mean[1] - rows[index, NORTH]
        ground2 = de * de + dn * dn
        u = (rows[index, RANGE] - math.sqrt(ground2) - mean[2]) / range_sigma
        psi = clipped_residual(u, range_long, range_short)
        cost += psi * (u - 0.5 * psi)
        bearing_sigma = math.sqrt(bearing2 + own2 / max(ground2, floor2))
        u = wrapped(rows[index, BEARING] - math.atan2(dn, de) - mean[3]) / bearing_sigma
        psi = clipped_residual(u, bearing_long, bearing_short)
        cost += psi * (u - 0.5 * psi)
    return float(cost)


@kernel
def system_at(rows: Matrix, mean: Vector, window: Window) -> tuple[Matrix, Vector]:
    """The re-weighted Gauss-Newton system at `mean`: matrix (4, 4) and descent (4,).

    Summed up entry by entry: a range says nothing of the bearing's offset, nor the other way round.
    """
    range_long, range_short = window.thresholds[0, 0], window.thresholds[0, 1]
    bearing_long, bearing_short = window.thresholds[1, 0], window.thresholds[1, 1]
    own2, floor2 = window.own_sigma_m * window.own_sigma_m, MIN_DISTANCE_M * MIN_DISTANCE_M
    range_sigma = math.sqrt(window.sigma[0] * window.sigma[0] + own2)
    bearing2 = window.sigma[1] * window.sigma[1]
    ee = en = nn = er = nr = rr = eb = nb = bb = 0.0
    by_e = by_n = by_r = by_b = 0.0
    for index in range(rows.shape[0]):
        de, dn = mean[0] - rows[index, EAST], mean[1] - rows[index, NORTH]
        distance_m = math.sqrt(de * de + dn * dn)
        ground2 = max(distance_m * distance_m, floor2)
        ground = math.sqrt(ground2)
        u = (rows[index, RANGE] - distance_m - mean[2]) / range_sigma
        psi = clipped_residual(u, range_long, range_short)
        weight = 1.0 if psi == u else psi / u
        he, hn, hr = de / (ground * range_sigma), dn / (ground * range_sigma), 1.0 / range_sigma
        ee += weight * he * he
        en += weight * he * hn
        nn += weight * hn * hn
        er += weight * he * hr
        nr += weight * hn * hr
        rr += weight * hr * hr
        by_e += psi * he
        by_n += psi * hn
        by_r += psi * hr
        bearing_sigma = math.sqrt(bearing2 + own2 / ground2)
        u = wrapped(rows[index, BEARING] - math.atan2(dn, de) - mean[3]) / bearing_sigma
        psi = clipped_residual(u, bearing_long, bearing_short)
        weight = 1.0 if psi == u else psi / u
        he, hn, hb = (
            -dn / (ground2 * bearing_sigma),
            de / (ground2 * bearing_sigma),
            1.0 / bearing_sigma,
        )
        ee += weight * he * he
        en += weight * he * hn
        nn += weight * hn * hn
        eb += weight * he * hb
        nb += weight * hn * hb
        bb += weight * hb * hb
        by_e += psi * he
        by_n += psi * hn
        by_b += psi * hb
    curvature = window.information + np.array(
        [[ee, en, er, eb], [en, nn, nr, nb], [er, nr, rr, 0.0], [eb, nb, 0.0, bb]]
    )
    descent = np.array([by_e, by_n, by_r, by_b]) + window.pull - np.dot(window.information, mean)
    return curvature, descent


@kernel
def damped_step(curvature: Matrix, descent: Vector, damping: float) -> Vector:
    """The solution of (A + damping diag(A)) step = descent, (4,), by Cholesky factors.

    The same as with `numpy.linalg.solve`, whose call alone takes longer than a short history.
    """
    n = descent.size
    factor, step = np.zeros((n, n)), descent.copy()
    for i in range(n):
        for j in range(i + 1):
            left = curvature[i, j]
            if i == j:
                left += damping * (curvature[i, i] + LEAST_SCALE)
            for k in range(j):
                left -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(left, LEAST_PIVOT)) if i == j else left / factor[j, j]
    for i in range(n):
        for k in range(i):
            step[i] -= factor[i, k] * step[k]
        step[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    return step


@kernel
def minimum(rows: Matrix, start: Vector, window: Window) -> tuple[Vector, float]:
    """The minimum that a start leads to, (4,), and its cost; see `map_kernels.map_minimum`."""
    bounds = window.bounds
    mean = np.minimum(np.maximum(start, bounds[0]), bounds[1])
    cost, damping = cost_of(rows, mean, window), DAMPING_START
    tolerance_m = EARLY_TOLERANCE_M if rows.shape[0] < EARLY_COUNT else STEP_TOLERANCE_M
    for _ in range(MAX_ITERATIONS):
        curvature, descent = system_at(rows, mean, window)
        hold_at_bounds(curvature, descent, mean, bounds)
        moved_m = 0.0
        while damping < DAMPING_MAX:
            moved = mean + damped_step(curvature, descent, damping)
            moved = np.minimum(np.maximum(moved, bounds[0]), bounds[1])
            moved_cost = cost_of(rows, moved, window)
            if moved_cost < cost:
                moved_m = math.hypot(moved[0] - mean[0], moved[1] - mean[1])
                mean, cost, damping = moved, moved_cost, max(damping / 4.0, 1e-9)
                break
            damping *= 8.0
        if moved_m < tolerance_m:
            break
    return mean, cost


@kernel
def solved(rows: Matrix, mean: Vector, turn: int, window: Window) -> tuple[Vector, Matrix]:
    """The lower of two minima, (4,), and its covariance, (4, 4).

    Args:
        rows: (k, 4) the history so far.
        mean: (4,) of the filter.
        turn: Number of the solution: where the fresh start lies.
    """
    best, cost = minimum(rows, mean, window)
    other, other_cost = minimum(rows, fresh_start(rows, turn, window.prior_mean), window)
    if other_cost < cost - BETTER_COST:
        best = other
    curvature, _ = system_at(rows, best, window)
    return best, np.ascontiguousarray(np.linalg.inv(curvature))
