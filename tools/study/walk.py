"""A run of a recursive filter as one compiled loop: measure, update, record, fly on.

The loop calls the very kernels that the filter and planner classes are made of; `systems` has the
same loop over those classes, for systems without kernels. Two things belong to the studies alone.

The paper's FIM planner to the letter maximises one expected measurement's information,

    s* = argmax over s of lambda_min( H_p(s)^T R^-1 H_p(s) ).

H_p is the position's part of the partials, R the thermal variances. There is no prior information
in it, and the offsets are assumed known. The partials of range and bearing are orthogonal, so the
eigenvalues are theirs,

    lambda_min = min( 1 / sigma_r^2,  1 / (distance sigma_theta)^2 ),

and nearer to the estimate than sigma_r / sigma_theta (43 m in the canonical scenario) the criterion
is flat: every candidate is as good as every other. One of the best is picked at random, as rounding
does in an eigenvalue routine. The planner that flies, `companion.planning.fim`, maximises the
measurement's addition to the information in the filter instead. Paper: eq. (FIM planning
objective). Deviation: the paper leaves candidates and ties open; the candidates are those of that
planner.

The system `map` solves the paper's objective over a whole run at intervals. A filter linearises
every measurement once, at its state of that time, and may be carried away for good by measurements
that it fused while it was wrong. Whenever the history has grown by a share, the objective over all
of it is minimised from the filter's mean and from one fresh start, which turns around the path from
solution to solution, and ends where it comes near the first minimum. The lower minimum becomes the
filter's mean, with the curvature there as its information. The minimum is that of the companion's
window (paper, eq. 9), which is never full here, without the parts that make the tracker's
covariance consistent (sandwich, rivals, older evidence): the system `tracker` is the companion's
own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.estimation.filters.kalman import robust_update
from companion.estimation.measurement_model import RangingModel
from companion.estimation.window import map_kernels
from companion.estimation.window.map_kernels import (
    DAMPING_START,
    MAX_ITERATIONS,
    map_step,
    measured_innovations,
    normal_equations,
    row_sigmas,
)
from companion.estimation.window.window_map import SAME_OPTIMUM_M
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector, kernel
from companion.planning.fim import STAY, FieldOfView, best_candidate
from companion.planning.views import (
    KEPT,
    NO_LATCH,
    Latch,
    LatchRule,
    latch_verdict,
    new_latch,
    next_direction,
    overshoot_m,
)
from sim_link.world.environment import NO_MEMORY
from tools.study.admm_ekf import admm_update
from tools.study.case import RunTruth, Scene, measured_in, stepped
from tools.study.reactive_crossing import reactive_step

FLAT_SHARE = 1e-9
"""Candidates within this share of the best are as good."""
MIN_DISTANCE_M = 1e-3
"""Distance below which a bearing has no more information."""


@kernel
def printed_criteria(
    de_m: float, dn_m: float, ring_m: Matrix, range_sigma_m: float, bearing_sigma_rad: float
) -> Vector:
    """Return the smaller eigenvalue at every candidate, (k + 1,), 1/m^2; last: staying.

    The estimate is de_m, dn_m from the vehicle; the ring (k, 2) is the candidates' steps.
    """
    moves = ring_m.shape[0]
    criteria = np.empty(moves + 1)
    for index in range(moves + 1):
        e_m, n_m = de_m, dn_m
        if index < moves:
            e_m -= ring_m[index, 0]
            n_m -= ring_m[index, 1]
        distance_m = max(math.hypot(e_m, n_m), MIN_DISTANCE_M)
        worst_m = max(range_sigma_m, distance_m * bearing_sigma_rad)
        criteria[index] = 1.0 / (worst_m * worst_m)
    return criteria


@kernel
def printed_candidate(criteria: Vector, pick: float) -> int:
    """Return one of the best of criteria (k + 1,), by a pick in [0, 1).

    A row of the ring, or `STAY`.
    """
    is_best = criteria >= criteria.max() * (1.0 - FLAT_SHARE)
    left = int(pick * is_best.sum())
    for index in range(criteria.size):
        if is_best[index]:
            if left == 0:
                return index if index < criteria.size - 1 else STAY
            left -= 1
    return STAY


def information_gradient(criteria: Vector) -> float:
    """Return the lead of the best candidate over the worst, as a share of the best."""
    best = float(criteria.max())
    return (best - float(criteria.min())) / best


FIXED, REACTIVE, LATCHED, FIM, PRINTED_FIM = range(5)
"""Planners: a given track, or one of those that follow the estimate."""

VEHICLE_EAST, VEHICLE_NORTH, TARGET_EAST, TARGET_NORTH, RANGE_OFFSET, BEARING_OFFSET = range(6)
VARIANCE_EAST, COVARIANCE, VARIANCE_NORTH = range(6, 9)
"""Columns of a record: the sensor's position, and the estimate after its measurement."""
COLUMNS = 9


