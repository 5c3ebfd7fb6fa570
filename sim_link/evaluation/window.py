"""The paper's objective over a whole run, solved now and then: what corrects a recursive filter.

The filter linearises every measurement once, where it stood at the time, and may be carried away
for good by what it took in while it was wrong. Whenever the history has grown by a share, the
objective over all of it is minimised from the filter's mean and from one fresh start, which turns
around the path from solution to solution. The lower minimum becomes the filter's mean, with the
curvature there as its information.

Paper: eq. (9). This is the window of `companion.estimation.window_map`, which is never full here,
without what makes the tracker's covariance honest (sandwich, rivals, older evidence): the studies'
system `map` in a compiled loop, beside the system `tracker`, which is the companion's own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.estimation.map_kernels import COLUMNS as ROW_COLUMNS
from companion.estimation.map_kernels import (
    SEQUENCE,
    SIGMAS,
    VALUES,
    map_minimum,
    normal_equations,
    row_sigmas,
)
from companion.geometry.arrays import Matrix, Vector
from companion.kernel import kernel
from companion.models.ranging_model import RANGE_OFFSET, RangingModel

FIRST_COUNT = 4
"""Measurements before the first solution: as many as there are unknowns twice over."""
EARLY_COUNT = 50
EARLY_GROWTH, LATE_GROWTH = 0.15, 0.5
"""The history is solved whenever it has grown by this share, up to `EARLY_COUNT` and after it."""
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
LEAST_RANGE_M = 1.0
BETTER_COST = 1e-6
"""A fresh start's minimum wins if it is lower by this: rounding must not decide."""


class Window(NamedTuple):
    """What the objective takes for granted, as the kernels take it."""

    is_solved: bool
    """False: the filter is left alone."""
    thresholds: Matrix
    """(3, 2)"""
    bounds: Matrix
    """(2, n)"""
    information: Matrix
    """(n, n) of the Gaussian prior."""
    pull: Vector
    """(n,)"""
    prior_mean: Vector
    """(n,)"""
    model: RangingModel


def window_of(
    prior_mean: Vector,
    prior_sigmas: Vector,
    thresholds: Matrix,
    bounds: Matrix,
    model: RangingModel,
    *,
    is_solved: bool,
) -> Window:
    """The objective with priors on the offsets alone: the position's is flat (paper, IV-A)."""
    weights = 1.0 / prior_sigmas**2
    weights[:RANGE_OFFSET] = 0.0
    return Window(
        is_solved, thresholds, bounds, np.diag(weights), weights * prior_mean, prior_mean, model
    )


@kernel
def empty_rows(steps: int) -> Matrix:
    """A history with room for so many measurements, (steps, 10)."""
    return np.full((steps, ROW_COLUMNS), np.nan)


@kernel
def remember(rows: Matrix, step: int, sensor_enu_m: Vector, z: Vector, sigma: Vector) -> None:
    """Put a measurement into a history, in place."""
    row = rows[step]
    row[:VALUES] = sensor_enu_m
    row[VALUES:SIGMAS] = z
    row[SIGMAS:SEQUENCE] = sigma
    row[SEQUENCE] = step


@kernel
def next_solution(count: int) -> int:
    """The number of measurements at which the history is solved again."""
    growth = EARLY_GROWTH if count < EARLY_COUNT else LATE_GROWTH
    return count + max(1, int(growth * count))


@kernel
def fresh_start(rows: Matrix, turn: int, prior_mean: Vector) -> Vector:
    """A state off the middle of the path, as far as the ranges say, in the next direction."""
    direction_rad = GOLDEN_ANGLE_RAD * turn
    distance_m = max(float(np.median(rows[:, VALUES])), LEAST_RANGE_M)
    start = prior_mean.copy()
    start[0] = rows[:, 0].mean() + distance_m * math.cos(direction_rad)
    start[1] = rows[:, 1].mean() + distance_m * math.sin(direction_rad)
    return start


@kernel
def solved(rows: Matrix, mean: Vector, turn: int, window: Window) -> tuple[Vector, Matrix]:
    """The lower of two minima, (n,), and its covariance, (n, n).

    Args:
        rows: (k, 10) the history so far.
        mean: (n,) of the filter.
        turn: Number of the solution: where the fresh start lies.
        window: The rest of the objective.
    """
    thresholds, bounds = window.thresholds, window.bounds
    information, pull, model = window.information, window.pull, window.model
    best, cost = map_minimum(rows, mean, thresholds, bounds, information, pull, model)
    start = fresh_start(rows, turn, window.prior_mean)
    other, other_cost = map_minimum(rows, start, thresholds, bounds, information, pull, model)
    if other_cost < cost - BETTER_COST:
        best = other
    sigmas = row_sigmas(rows, best, model)
    curvature, _, _ = normal_equations(rows, best, sigmas, thresholds, information, pull, model)
    return best, np.ascontiguousarray(np.linalg.inv(curvature))
