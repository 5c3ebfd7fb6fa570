"""Errors that all measurements of a window share, so that no number of them averages them out.

Theory of operation. A displacement d of the target as seen moves a measurement by its partial p
times d, and so the M-estimate by A^-1 sum s H^T p d, with H the whitened partials, s the slope of
each modality and A the curvature (a "considered" parameter: S. F. Schmidt, Advances in Control
Systems 3, 1966). To first order this holds for any weights, however wrong.

The vehicle position error is a first-order Gauss-Markov process b of sigma and time constant tau,
so that the emitter seems displaced by b(t) - b(now) when it was measured. In total this is

    W = sum_ij G_i C(t_i, t_j) G_j^T,    C(s, t) = sigma^2 (rho(s - t) - rho(s) - rho(t) + 1)

with G_i = A^-1 H_i^T H_i,position and rho(t) = exp(-|t| / tau), times counted from now. An
unestimated height and an unknown lag of stamps do appear in residuals where the views differ: they
are reduced by what the residuals reveal.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.domain import DEFAULT_ACCURACY, GNSS_ACCURACY_FACTOR, PositionAccuracy
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import AZIMUTH, EAST, NORTH, POWER, RangingModel
from companion.estimation.window.map_kernels import row_residuals, row_sigmas
from companion.estimation.window.sandwich import (
    Scores,
    correlated_variability,
    curvature,
    pooled_variability,
)
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector

TIME_CONSTANT_S = 150.0
"""Correlation time of single-frequency GNSS errors, s: 60 to 1,000 s.

Chosen: a shorter one claims more drift within a search, and so a wider R95.
"""
URBAN_GNSS_RATIO = 2.0
"""Single-frequency GNSS error between buildings, 3 to 10 m, over that under the open sky, 1.5 m.

Chosen: the low end. It is assumed that a receiver reports the same accuracy in both surroundings.
"""
GAP_S = 2.0
"""Time between measurements, s, beyond which they are not neighbours: contact is interrupted, and
the vehicle's motion in between is not known to be a line.

Chosen: a shorter one excludes slow radios, in a longer one the vehicle may have turned.
"""


class SharedSigmas(NamedTuple):
    """Standard deviations of the errors that all measurements share."""

    own_m: float = 0.0
    """Vehicle position, per axis."""
    height_m: float = 0.0
    """Height between vehicle and target, if it is not in the state."""
    lag_s: float = 0.0
    """Lag of the radio's stamps."""
    jump_m: float = 0.0
    """Vehicle position, per axis, while the fix had another quality."""


def shared_sigmas(
    params: FilterParams, own: PositionAccuracy | None, best_own_m: float, *, is_auto: bool
) -> SharedSigmas:
    """Return the shared errors' standard deviations, reported or configured.

    `own` is the worst accuracy of the vehicle position during the search, `best_own_m` the best
    reported one. `is_auto`: the antenna is not configured. A configured random walk of the position
    replaces what is assumed of receivers without corrections: over short times the process of the
    module's text is a walk of sigma sqrt(2 / tau).
    """
    if params.model.antenna == AZIMUTH and own is None:
        return SharedSigmas()  # as in the paper, where positions and heights are known
    own, lag_s = own or DEFAULT_ACCURACY, params.stamp_lag_sigma_s
    if lag_s is None:
        lag_s = 0.15 if is_auto else 0.0  # chosen: more widens every R95
    own_height_m = GNSS_ACCURACY_FACTOR * own.vertical_m if own.is_reported else 0.0
    ground_m = 3.0  # sigma of the ground's height; chosen: more widens every R95
    height_m = math.hypot(ground_m, own_height_m) if is_auto else 0.0
    # a fix that is half as accurate is another one with an error of its own; chosen: at a smaller
    # ratio mere noise of the reported accuracy would be a jump
    has_jumped = own.is_reported and best_own_m * 2.0 <= own.horizontal_m
    jump_m = own.effective_m if has_jumped else 0.0
    own_m = own.effective_m
    if params.process_noise_m_per_sqrt_s > 0.0 and not own.is_corrected:
        walk_m = params.process_noise_m_per_sqrt_s * math.sqrt(0.5 * TIME_CONSTANT_S)
        own_m = max(walk_m, own.horizontal_m if own.is_reported else 0.0)
    elif is_auto and own_m > own.horizontal_m:
        own_m = URBAN_GNSS_RATIO * own.horizontal_m
    return SharedSigmas(own_m, height_m, lag_s, jump_m)


