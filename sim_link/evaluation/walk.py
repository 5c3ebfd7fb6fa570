"""A run of a recursive filter as one compiled loop: measure, update, record, fly on.

The loop calls the very kernels that the filter and planner classes are made of; `objects` is the
same loop over those classes, for what is not a kernel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.estimation.admm_ekf import admm_update
from companion.estimation.robust_update import robust_update
from companion.geometry.arrays import Matrix, Vector
from companion.kernel import kernel
from companion.models.ranging_model import RangingModel
from companion.planning.fim import STAY, best_candidate
from companion.planning.latch import LATCH_SIZE, LatchRule, latched_step, overshoot_m
from companion.planning.reactive_crossing import reactive_step
from sim_link.evaluation.noise import Truth, measured
from sim_link.evaluation.tracks import stepped

FIXED, REACTIVE, LATCHED, FIM = range(4)
"""Planners: a given track, or one of those that follow the estimate."""

VEHICLE_EAST, VEHICLE_NORTH, EAST, NORTH, RANGE_OFFSET, BEARING_OFFSET = range(6)
VARIANCE_EAST, COVARIANCE, VARIANCE_NORTH = range(6, 9)
"""Columns of a record: the sensor's place, and the estimate after its measurement."""
COLUMNS = 9


class Belief(NamedTuple):
    """What a recursive filter believes, as the kernels take it."""

    sigma: Vector
    """(3,) noise of range, bearing and elevation."""
    thresholds: Matrix
    """(3, 2)"""
    bounds: Matrix
    """(2, n)"""
    prior_mean: Vector
    """(n,)"""
    prior_sigmas: Vector
    """(n,)"""
    inflation: Vector
    """(3,) factors on the variances; ones, as the paper's filters have it."""
    model: RangingModel
    iterations: int
    """Of the splitting; 0: the closed form."""
    penalty: float
    """Of the splitting."""


class Steering(NamedTuple):
    """A planner with its parameters, as the kernels take it."""

    planner: int
    step_m: float
    crossing_distance_m: float
    stop_distance_m: float
    latch: LatchRule
    ring_m: Matrix
    """(HEADINGS, 2) candidates of FIM."""
    may_fly: NDArray[np.bool_]
    """(HEADINGS,)"""


@kernel
def first_fix(
    east_m: float, north_m: float, range_m: float, bearing_rad: float, belief: Belief
) -> tuple[Vector, Matrix]:
    """Mean and covariance after the first measurement, inverted with the offsets' prior means."""
    mean = belief.prior_mean.copy()
    distance_m = max(range_m, 1.0)
    mean[0] = east_m + distance_m * math.cos(bearing_rad)
    mean[1] = north_m + distance_m * math.sin(bearing_rad)
    return mean, np.diag(belief.prior_sigmas * belief.prior_sigmas)


@kernel
def updated(
    mean: Vector, covariance: Matrix, sensor_enu_m: Vector, z: Vector, belief: Belief
) -> tuple[Vector, Matrix]:
    """Mean and covariance after a measurement; those given where it would spoil them."""
    if belief.iterations > 0:
        mean, covariance, _, _ = admm_update(
            mean,
            covariance,
            sensor_enu_m,
            z,
            belief.sigma,
            0.0,
            belief.inflation,
            belief.thresholds,
            belief.bounds,
            belief.model,
            belief.iterations,
            belief.penalty,
        )
        return mean, covariance
    mean, covariance, _, _ = robust_update(
        mean,
        covariance,
        sensor_enu_m,
        z,
        belief.sigma,
        0.0,
        belief.inflation,
        belief.thresholds,
        belief.bounds,
        belief.model,
    )
    return mean, covariance


@kernel
def informed_place(
    east_m: float,
    north_m: float,
    mean: Vector,
    covariance: Matrix,
    belief: Belief,
    steering: Steering,
) -> tuple[float, float]:
    """Where the FIM planner flies next: the end of the best candidate, or nowhere."""
    index = best_candidate(
        covariance,
        mean[0] - east_m,
        mean[1] - north_m,
        0.0,
        steering.ring_m,
        steering.may_fly,
        belief.sigma[0] * belief.sigma[0],
        belief.sigma[1] * belief.sigma[1],
        True,
    )
    if index == STAY:
        return east_m, north_m
    return east_m + steering.ring_m[index, 0], north_m + steering.ring_m[index, 1]


@kernel
def next_place(
    east_m: float,
    north_m: float,
    mean: Vector,
    covariance: Matrix,
    latch: Vector,
    belief: Belief,
    steering: Steering,
) -> tuple[float, float, Vector]:
    """Where a planner that follows the estimate flies next, and its latch."""
    if steering.planner == REACTIVE:
        east_m, north_m = reactive_step(
            east_m,
            north_m,
            mean[0],
            mean[1],
            steering.step_m,
            steering.crossing_distance_m,
            steering.stop_distance_m,
        )
        return east_m, north_m, latch
    if steering.planner == LATCHED:
        over_m = overshoot_m(
            covariance[0, 0], covariance[0, 1], covariance[1, 1], 0.0, steering.latch
        )
        latch = latched_step(latch, east_m, north_m, mean[0], mean[1], over_m, True, steering.latch)
        east_m, north_m = stepped(east_m, north_m, latch[0], latch[1], steering.step_m)
        return east_m, north_m, latch
    east_m, north_m = informed_place(east_m, north_m, mean, covariance, belief, steering)
    return east_m, north_m, latch


@kernel
def walked(
    draws: Matrix,
    track: Matrix,
    start: Vector,
    truth: Truth,
    belief: Belief,
    steering: Steering,
) -> Matrix:
    """The record of a run, (steps, 9).

    Args:
        draws: (steps, 5) of the channel.
        track: (steps, 2) the places to measure from; of planners that follow the estimate only
            the first counts.
        start: (2,) place of the first estimate; NaN: from the first measurement.
        truth: What is true.
        belief: What the filter believes.
        steering: Where it flies.
    """
    steps = draws.shape[0]
    record = np.empty((steps, COLUMNS))
    mean, covariance = first_fix(0.0, 0.0, 1.0, 0.0, belief)
    mean[:2] = start
    latch = np.zeros(LATCH_SIZE)
    east_m, north_m = float(track[0, 0]), float(track[0, 1])
    z, sensor = np.full(3, np.nan), np.zeros(3)
    for step in range(steps):
        if steering.planner == FIXED:
            east_m, north_m = float(track[step, 0]), float(track[step, 1])
        z[0], z[1] = measured(draws[step], east_m, north_m, truth)
        if math.isnan(mean[0]):
            mean, covariance = first_fix(east_m, north_m, z[0], z[1], belief)
        else:
            sensor[0], sensor[1] = east_m, north_m
            mean, covariance = updated(mean, covariance, sensor, z, belief)
        row = record[step]
        row[VEHICLE_EAST], row[VEHICLE_NORTH] = east_m, north_m
        row[EAST : BEARING_OFFSET + 1] = mean[:4]
        row[VARIANCE_EAST], row[COVARIANCE], row[VARIANCE_NORTH] = (
            covariance[0, 0],
            covariance[0, 1],
            covariance[1, 1],
        )
        if steering.planner != FIXED:
            east_m, north_m, latch = next_place(
                east_m, north_m, mean, covariance, latch, belief, steering
            )
    return record