class WalkFilter(NamedTuple):
    """Parameters of a recursive filter, as the kernels take them.

    Thresholds are (3, 2), bounds (2, n), priors (n,), the pull is (4,).
    """

    sigma: Vector
    """Noise of range, bearing and elevation, (3,)."""
    thresholds: Matrix
    bounds: Matrix
    prior_mean: Vector
    prior_sigmas: Vector
    inflation: Vector
    """Factors on the variances, (3,); ones, as the paper's filters have it."""
    model: RangingModel
    iterations: int
    """Iterations of the splitting; 0: the closed form."""
    penalty: float
    is_window_solved: bool
    """True if the objective over the run corrects the filter."""
    information: Matrix
    """Information of the offsets' priors in that objective, (4, 4); the position's is flat (paper,
    IV-A)."""
    pull: Vector


class WalkSteering(NamedTuple):
    """Planner with its parameters in the form of the kernels; the ring (k, 2) belongs to FIM."""

    planner: int
    step_m: float
    crossing_distance_m: float
    stop_distance_m: float
    latch: LatchRule
    ring_m: Matrix
    may_fly: NDArray[np.bool_]
    poses_m: Matrix
    """Poses of the ring and of staying, (3, k + 1)."""
    field: FieldOfView
    model: RangingModel
    """Measurement model of the plane, without errors of the vehicle position."""


@kernel
def first_fix(
    east_m: float, north_m: float, range_m: float, bearing_rad: float, belief: WalkFilter
) -> tuple[Vector, Matrix]:
    """Return mean and covariance of the first measurement, inverted by the prior offsets."""
    mean = belief.prior_mean.copy()
    distance_m = max(range_m, 1.0)
    mean[0] = east_m + distance_m * math.cos(bearing_rad)
    mean[1] = north_m + distance_m * math.sin(bearing_rad)
    return mean, np.diag(belief.prior_sigmas * belief.prior_sigmas)


@kernel
def updated(
    mean: Vector, covariance: Matrix, sensor_enu_m: Vector, z: Vector, belief: WalkFilter
) -> tuple[Vector, Matrix]:
    """Return mean and covariance after a measurement; the given ones if it would spoil them."""
    sigma, factors, limits = belief.sigma, belief.inflation, belief.thresholds
    bounds, model, splits, penalty = belief.bounds, belief.model, belief.iterations, belief.penalty
    at = sensor_enu_m
    if splits > 0:
        mean, covariance, _, _ = admm_update(
            mean, covariance, at, z, sigma, 0.0, factors, limits, bounds, model, splits, penalty
        )
    else:
        mean, covariance, _, _ = robust_update(
            mean, covariance, at, z, sigma, 0.0, factors, limits, bounds, model
        )
    return mean, covariance


FIRST_COUNT = 4
"""Measurements before the first solution: as many as there are unknowns twice over."""
EARLY_COUNT = 50
EARLY_GROWTH, LATE_GROWTH = 0.15, 0.5
"""The history is solved whenever it has grown by this share, up to `EARLY_COUNT` and after it."""
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
MIN_RANGE_M = 1.0
EARLY_TOLERANCE_M, LATE_TOLERANCE_M = 1e-2, 1e-3
"""Length of a step below which a solution ends, up to `EARLY_COUNT` and after it."""
BETTER_COST = 1e-6
"""Decrease of the cost by which a fresh start's minimum wins: rounding must not decide."""