class ReceptionPath(NamedTuple):
    """Path on which a radio was received, and the prior of its target that follows."""

    centre_enu_m: Point
    sigma_m: float
    """Standard deviation per axis of the target about the centre."""


class SharedErrors(NamedTuple):
    """Effect of shared errors on the target's position, (2, 2) each, m^2."""

    lasting: Matrix
    """Height and stamps, which another geometry would reveal."""
    wander: Matrix
    """Drift of the vehicle position, which no measurement reveals."""
    own: PositionAccuracy = DEFAULT_ACCURACY
    """Accuracy of the vehicle position on the Earth."""
    reception: ReceptionPath | None = None
    """Path on which the radio was received; None: unknown."""

    def settled_own_m(self, configured_m: float) -> float:
        """Return the position error, m, per axis, besides the drift: both are the same error."""
        return 0.0 if self.wander.any() else configured_m

    def drift_m2(self, configured_m: float) -> Matrix:
        """Return the covariance of the position drift, (2, 2), nowhere less than configured.

        `configured_m` is its standard deviation per axis, by which the same error is assumed.
        """
        values, vectors = np.linalg.eigh(self.wander)
        drift: Matrix = (vectors * np.maximum(values, configured_m**2)) @ vectors.T
        return drift

    def within_reach(self, covariance_m2: Matrix, position_enu_m: Point) -> Matrix:
        """Return a position covariance (2, 2), limited in every direction by the radio's reach.

        The target lies within reach of the path and within its measured covariance: in every
        direction the narrower one holds. First-order theory, on which the shared errors rest, has
        no limit where geometry is singular.
        """
        if self.reception is None or np.trace(covariance_m2) <= self.reception.sigma_m**2:
            return covariance_m2
        away = np.subtract(self.reception.centre_enu_m, position_enu_m)
        reach: Matrix = self.reception.sigma_m**2 * np.eye(2) + np.outer(away, away)
        if not np.isfinite(covariance_m2).all():
            return reach
        half = np.linalg.cholesky(reach)
        whitened = np.linalg.solve(half, np.linalg.solve(half, covariance_m2).T)
        values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
        known = np.maximum(values, np.finfo(float).eps * values[-1])  # smaller ones are rounding
        axes = half @ vectors
        narrower: Matrix = (axes * np.minimum(known, 1.0)) @ axes.T
        return narrower


NO_ERRORS = SharedErrors(np.zeros((2, 2)), np.zeros((2, 2)))
"""No shared errors."""


def shared_errors(
    rows: Matrix,
    times_s: Vector,
    mean: Vector,
    scores: Scores,
    prior: Matrix,
    model: RangingModel,
    sigmas: SharedSigmas,
) -> SharedErrors:
    """Return the effect of shared errors on rows (n, 10 to 18) at `times_s` (n,).

    The rows are linearised at `mean` (k,) as `scores`; `prior` is the information of the state
    besides them, (k, k). Raises `LinAlgError` if the position is unobservable.
    """
    A_inverse = np.asarray(np.linalg.inv(curvature(scores) + prior), dtype=np.float64)
    position_partials: Matrix = scores.H[:, EAST : NORTH + 1]
    considered = []
    if model.height_index < 0 and sigmas.height_m > 0.0:
        considered.append(sigmas.height_m * _height_partials(rows, mean, scores, model))
    if sigmas.lag_s > 0.0:
        velocity = np.tile(_velocities(rows, times_s), (len(scores.u), 1))
        considered.append(sigmas.lag_s * np.sum(position_partials * velocity, axis=1))
    lasting = np.zeros((2, 2))
    if considered:
        lasting = _considered(np.stack(considered, axis=1), scores, A_inverse, prior)
    wander = np.zeros((2, 2))
    if sigmas.own_m > 0.0 and len(times_s):
        wander = sigmas.own_m**2 * _wander(times_s, A_inverse[:2], scores, position_partials)
    wander = wander + sigmas.jump_m**2 * np.eye(2)
    return SharedErrors(lasting, wander)


