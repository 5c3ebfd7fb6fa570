"""Spatially correlated errors of every modality, and the shadowing of received power.

A radio's ranges and bearings are fitted (`spatial_noise`), shadows are known beforehand.

Obstacles between emitter and vehicle weaken all measurements from about the same position. In dB
these shadows are a random field over positions with covariance s^2 exp(-d / l), to which fading
adds a variance of f^2 for each measurement. Unlike errors of ranges and bearings they are part of
any received power, so that s, f and l are known before the flight.

The window weighs every measurement by what its neighbours repeat of it, and solves for the optimum
as if errors were independent. The variance of that solution is the one under the field.

A fit from few positions explains part of their shadows as the target's position, or as P0, so that
residuals are smaller than errors. With P the projection of the fit and K the covariance of errors,
the mean square of residuals is short of that of errors by the share tr(2 P K - P K P^T) / tr K.

Sources: M. Gudmundson, Electronics Letters 27 (1991), for the field; K.-Y. Liang and S. L. Zeger,
Biometrika 73 (1986), for weights that need not be those of the true covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.estimation.filters.target_filter import (
    POWER_LENGTH_M,
    POWER_SHADOW_SIGMA_DB,
    POWER_SIGMA_DB,
    POWER_TOTAL_SIGMA_DB,
    FilterParams,
)
from companion.estimation.measurement_model import BEARING, POWER, RANGE
from companion.estimation.window.map_kernels import POWER_VALUE, POWER_WEIGHT, SIGMAS
from companion.estimation.window.sandwich import Scores, SpatialNoises, student_ratio
from companion.estimation.window.spatial_noise import (
    CELL_SHARE,
    SpatialNoise,
    SpatialPrior,
    clipped_deviation,
    fit_spatial_noise,
)
from companion.kernel import Matrix, Vector


def shadow_cells(positions: Matrix) -> tuple[NDArray[np.intp], Vector, Matrix]:
    """Return the cell (n,) of each position (n, 2), the cells' counts (g,), and their correlation.

    The correlation (g, g) is that of the shadows at the centres of a cell's positions.
    """
    squares = np.round(positions / (CELL_SHARE * POWER_LENGTH_M))
    _, cell, counts = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
    cell, count = cell.reshape(-1), counts.astype(float)
    centres = np.stack([np.bincount(cell, axis) for axis in positions.T]) / count
    apart_m = np.hypot(*(centres[:, :, None] - centres[:, None, :]))
    return cell, count, np.exp(-apart_m / POWER_LENGTH_M)


def shadow_weights(rows: Matrix) -> Vector:
    """Return the weight of each row's power, (n,), that the shadows it shares with others leave.

    N measurements at one position have the information of one with the variance of the shadow plus
    that of fading over N, so that each has the weight (f^2 + s^2) / (f^2 + N s^2); N counts every
    other measurement by the correlation of its shadow.
    """
    has_power = ~np.isnan(rows[:, POWER_VALUE])
    weights = np.ones(len(rows))
    if not has_power.any():
        return weights
    cell, count, correlation = shadow_cells(rows[has_power, :2])
    fading2, shadow2 = POWER_SIGMA_DB**2, POWER_SHADOW_SIGMA_DB**2
    alike = correlation @ count
    weights[has_power] = ((fading2 + shadow2) / (fading2 + shadow2 * alike))[cell]
    return weights


def shadow_noise(rows: Matrix, scores: Scores, prior: Matrix) -> SpatialNoise:
    """Return the field of the influences of the rows' powers (n,), not all NaN.

    Its variance is that of the residuals, with the share that the fit has absorbed, at the 95 %
    quantile of Student's t for the independent shadows that remain. `prior` (k, k) is the
    information of the state's prior.
    """
    seen = scores.is_measured[POWER]
    cell = np.full(len(rows), -1)
    cell[seen], _, correlation = shadow_cells(rows[seen, :2])
    share = (POWER_SHADOW_SIGMA_DB / POWER_TOTAL_SIGMA_DB) ** 2
    unit = SpatialNoise(cell, share * correlation, 1.0 - share, repetition=1.0)
    weights, slope = rows[:, POWER_WEIGHT], scores.slopes[POWER]
    left = 1.0 - absorbed_share(unit, scores.entering(POWER), weights, slope, prior)
    ratio = student_ratio(left * unit.degrees)
    variance = scores.moment(POWER, scores.H.shape[1]) / left * ratio**2
    return SpatialNoise(cell, variance * unit.field, variance * unit.white, repetition=1.0)


def absorbed_share(
    unit: SpatialNoise, weighed: Matrix, weights: Vector, slope: float, prior: Matrix
) -> float:
    """Return the share of the errors' mean square that a fit explains, 0 to below 1.

    `unit` is a field with white noise, of variance 1 together; `weighed` (n, k) are the partials
    times the `weights` (n,).
    """
    partials = weighed / weights[:, None]
    # from one point a position is unobservable: its gain is zero, which an inverse does not have
    gain = slope * np.linalg.pinv(slope * (weighed.T @ partials) + prior, hermitian=True)
    crossed = gain @ unit.covariance(weighed, partials)
    fitted = gain @ unit.variance(weighed) @ gain @ (partials.T @ partials)
    count = np.count_nonzero(unit.cell >= 0)
    return float(2.0 * np.trace(crossed) - np.trace(fitted)) / count


def spatial_noises(
    rows: Matrix, scores: Scores, params: FilterParams, prior: Matrix
) -> SpatialNoises:
    """Return the spatial noise of every modality; None: its errors are white.

    It is that of the residuals of `scores`, given the radio's parameters. `prior` (k, k) is the
    information of the state's prior.
    """
    thresholds = params.thresholds.tolist()
    found: list[SpatialNoise | None] = [None] * len(thresholds)
    for m in scores.measured:
        if m == POWER:
            found[m] = shadow_noise(rows, scores, prior)
            continue
        sigma = float(np.median(rows[scores.is_measured[m], SIGMAS + m]))
        ratio = params.spatial_sigmas[min(m, BEARING)] / sigma
        if ratio == 0.0 and scores.correlations[m] == 0.0:
            continue
        psi = np.where(scores.is_measured[m], scores.psi[m], np.nan)
        deviation = clipped_deviation(ratio, *thresholds[m])
        if ratio == 0.0:
            deviation = float(np.sqrt(np.nanmean(psi**2)))
        length_m = params.range_length_m if m == RANGE else params.place_length_m
        spatial_prior = SpatialPrior(deviation, length_m, is_of_radio=ratio > 0.0)
        H, slope = scores.part(m), scores.slopes[m]
        noise = fit_spatial_noise(rows[:, :2], psi, H, slope, prior, spatial_prior)
        # a target that moved looks like spatial noise: keep the full weight
        found[m] = noise if ratio > 0.0 else replace(noise, repetition=1.0)
    # two components are one direction with one weight
    angles = found[BEARING:POWER]
    worst = max((f.repetition for f in angles if f is not None), default=1.0)
    directions = (None if f is None else replace(f, repetition=worst) for f in angles)
    return (found[RANGE], *directions, *found[POWER:])