@kernel
def next_solution(count: int) -> int:
    """Return the number of measurements at which the history is solved again."""
    growth = EARLY_GROWTH if count < EARLY_COUNT else LATE_GROWTH
    return count + max(1, int(growth * count))


@kernel
def history_of(steps: int, belief: WalkFilter) -> Matrix:
    """Return empty rows of the companion's window for a run, (steps, 10)."""
    rows = np.full((steps, map_kernels.COLUMNS), np.nan)
    rows[:, map_kernels.SIGMAS : map_kernels.SEQUENCE] = belief.sigma
    return rows


@kernel
def fresh_start(rows: Matrix, turn: int, prior_mean: Vector) -> Vector:
    """Return a state (4,) in a direction from the path's middle, at the ranges' distance."""
    direction_rad = GOLDEN_ANGLE_RAD * turn
    distance_m = max(float(np.median(rows[:, map_kernels.VALUES])), MIN_RANGE_M)
    start = prior_mean.copy()
    start[0] = rows[:, 0].mean() + distance_m * math.cos(direction_rad)
    start[1] = rows[:, 1].mean() + distance_m * math.sin(direction_rad)
    return start


@kernel
def descended(rows: Matrix, start: Vector, known: Vector, belief: WalkFilter) -> Vector:
    """Return the minimum (4,) that `start` leads to, or the `known` one once it is near.

    The next solution of an early history follows soon, so that it need not be as exact.
    """
    limits, bounds, model = belief.thresholds, belief.bounds, belief.model
    information, pull = belief.information, belief.pull
    tolerance_m = EARLY_TOLERANCE_M if rows.shape[0] < EARLY_COUNT else LATE_TOLERANCE_M
    mean: Vector = np.minimum(np.maximum(start, bounds[0]), bounds[1])
    damping, offs = DAMPING_START, measured_innovations(rows, mean, model)
    for _ in range(MAX_ITERATIONS):
        moved, offs, damping, _, _ = map_step(
            rows, mean, offs, damping, limits, bounds, information, pull, model
        )
        step_m = math.hypot(moved[0] - mean[0], moved[1] - mean[1])
        if math.hypot(moved[0] - known[0], moved[1] - known[1]) < SAME_OPTIMUM_M:
            return known
        mean = moved
        if step_m < tolerance_m:
            break
    return mean


@kernel
def solved(rows: Matrix, mean: Vector, turn: int, belief: WalkFilter) -> tuple[Vector, Matrix]:
    """Return the lower of two minima, (4,), and its covariance, (4, 4).

    The history so far is (k, 10), the filter's mean (4,); the turn is the direction of the fresh
    start.
    """
    start = fresh_start(rows, turn, belief.prior_mean)
    best = descended(rows, mean, np.full(4, np.nan), belief)
    other = descended(rows, start, best, belief)
    curvature, cost = curvature_at(rows, best, belief)
    if other[0] != best[0]:
        bent, other_cost = curvature_at(rows, other, belief)
        if other_cost < cost - BETTER_COST:
            best, curvature = other, bent
    return best, np.ascontiguousarray(np.linalg.inv(curvature))


@kernel
def curvature_at(rows: Matrix, mean: Vector, belief: WalkFilter) -> tuple[Matrix, float]:
    """Return curvature (4, 4) and cost of the objective at `mean`."""
    sigmas = row_sigmas(rows, mean, belief.model)
    offs = measured_innovations(rows, mean, belief.model)
    curvature, _, cost = normal_equations(
        rows, mean, offs, sigmas, belief.thresholds, belief.information, belief.pull, belief.model
    )
    return curvature, cost


@kernel
def latched_step(
    latch: Latch, vehicle: Point, target: Point, over_m: float, is_at_height: bool, rule: LatchRule
) -> Latch:
    """Return the next latch without a fence; in the plane `is_at_height` is always true."""
    verdict = latch_verdict(latch, vehicle, target, over_m, is_at_height, rule)
    if verdict == KEPT:
        return latch
    heading = next_direction(latch, verdict, vehicle, target)
    point = (target[0] + over_m * heading[0], target[1] + over_m * heading[1])
    return new_latch(latch, verdict, point, heading, vehicle, target, over_m, rule)