def _considered(partials: Matrix, scores: Scores, A_inverse: Matrix, prior: Matrix) -> Matrix:
    """Return the effect of parameters with whitened partials (m n, j), each in units of its sigma.

    One Newton step estimates them, and the sandwich of both gives its covariance: where the
    residuals determine a parameter, its estimate replaces its prior sigma.
    """
    k, j = len(prior), partials.shape[1]
    both = replace(scores, H=np.hstack([scores.H, partials]))
    A = curvature(both)
    A_wide = np.zeros((k + j, k + j))
    A_wide[:k, :k], A_wide[k:, k:] = A_inverse, np.eye(j)
    shift = A_inverse @ A[:k, k:]
    alone = np.hstack([-shift.T, np.eye(j)])  # part of a score that the state does not explain
    remaining = alone @ A[:, k:]
    fixed = alone[:, :k] @ prior @ alone[:, :k].T
    white = pooled_variability(both, A_wide, scores.repetition)
    B = max(white, correlated_variability(both), key=lambda each: np.trace(alone @ each @ alone.T))
    floor = 1e-9 * np.eye(j)  # for an inverse where residuals carry no information
    weight = remaining @ np.linalg.inv(alone @ B @ alone.T + fixed + floor)
    V = np.linalg.inv(weight @ remaining + np.eye(j))
    found = V @ weight @ (partials.T @ scores.scored.reshape(-1))
    counted: Matrix = shift[:2] @ (V + np.outer(found, found)) @ shift[:2].T
    return counted


def _height_partials(rows: Matrix, mean: Vector, scores: Scores, model: RangingModel) -> Vector:
    """Return the whitened partials by the target's height, (m n,), 0 where not measured."""
    step_m = 0.5  # far above rounding, and small beside a vehicle's height
    at = np.array(mean)  # as in `WindowMap.scores`
    sigmas = row_sigmas(rows, at, model)
    low, high = (
        row_residuals(rows, at, sigmas, model._replace(height_m=model.height_m + step))
        for step in (-step_m, step_m)
    )
    partials = np.where(scores.is_measured, (low - high) / (2.0 * step_m), 0.0)
    if scores.root_weights is not None:
        partials[POWER] *= scores.root_weights
    return partials.reshape(-1)


def _velocities(rows: Matrix, times_s: Vector) -> Matrix:
    """Return the vehicle's velocity at every row, (n, 2), m/s; 0 across long gaps."""
    n = len(rows)
    before = np.maximum(np.arange(n) - 1, 0)
    after = np.minimum(np.arange(n) + 1, n - 1)
    gap_s = times_s[after] - times_s[before]
    is_known = (gap_s > 1e-3) & (gap_s < GAP_S)
    moved = rows[after, :2] - rows[before, :2]
    velocities: Matrix = np.where(
        is_known[:, None], moved / np.where(is_known, gap_s, 1.0)[:, None], 0.0
    )
    return velocities


def _wander(
    times_s: Vector, A_inverse: Matrix, scores: Scores, position_partials: Matrix
) -> Matrix:
    """Return W / sigma^2, (2, 2)."""
    n, now_s = len(times_s), float(times_s.max())
    bins = 48  # of 10 min: 13 s, short beside tau; the cost grows with the square
    span_s = max(now_s - float(times_s.min()), 1e-6)
    which = np.minimum((bins * (now_s - times_s) / span_s).astype(int), bins - 1)
    middles_s = (np.arange(bins) + 0.5) * span_s / bins
    kept = np.exp(-middles_s / TIME_CONSTANT_S)
    apart = np.exp(-np.abs(middles_s[:, None] - middles_s[None]) / TIME_CONSTANT_S)
    C = apart - kept[:, None] - kept[None] + 1.0
    shift = np.repeat(scores.slopes, n)[:, None] * (scores.H @ A_inverse.T)  # (m n, 2)
    total = np.zeros((2, 2))
    for axis in range(2):
        each = (shift * position_partials[:, axis : axis + 1]).reshape(-1, n, 2).sum(axis=0)
        G = np.stack([np.bincount(which, each[:, row], bins) for row in range(2)], axis=1)
        total += G.T @ C @ G
    return total
