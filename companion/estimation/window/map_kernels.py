"""MAP problem over many measurements: residuals, cost, damped re-weighted Gauss-Newton.

Rows are [east, north, up, range, bearing, elevation, range sigma, bearing sigma, elevation sigma,
sequence number], NaN where nothing was measured, followed by the two axes of an antenna array, and
by power, its sigma and its weight, if the model has them (`measurement_model`). Residuals
are whitened and laid out modality by modality, (m, n), with the m modalities of the model; missing
measurements have residual zero and a zero row of partials, so that they contribute nothing. A
Gaussian prior 1/2 x^T L x - e^T x is added (paper: eq. (9)). It contains the measurements that left
the window. Each is expanded to second order about the estimate at the time when it left, and
summed:

    rho(u(x)) ~ const - psi H^T (x - x0) + 1/2 (x - x0)^T psi' H H^T (x - x0)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.estimation.measurement_model import (
    AZIMUTH,
    BEARING,
    COSINES,
    ELEVATION,
    MODALITIES,
    POWER,
    RANGE,
    RangingModel,
    fill_noise,
    fill_partials,
    innovations,
    rows_of,
    sight_of,
)
from companion.kernel import Matrix, Vector, kernel

VALUES = 3
SIGMAS = VALUES + MODALITIES
SEQUENCE = SIGMAS + MODALITIES
AXES = SEQUENCE + 1
"""First columns of the values, their standard deviations, the sequence number, and an array's
axes."""
COLUMNS, ARRAY_COLUMNS = AXES, AXES + 6
"""Number of columns without and with an array's axes, and without power."""
POWER_COLUMNS = 3
POWER_VALUE, POWER_SIGMA, POWER_WEIGHT = -3, -2, -1
"""Number and positions of the columns of power, counted from the end."""

MAX_ITERATIONS = 25
"""Gauss-Newton steps of a solution at most.

The steps of one solution bound its time; what has not ended by then starts again from there with
the next one.
"""
DAMPING_START = 1e-3
"""Initial damping, relative to the diagonal: hardly any; it grows where a step gains nothing."""


def argument_columns(model: RangingModel) -> tuple[list[int], list[int], list[int]]:
    """Return the columns of the pose, the values and their sigmas, which a filter's kernel takes.

    The pose is the sensor's position, followed by the axes of an antenna array: 3 or 9 columns.
    """
    pose, values, sigmas = [*range(VALUES)], [*range(VALUES, SIGMAS)], [*range(SIGMAS, SEQUENCE)]
    axes = [] if model.antenna == AZIMUTH else [*range(AXES, ARRAY_COLUMNS)]
    if rows_of(model) > POWER:
        return pose + axes, [*values, POWER_VALUE], [*sigmas, POWER_SIGMA]
    return pose + axes, values, sigmas


def columns_of(model: RangingModel) -> int:
    """Return the number of columns of a row."""
    columns = COLUMNS if model.antenna == AZIMUTH else ARRAY_COLUMNS
    return columns + POWER_COLUMNS * (rows_of(model) - MODALITIES)


@kernel
def poses_of(rows: Matrix, model: RangingModel) -> Matrix:
    """Return the sensor's pose of every row, (3, n) or with an antenna array (9, n)."""
    if model.antenna == AZIMUTH:
        return rows[:, :VALUES].T
    return np.concatenate((rows[:, :VALUES].T, rows[:, AXES:ARRAY_COLUMNS].T))


@kernel
def values_of(rows: Matrix, count: int) -> Matrix:
    """Return the values of the first modalities of every row, (count, n)."""
    if count <= POWER:
        return rows[:, VALUES : VALUES + count].T
    return np.concatenate((rows[:, VALUES:SIGMAS].T, rows[:, POWER_VALUE:POWER_SIGMA].T))


def without_values(rows: Matrix, gross: Mapping[int, NDArray[np.bool_]]) -> Matrix:
    """Return the rows with NaN for the values of each modality where `gross`, (n,), is true."""
    kept = np.array(rows)
    for modality, is_gross in gross.items():
        kept[is_gross, VALUES + modality if modality < POWER else POWER_VALUE] = np.nan
    return kept


@kernel
def thermal_sigmas_of(rows: Matrix, count: int) -> Matrix:
    """Return the radio's standard deviations of every row, (3 or 4, n)."""
    if count <= POWER:
        return rows[:, SIGMAS:SEQUENCE].T
    return np.concatenate((rows[:, SIGMAS:SEQUENCE].T, rows[:, POWER_SIGMA:POWER_WEIGHT].T))


