"""MAP problem over many measurements: residuals, cost, damped re-weighted Gauss-Newton.

Rows are [east, north, up, range, bearing, elevation, range sigma, bearing sigma, elevation sigma,
sequence number], NaN where nothing was measured, followed by the two axes of an antenna array
(`measurement_model`). Residuals are whitened and laid out modality by modality, (3, n); missing
measurements have residual zero and a zero row of partials, so that they contribute nothing. A
Gaussian prior 1/2 x^T L x - e^T x is added.

Paper: eq. (9).
"""

from __future__ import annotations

import math

import numpy as np

from companion.estimation.filters.target_filter import Pose
from companion.estimation.measurement_model import (
    AZIMUTH,
    COSINES,
    FIRST_AXIS,
    MIN_SINE2,
    PLANAR,
    RangingModel,
    range_factor,
    target_height_m,
)
from companion.kernel import Matrix, Vector, kernel

VALUES, SIGMAS, SEQUENCE, AXES = 3, 6, 9, 10
"""First columns of the values, their standard deviations, the sequence number, and an array's
axes."""
COLUMNS, ARRAY_COLUMNS = 10, 16
"""Number of columns without and with an array's axes."""

MAX_ITERATIONS = 25
"""Gauss-Newton steps of a solution at most."""
STEP_TOLERANCE_M = 1e-4
"""Step of the position at which a solution ends, metres."""
GAIN_TOLERANCE = 1e-6
"""Decrease of the cost by an undamped step at which a solution ends: a thousandth of a sigma."""
DAMPING_START = 1e-3
"""Initial damping, relative to the diagonal."""
DAMPING_MAX = 1e8
"""Damping at which no step lowers the cost: steps are then as good as zero."""
MIN_CURVATURE_RATIO = 1e-3
"""Lower limit of the damping scale of one horizontal axis, as a share of the other one's."""
MIN_DISTANCE_M = 0.05
"""Lower limit of the distance of a view, so that angles stay defined."""


Row = tuple[Pose, Vector, Vector]
"""Pose of a measurement, its values (3,), NaN where not measured, and their sigmas (3,)."""


def row_vector(row: Row, last: float) -> Vector:
    """Return a row, (10,) or (16,), with `last` in place of the sequence number."""
    pose, z, sigma = row
    return np.array([*pose[:FIRST_AXIS], *z, *sigma, last, *pose[FIRST_AXIS:]])