@kernel
def next_position(
    sensor_enu_m: Vector,
    mean: Vector,
    covariance: Matrix,
    pick: float,
    latch: Latch,
    belief: WalkFilter,
    steering: WalkSteering,
) -> tuple[float, float, Latch]:
    """Return the next position of a planner that follows the estimate, and its latch.

    Both FIM planners fly to the end of the best candidate, or nowhere.
    """
    east_m, north_m = sensor_enu_m[0], sensor_enu_m[1]
    de_m, dn_m = mean[0] - east_m, mean[1] - north_m
    position, target = (east_m, north_m), (mean[0], mean[1])
    if steering.planner == REACTIVE:
        crossing_m, stop_m = steering.crossing_distance_m, steering.stop_distance_m
        east_m, north_m = reactive_step(position, target, steering.step_m, crossing_m, stop_m)
        return east_m, north_m, latch
    if steering.planner == LATCHED:
        over_m = overshoot_m(
            covariance[0, 0], covariance[0, 1], covariance[1, 1], 0.0, steering.latch
        )
        latch = latched_step(latch, position, target, over_m, True, steering.latch)
        point = latch.point_enu_m
        east_m, north_m = stepped(east_m, north_m, point[0], point[1], steering.step_m)
        return east_m, north_m, latch
    ring_m, sigma = steering.ring_m, belief.sigma
    if steering.planner == PRINTED_FIM:
        criteria = printed_criteria(de_m, dn_m, ring_m, sigma[0], sigma[1])
        index = printed_candidate(criteria, pick)
    else:
        away = np.array([de_m, dn_m, 0.0, 0.0])
        poses_m, may_fly, view = steering.poses_m, steering.may_fly, steering.field
        index = best_candidate(covariance, away, poses_m, may_fly, sigma, view, steering.model)
    if index == STAY:
        return east_m, north_m, latch
    return east_m + ring_m[index, 0], north_m + ring_m[index, 1], latch


@kernel
def walked(
    draws: Matrix,
    picks: Vector,
    track: Matrix,
    start: Vector,
    truth: RunTruth,
    scene: Scene,
    belief: WalkFilter,
    steering: WalkSteering,
) -> Matrix:
    """Return the record of a run, (steps, 9), by draws (steps, 6) of the channel.

    The picks (steps,) are uniform, for a planner that must choose among equals. Of the track
    (steps, 2) planners that follow the estimate take the first position alone. The start (2,) is
    the position of the first estimate; NaN: from the first measurement.
    """
    steps = draws.shape[0]
    record = np.empty((steps, COLUMNS))
    mean, covariance = first_fix(0.0, 0.0, 1.0, 0.0, belief)
    mean[:2] = start
    latch = NO_LATCH
    east_m, north_m = float(track[0, 0]), float(track[0, 1])
    z, sensor = np.full(3, np.nan), np.zeros(3)
    memory = NO_MEMORY
    rows = history_of(steps, belief)
    due, turn = FIRST_COUNT, 0
    for step in range(steps):
        if steering.planner == FIXED:
            east_m, north_m = float(track[step, 0]), float(track[step, 1])
        sensor[0], sensor[1] = east_m, north_m
        z[0], z[1], memory = measured_in(draws[step], east_m, north_m, truth, scene, memory)
        if math.isnan(mean[0]):
            mean, covariance = first_fix(east_m, north_m, z[0], z[1], belief)
        else:
            mean, covariance = updated(mean, covariance, sensor, z, belief)
        rows[step, :3], rows[step, 3:6] = sensor, z
        if belief.is_window_solved and step + 1 >= due:
            turn += 1
            mean, covariance = solved(rows[: step + 1], mean, turn, belief)
            due = next_solution(step + 1)
        record[step, :TARGET_EAST], record[step, TARGET_EAST:VARIANCE_EAST] = sensor[:2], mean[:4]
        record[step, VARIANCE_EAST], record[step, COVARIANCE] = covariance[0, 0], covariance[0, 1]
        record[step, VARIANCE_NORTH] = covariance[1, 1]
        if steering.planner != FIXED:
            east_m, north_m, latch = next_position(
                sensor, mean, covariance, picks[step], latch, belief, steering
            )
    return record