@kernel
def row_sigmas(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return the standard deviations of thermal noise and vehicle position at `mean`, (m, n)."""
    R = np.empty((rows_of(model), rows.shape[0]))
    poses = poses_of(rows, model)
    sight = sight_of(mean, poses, model)
    fill_noise(R, thermal_sigmas_of(rows, R.shape[0]), sight, mean, poses, model)
    return np.sqrt(R)


@kernel
def has_any(rows: Matrix, modality: int) -> bool:
    """Return True if any row has it: most radios lack a modality, which then costs no time."""
    column = VALUES + modality if modality < POWER else rows.shape[1] + POWER_VALUE
    return bool(np.isfinite(rows[:, column]).any())


@kernel
def modalities_of(rows: Matrix, model: RangingModel) -> int:
    """Return the number of modalities up to the last one that any row has, at least 1."""
    count = rows_of(model)
    while count > 1 and not has_any(rows, count - 1):
        count -= 1
    return count


@kernel
def first_innovations(rows: Matrix, mean: Vector, model: RangingModel, count: int) -> Matrix:
    """Return measured minus predicted at `mean` of the first modalities, (count, n).

    Not whitened; NaN: not measured. Units: m, rad, or those of a direction cosine.
    """
    z = np.ascontiguousarray(values_of(rows, count))
    return innovations(z, mean, poses_of(rows, model), model)


@kernel
def measured_innovations(rows: Matrix, mean: Vector, model: RangingModel) -> Matrix:
    """Return the innovations of the modalities up to the last one that any row has, (m, n)."""
    return first_innovations(rows, mean, model, modalities_of(rows, model))


@kernel
def whitened(y: Matrix, sigmas: Matrix) -> Matrix:
    """Return innovations y, (m, n), over their sigmas, zero where not measured."""
    return np.where(np.isnan(y), 0.0, y / sigmas[: y.shape[0]])


@kernel
def row_residuals(rows: Matrix, mean: Vector, sigmas: Matrix, model: RangingModel) -> Matrix:
    """Return the whitened residuals of all measurements, (m, n), zero where not measured."""
    return whitened(first_innovations(rows, mean, model, rows_of(model)), sigmas)


@kernel
def whitened_partials(
    rows: Matrix, mean: Vector, sigmas: Matrix, model: RangingModel, count: int
) -> Matrix:
    """Return the whitened partials of the first modalities, (k, count n), modality by modality."""
    n = rows.shape[0]
    H = np.zeros((mean.size, count, n))
    poses = poses_of(rows, model)
    sight = sight_of(mean, poses, model)
    fill_partials(H.transpose(1, 0, 2), sight, mean, poses, model)
    z = values_of(rows, count)
    H *= np.where(np.isnan(z), 0.0, 1.0 / sigmas[:count])
    return H.reshape(mean.size, count * n)


@kernel
def row_partials(rows: Matrix, mean: Vector, sigmas: Matrix, model: RangingModel) -> Matrix:
    """Return the whitened partials of all measurements, (m n, k), modality by modality."""
    return np.ascontiguousarray(whitened_partials(rows, mean, sigmas, model, rows_of(model)).T)


@kernel
def clipped(u: Matrix, thresholds: Matrix) -> Matrix:
    """Return the influence of every whitened residual: the residual clipped to its thresholds."""
    psi = np.empty(u.shape)
    for modality in range(u.shape[0]):
        high, low = thresholds[modality, 0], -thresholds[modality, 1]
        psi[modality] = np.minimum(np.maximum(u[modality], low), high)
    return psi


@kernel
def apply_weights(terms: Matrix, rows: Matrix, model: RangingModel) -> None:
    """Multiply the terms of all measurements, (m, n), by their weights, in place."""
    if model.range_share != 1.0 or model.direction_share != 1.0:
        terms[RANGE] *= model.range_share
        terms[BEARING:POWER] *= model.direction_share
    if terms.shape[0] > POWER:
        terms[POWER] *= rows[:, POWER_WEIGHT]


@kernel
def map_cost(
    rows: Matrix,
    y: Matrix,
    mean: Vector,
    sigmas: Matrix,
    thresholds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> float:
    """Return the objective at `mean`, given the innovations y there, (m, n)."""
    u = whitened(y, sigmas)
    psi = clipped(u, thresholds)
    losses = psi * (u - 0.5 * psi)
    apply_weights(losses, rows, model)
    prior = 0.5 * np.dot(mean, np.dot(information, mean)) - np.dot(pull, mean)
    return float(np.sum(losses) + prior)


@kernel
def normaliser(rows: Matrix, sigmas: Matrix, model: RangingModel) -> float:
    """Return the log normalisation of the bearings, whose sigmas depend on the position.

    It makes the costs of different positions comparable: a density widened by the vehicle's
    position error is lower; with noise inflated by c, -c log p = loss + c log sigma. `sigmas` are
    (m, n).
    """
    total = 0.0
    for row in range(BEARING, POWER):
        if row == BEARING and not has_any(rows, BEARING):
            continue
        if row == ELEVATION and model.antenna != COSINES:
            continue
        wider = np.log(sigmas[row] / rows[:, SIGMAS + row])
        is_missing = np.isnan(rows[:, VALUES + row])
        total += model.bearing_inflation * np.sum(np.where(is_missing, 0.0, wider))
    return float(model.direction_share * total)


@kernel
def normal_equations(
    rows: Matrix,
    mean: Vector,
    y: Matrix,
    sigmas: Matrix,
    thresholds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> tuple[Matrix, Vector, float]:
    """Return the re-weighted Gauss-Newton system at `mean`: (k, k), descent (k,), and cost.

    `y`, (m, n), are the innovations at `mean`.
    """
    measured = y.shape[0]
    u = whitened(y, sigmas)
    psi = clipped(u, thresholds)
    H = whitened_partials(rows, mean, sigmas, model, measured)
    clear = (u == psi) * 1.0  # multiplying by it takes half the time of np.where when compiled
    weight = (psi * (1.0 - clear) + clear) / (u * (1.0 - clear) + clear)
    losses = psi * (u - 0.5 * psi)
    apply_weights(weight, rows, model)
    apply_weights(losses, rows, model)
    apply_weights(psi, rows, model)
    A = np.dot(weight.reshape(-1) * H, H.T) + information
    known = np.dot(information, mean)
    cost = np.sum(losses) + 0.5 * np.dot(mean, known) - np.dot(pull, mean)
    return A, np.dot(H, psi.reshape(-1)) - known + pull, float(cost)


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
    y: Matrix,
    damping: float,
    thresholds: Matrix,
    bounds: Matrix,
    information: Matrix,
    pull: Vector,
    model: RangingModel,
) -> tuple[Vector, Matrix, float, float, int]:
    """Take one damped step that lowers the cost.

    Returns the mean, its innovations, the next damping, the decrease, and the number of dampings
    tried. `y`, (m, n), are `measured_innovations` at `mean`. Where no step lowers
    the cost, the mean is unchanged.
    """
    sigmas = row_sigmas(rows, mean, model)
    A, descent, cost = normal_equations(rows, mean, y, sigmas, thresholds, information, pull, model)
    hold_at_bounds(A, descent, mean, bounds)
    scale = np.diag(np.diag(A) + 1e-9)
    # across a straight track the curvature is zero: damp it by a share of that along the track
    floor = 1e-3 * max(A[0, 0], A[1, 1])
    scale[0, 0], scale[1, 1] = max(scale[0, 0], floor), max(scale[1, 1], floor)
    tries = 0
    while damping < 1e8:  # steps are then as good as zero
        tries += 1
        moved = mean + np.linalg.solve(A + damping * scale, descent)
        moved = np.minimum(np.maximum(moved, bounds[0]), bounds[1])
        after = first_innovations(rows, moved, model, y.shape[0])
        lower = map_cost(rows, after, moved, sigmas, thresholds, information, pull, model)
        if lower < cost:
            return moved, after, max(damping / 4.0, 1e-9), cost - lower, tries
        damping *= 8.0
    return mean, y, damping, 0.0, tries


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
    `pull` e (k,), L times its mean. `thresholds` (m, 2) are long and short of each modality,
    `bounds` (2, k).
    """
    mean = np.minimum(np.maximum(mean, bounds[0]), bounds[1])
    y, passes = measured_innovations(rows, mean, model), 1
    for _ in range(most):
        moved, y, damping, gain, tries = map_step(
            rows, mean, y, damping, thresholds, bounds, information, pull, model
        )
        passes += 1 + tries
        step_m = math.hypot(moved[0] - mean[0], moved[1] - mean[1])
        mean = moved
        # an undamped step gains less than a thousandth of a sigma, or any is far below every R95
        is_level = gain < 1e-6 and damping < DAMPING_START
        if is_level or step_m < 1e-4:
            return mean, damping, passes, True
    return mean, damping, passes, False


@dataclass(frozen=True, slots=True)
class OlderEvidence:
    """Gaussian in canonical form, with the sampling variability of its pull."""

    information: Matrix
    """Information L, (k, k)."""
    pull: Vector
    """L times the mean, (k,)."""
    variability: Matrix
    """Sum of psi^2 H H^T, (k, k): the sandwich's B."""

    @classmethod
    def none(cls, size: int) -> OlderEvidence:
        """Return empty evidence for a state of `size` components."""
        return cls(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)))

    @property
    def is_empty(self) -> bool:
        """True if nothing has left the window yet."""
        return not self.information.any()

    def moved(self, step: Vector) -> OlderEvidence:
        """Return the evidence after the state moved by `step`, (k,)."""
        return replace(self, pull=self.pull + self.information @ step)

    def joined(
        self, rows: Matrix, mean: Vector, thresholds: Matrix, model: RangingModel
    ) -> OlderEvidence:
        """Return the evidence with `rows` (m, 10) added, expanded about `mean` (k,)."""
        at = np.array(mean)  # as in `WindowMap.scores`
        sigmas = row_sigmas(rows, at, model)
        u = row_residuals(rows, at, sigmas, model)
        psi = clipped(u, thresholds)
        H = row_partials(rows, at, sigmas, model)
        if len(u) > POWER:  # H and influence with the square root of the weight each
            roots = np.sqrt(rows[:, POWER_WEIGHT])
            H[POWER * len(rows) :] *= roots[:, None]
            psi[POWER], u[POWER] = roots * psi[POWER], roots * u[POWER]
        influence = psi.reshape(-1)
        A = H.T @ ((u == psi).reshape(-1, 1) * H)
        B = H.T @ ((influence**2)[:, None] * H)
        return OlderEvidence(
            self.information + A, self.pull + A @ mean + H.T @ influence, self.variability + B
        )