@kernel
def row_cosines(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return the predicted cosines along both array axes, and the slant range, (3, n)."""
    de, dn = mean[0] - rows[:, 0], mean[1] - rows[:, 1]
    du = target_height_m(mean, model) - rows[:, 2]
    slant = np.sqrt(np.maximum(de * de + dn * dn + du * du, MIN_DISTANCE_M * MIN_DISTANCE_M))
    c, s = math.cos(mean[3]), math.sin(mean[3])
    east, north = c * de - s * dn, s * de + c * dn
    seen = np.empty((3, rows.shape[0]))
    seen[0] = (rows[:, 10] * east + rows[:, 11] * north + rows[:, 12] * du) / slant
    seen[1] = (rows[:, 13] * east + rows[:, 14] * north + rows[:, 15] * du) / slant
    seen[2] = slant
    return seen


@kernel
def view_distance2(rows: Matrix, mean: Vector, model: RangingModel) -> Vector:
    """Return the squared distance that scales the first angle or cosine of every row, (n,)."""
    de, dn = mean[0] - rows[:, 0], mean[1] - rows[:, 1]
    view2 = de * de + dn * dn
    if model.antenna != AZIMUTH:
        seen = row_cosines(rows, mean, model)
        view2 = seen[2] * seen[2]
        if model.antenna == PLANAR:
            view2 = view2 * np.maximum(seen[0] * seen[0] + seen[1] * seen[1], MIN_SINE2)
    floored: Vector = np.maximum(view2, MIN_DISTANCE_M * MIN_DISTANCE_M)
    return floored


@kernel
def array_sigmas(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return the standard deviations as in `row_sigmas`, (3, n), for an antenna array."""
    own2 = model.own_sigma_m * model.own_sigma_m
    seen = row_cosines(rows, mean, model)
    share2 = own2 / model.bearing_inflation / (seen[2] * seen[2])
    sigmas = np.empty((3, rows.shape[0]))
    sigmas[0] = np.sqrt(rows[:, 6] * rows[:, 6] + own2)
    sigmas[1] = np.sqrt(rows[:, 7] * rows[:, 7] + share2)
    sigmas[2] = np.sqrt(rows[:, 8] * rows[:, 8] + share2)
    if model.antenna == PLANAR:
        sine2 = np.maximum(seen[0] * seen[0] + seen[1] * seen[1], MIN_SINE2)
        spread2 = rows[:, 7] * rows[:, 7] / sine2
        sigmas[1] = np.sqrt(spread2 * (1.0 + spread2) + share2 / sine2)
    return sigmas


@kernel
def row_sigmas(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return the standard deviations of all measurements at `mean`, (3, n).

    They are those of thermal noise and of the vehicle position. Where bearings are inflated, the
    position error is scaled down accordingly: otherwise it would excuse any bearing to a target
    near the vehicle.
    """
    if model.antenna != AZIMUTH:
        return array_sigmas(rows, mean, model)
    own2 = model.own_sigma_m * model.own_sigma_m
    floor2 = MIN_DISTANCE_M * MIN_DISTANCE_M
    de, dn = mean[0] - rows[:, 0], mean[1] - rows[:, 1]
    du = target_height_m(mean, model) - rows[:, 2]
    ground2 = np.maximum(de * de + dn * dn, floor2)
    sigmas = np.empty((3, rows.shape[0]))
    sigmas[0] = np.sqrt(rows[:, 6] * rows[:, 6] + own2)
    sigmas[1] = np.sqrt(rows[:, 7] * rows[:, 7] + own2 / (model.bearing_inflation * ground2))
    sigmas[2] = np.sqrt(rows[:, 8] * rows[:, 8] + own2 / (ground2 + du * du))
    return sigmas


@kernel
def has_any(rows: Matrix, modality: int) -> bool:
    """Return True if any row has it: most radios lack a modality, which then costs no time."""
    return bool(np.isfinite(rows[:, 3 + modality]).any())


@kernel
def modalities_of(rows: Matrix) -> int:
    """Return the number of modalities up to the last one that any row has."""
    return 3 if has_any(rows, 2) else 2 if has_any(rows, 1) else 1


@kernel
def batch_innovations(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return measured minus predicted at `mean`, (3, n), not whitened; NaN: not measured.

    Units: m, rad, or those of a direction cosine.
    """
    de, dn = mean[0] - rows[:, 0], mean[1] - rows[:, 1]
    du = target_height_m(mean, model) - rows[:, 2]
    ground2 = de * de + dn * dn
    innovations = np.full((3, rows.shape[0]), np.nan)
    innovations[0] = rows[:, 3] - range_factor(mean, model) * np.sqrt(ground2 + du * du) - mean[2]
    if model.antenna != AZIMUTH:
        fill_array_innovations(innovations, rows, mean, model)
        return innovations
    if has_any(rows, 1):
        turn = rows[:, 4] - np.arctan2(dn, de) - mean[3]
        innovations[1] = turn - 2.0 * math.pi * np.floor(turn / (2.0 * math.pi) + 0.5)
    if has_any(rows, 2):
        innovations[2] = rows[:, 5] - np.arctan2(du, np.sqrt(ground2))
    return innovations


@kernel
def fill_array_innovations(
    innovations: Matrix, rows: Matrix, mean: Vector, model: RangingModel
) -> None:
    """Fill the last two rows of `batch_innovations`, (3, n), for an antenna array."""
    seen = row_cosines(rows, mean, model)
    innovation = rows[:, 4] - seen[0]
    if model.antenna == PLANAR:
        innovation = rows[:, 4] - np.arctan2(seen[1], seen[0])
        innovation = innovation - 2.0 * math.pi * np.floor(innovation / (2.0 * math.pi) + 0.5)
    innovations[1] = innovation
    innovations[2] = rows[:, 5] - seen[1]


@kernel
def measured_innovations(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return `batch_innovations` of the modalities that exist, (m, n)."""
    return batch_innovations(rows, mean, model)[: modalities_of(rows)]


@kernel
def whitened(innovations: Matrix, sigmas: Matrix) -> Matrix:
    """Return innovations, (m, n), over their sigmas (3, n), zero where not measured."""
    return np.where(np.isnan(innovations), 0.0, innovations / sigmas[: innovations.shape[0]])


@kernel
def row_residuals(rows: Matrix, mean: Vector, sigmas: Matrix, model: RangingModel) -> Matrix:
    """Return the whitened residuals of all measurements, (3, n), zero where not measured."""
    return whitened(batch_innovations(rows, mean, model), sigmas)


@kernel
def fill_array_partials(H: Matrix, rows: Matrix, mean: Vector, model: RangingModel) -> None:
    """Fill the last two thirds of the partials, (3 n, k), for an antenna array, not whitened."""
    n = rows.shape[0]
    seen = row_cosines(rows, mean, model)
    slant = seen[2]
    e, north_part = (mean[0] - rows[:, 0]) / slant, (mean[1] - rows[:, 1]) / slant
    up = (target_height_m(mean, model) - rows[:, 2]) / slant
    c, s = math.cos(mean[3]), math.sin(mean[3])
    for which in range(2):
        axis_e, axis_n = rows[:, 10 + 3 * which], rows[:, 11 + 3 * which]
        axis_up = rows[:, 12 + 3 * which]
        east, north = c * axis_e + s * axis_n, c * axis_n - s * axis_e
        part = H[(1 + which) * n : (2 + which) * n]
        part[:, 0] = (east - seen[which] * e) / slant
        part[:, 1] = (north - seen[which] * north_part) / slant
        part[:, 3] = north * e - east * north_part
        if model.height_index >= 0:
            part[:, model.height_index] = (axis_up - seen[which] * up) / slant
    if model.antenna == PLANAR:
        sine2 = np.maximum(seen[0] * seen[0] + seen[1] * seen[1], MIN_SINE2)
        first, second = H[n : 2 * n], H[2 * n :]
        along, across = (seen[0] / sine2).reshape(-1, 1), (seen[1] / sine2).reshape(-1, 1)
        first[:] = along * second - across * first
        second[:] = 0.0


@kernel
def whitener(rows: Matrix, sigmas: Matrix, modality: int) -> Vector:
    """Return the factors that whiten the partials of a modality, (n,), zero where not measured."""
    return np.where(np.isnan(rows[:, 3 + modality]), 0.0, 1.0 / sigmas[modality])


@kernel
def row_partials(rows: Matrix, mean: Vector, sigmas: Matrix, model: RangingModel) -> Matrix:
    """Return the whitened partials of all measurements, (3 n, k), modality by modality."""
    n = rows.shape[0]
    de, dn = mean[0] - rows[:, 0], mean[1] - rows[:, 1]
    du = target_height_m(mean, model) - rows[:, 2]
    ground2 = np.maximum(de * de + dn * dn, MIN_DISTANCE_M * MIN_DISTANCE_M)
    slant = np.sqrt(ground2 + du * du)
    factor = range_factor(mean, model)
    H = np.zeros((3 * n, mean.size))
    by_range, by_bearing, by_elevation = H[:n], H[n : 2 * n], H[2 * n :]
    white = whitener(rows, sigmas, 0)
    by_range[:, 0] = factor * de / slant * white
    by_range[:, 1] = factor * dn / slant * white
    by_range[:, 2] = white
    if model.scale_index >= 0:
        by_range[:, model.scale_index] = slant * white
    if model.height_index >= 0:
        by_range[:, model.height_index] = factor * du / slant * white
    if model.antenna != AZIMUTH:
        fill_array_partials(H, rows, mean, model)
        by_bearing *= whitener(rows, sigmas, 1).reshape(-1, 1)
        by_elevation *= whitener(rows, sigmas, 2).reshape(-1, 1)
        return H
    if has_any(rows, 1):
        white = whitener(rows, sigmas, 1)
        by_bearing[:, 0] = -dn / ground2 * white
        by_bearing[:, 1] = de / ground2 * white
        by_bearing[:, 3] = white
    if has_any(rows, 2):
        white, ground = whitener(rows, sigmas, 2), np.sqrt(ground2)
        down = -du / (slant * slant * ground)
        by_elevation[:, 0] = de * down * white
        by_elevation[:, 1] = dn * down * white
        if model.height_index >= 0:
            by_elevation[:, model.height_index] = ground / (slant * slant) * white
    return H


@kernel
def clipped(u: Matrix, thresholds: Matrix) -> Matrix:
    """Return the influence of every whitened residual: the residual clipped to its thresholds."""
    psi = np.empty(u.shape)
    for modality in range(u.shape[0]):
        high, low = thresholds[modality, 0], -thresholds[modality, 1]
        psi[modality] = np.minimum(np.maximum(u[modality], low), high)
    return psi


@kernel
def apply_weights(terms: Matrix, model: RangingModel) -> None:
    """Multiply the terms of all measurements, (2 or 3, n), by their shares, in place."""
    if model.range_share != 1.0 or model.direction_share != 1.0:
        terms[0] *= model.range_share
        terms[1:] *= model.direction_share


@kernel
def map_cost(
    innovations: Matrix,
    mean: Vector,
    sigmas: Matrix,
    thresholds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> float:
    """Return the objective at `mean`, given the innovations there, (m, n)."""
    u = whitened(innovations, sigmas)
    psi = clipped(u, thresholds)
    losses = psi * (u - 0.5 * psi)
    apply_weights(losses, model)
    prior = 0.5 * np.dot(mean, np.dot(information, mean)) - np.dot(pull, mean)
    return float(np.sum(losses) + prior)


@kernel
def normaliser(rows: Matrix, sigmas: Matrix, model: RangingModel) -> float:
    """Return the log normalisation of the bearings, whose sigmas depend on the position.

    It makes the costs of different positions comparable: a density widened by the vehicle's
    position error is lower; with noise inflated by c, -c log p = loss + c log sigma. `sigmas` are
    (3, n).
    """
    total = 0.0
    if has_any(rows, 1):
        wider = np.log(sigmas[1] / rows[:, 7])
        total += model.bearing_inflation * np.sum(np.where(np.isnan(rows[:, 4]), 0.0, wider))
    if model.antenna == COSINES:
        wider = np.log(sigmas[2] / rows[:, 8])
        total += model.bearing_inflation * np.sum(np.where(np.isnan(rows[:, 5]), 0.0, wider))
    return float(model.direction_share * total)


@kernel
def normal_equations(
    rows: Matrix,
    mean: Vector,
    innovations: Matrix,
    sigmas: Matrix,
    thresholds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> tuple[Matrix, Vector, float]:
    """Return the re-weighted Gauss-Newton system at `mean`: (k, k), descent (k,), and cost.

    The residuals at `mean` are `innovations`, (m, n).
    """
    measured = innovations.shape[0]
    u = whitened(innovations, sigmas)
    psi = clipped(u, thresholds)
    H = row_partials(rows, mean, sigmas, model)[: measured * rows.shape[0]]
    clear = (u == psi) * 1.0  # multiplying by it takes half the time of np.where when compiled
    weight = (psi * (1.0 - clear) + clear) / (u * (1.0 - clear) + clear)
    losses = psi * (u - 0.5 * psi)
    apply_weights(weight, model)
    apply_weights(losses, model)
    apply_weights(psi, model)
    A = np.dot(H.T, weight.reshape(-1, 1) * H) + information
    known = np.dot(information, mean)
    cost = np.sum(losses) + 0.5 * np.dot(mean, known) - np.dot(pull, mean)
    return A, np.dot(H.T, psi.reshape(-1)) - known + pull, float(cost)


@kernel
def hold_at_bounds(A: Matrix, descent: Vector, mean: Vector, bounds: Matrix) -> None:
    """Remove components at a bound that would move beyond it from a system, in place.

    Otherwise a step would be solved as if that component could move, and clipped afterwards.
    Source: D. P. Bertsekas, Projected Newton methods, SIAM J. Control Optim. 20 (1982).
    """
    for index in range(mean.size):
        is_low = mean[index] <= bounds[0, index] and descent[index] < 0.0
        is_high = mean[index] >= bounds[1, index] and descent[index] > 0.0
        if is_low or is_high:
            A[index, :] = 0.0
            A[:, index] = 0.0
            A[index, index] = 1.0
            descent[index] = 0.0


@kernel
def map_step(
    rows: Matrix,
    mean: Vector,
    innovations: Matrix,
    damping: float,
    thresholds: Matrix,
    bounds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> tuple[Vector, Matrix, float, float, int]:
    """Take one damped step that lowers the cost.

    Returns the mean, its innovations, the next damping, the decrease, and the number of dampings
    tried. The `innovations`, (m, n), are `measured_innovations` at `mean`. Where no step lowers
    the cost, the mean is unchanged.
    """
    sigmas = row_sigmas(rows, mean, model)
    A, descent, cost = normal_equations(
        rows, mean, innovations, sigmas, thresholds, information, pull, model
    )
    hold_at_bounds(A, descent, mean, bounds)
    scale = np.diag(np.diag(A) + 1e-9)
    # across a straight track the curvature is zero
    floor = MIN_CURVATURE_RATIO * max(A[0, 0], A[1, 1])
    scale[0, 0], scale[1, 1] = max(scale[0, 0], floor), max(scale[1, 1], floor)
    tries = 0
    while damping < DAMPING_MAX:
        tries += 1
        moved = mean + np.linalg.solve(A + damping * scale, descent)
        moved = np.minimum(np.maximum(moved, bounds[0]), bounds[1])
        after = batch_innovations(rows, moved, model)[: innovations.shape[0]]
        lower = map_cost(after, moved, sigmas, thresholds, information, pull, model)
        if lower < cost:
            return moved, after, max(damping / 4.0, 1e-9), cost - lower, tries
        damping *= 8.0
    return mean, innovations, damping, 0.0, tries


@kernel
def map_descent(
    rows: Matrix,
    mean: Vector,
    damping: float,
    most: int,
    thresholds: Matrix,
    bounds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> tuple[Vector, float, int, bool]:
    """Take at most `most` steps from `mean` (k,) towards its local minimum.

    Returns the state (k,), the damping to continue with, the number of passes over the
    measurements, and True at the minimum. The Gaussian prior has the `information` L (k, k) and the
    `pull` e (k,), L times its mean. `thresholds` (3, 2) are long and short of each modality,
    `bounds` (2, k).
    """
    mean = np.minimum(np.maximum(mean, bounds[0]), bounds[1])
    innovations, passes = measured_innovations(rows, mean, model), 1
    for _ in range(most):
        moved, innovations, damping, gain, tries = map_step(
            rows, mean, innovations, damping, thresholds, bounds, information, pull, model
        )
        passes += 1 + tries
        step_m = math.hypot(moved[0] - mean[0], moved[1] - mean[1])
        mean = moved
        is_level = gain < GAIN_TOLERANCE and damping < DAMPING_START
        if is_level or step_m < STEP_TOLERANCE_M:
            return mean, damping, passes, True
    return mean, damping, passes, False
