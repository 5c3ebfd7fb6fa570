"""Errors that a window's measurements share, and that no number of them averages out.

Theory of operation. A displacement d of what is seen moves a measurement by its partial p times d,
and so the M-estimate by A^-1 sum s H^T p d, with H the whitened partials, s the slope of each
modality and A the curvature (a "considered" parameter: S. F. Schmidt, Advances in Control Systems
3, 1966). To first order this holds for any weights, however wrong.

The own place errs by a first-order Gauss-Markov process b of sigma and time constant tau, so that
the emitter seems to have been elsewhere, by b(t) - b(now), when it was measured. Where that is all
that counts, it adds up to

    W = sum_ij G_i C(t_i, t_j) G_j^T,    C(s, t) = sigma^2 (rho(s - t) - rho(s) - rho(t) + 1)

with G_i = A^-1 H_i^T H_i,place and rho(t) = exp(-|t| / tau), times counted from now. A height that
is not in the state, and stamps that are late by an unknown time, do show in residuals, as far as
the views differ: they count by what these leave of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.domain import UNTOLD, OwnAccuracy
from companion.estimation.measurement_model import EAST, NORTH, RangingModel
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
"""Of satellites on one frequency: 60 to 1,000 s."""
BINS = 48
"""The window is cut into as many times."""
HEIGHT_STEP_M = 0.5
LEAST_TOLD = 1e-9
"""Of a variance, so that it can be divided by where nothing is told."""
LONGEST_GAP_S = 2.0
"""Between rows farther apart than this no velocity is known."""


class SharedSigmas(NamedTuple):
    """Standard deviations of what all measurements share."""

    own_m: float = 0.0
    """Of the own place, per axis."""
    height_m: float = 0.0
    """Of the height between vehicle and target, where the state has none."""
    lag_s: float = 0.0
    """Of what the radio's stamps are late."""
    jump_m: float = 0.0
    """Of the own place, per axis, while its fix was another one."""


class HeardPath(NamedTuple):
    """The path on which a radio was heard, and how far off its target can be."""

    centre_enu_m: Point
    sigma_m: float
    """Standard deviation per axis of the target about the centre."""


class SharedErrors(NamedTuple):
    """What they make of the target's place, (2, 2) each, m^2."""

    lasting: Matrix
    """Of height and stamps, which another geometry would show."""
    wander: Matrix
    """Of the own place, which nothing shows."""
    own: OwnAccuracy = UNTOLD
    """How well that is known on the Earth."""
    heard: HeardPath | None = None
    """Where the radio was heard; None: not known."""

    def within_reach(self, covariance_m2: Matrix, place_enu_m: Point) -> Matrix:
        """Return a covariance (2, 2) about a place, in no direction wider than the reach says.

        That the target lies within reach of where it was heard and what measurements say of it are
        two statements, each true by itself: the narrower one holds in every direction. First-order
        theory, by which shared errors are counted, promises nothing where geometry is singular.
        """
        if self.heard is None or np.trace(covariance_m2) <= self.heard.sigma_m**2:
            return covariance_m2
        away = np.subtract(self.heard.centre_enu_m, place_enu_m)
        reach: Matrix = self.heard.sigma_m**2 * np.eye(2) + np.outer(away, away)
        if not np.isfinite(covariance_m2).all():
            return reach
        half = np.linalg.cholesky(reach)
        whitened = np.linalg.solve(half, np.linalg.solve(half, covariance_m2).T)
        values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
        known = np.maximum(values, np.finfo(float).eps * values[-1])  # less is lost in rounding
        axes = half @ vectors
        narrower: Matrix = (axes * np.minimum(known, 1.0)) @ axes.T
        return narrower


NO_ERRORS = SharedErrors(np.zeros((2, 2)), np.zeros((2, 2)))


def shared_errors(
    rows: Matrix,
    times_s: Vector,
    mean: Vector,
    scores: Scores,
    prior: Matrix,
    model: RangingModel,
    sigmas: SharedSigmas,
) -> SharedErrors:
    """Of rows (n, 10 or 16) at `times_s` (n,), linearised at `mean` (k,) as `scores`.

    `prior` is the state's information beside them, (k, k). A `LinAlgError` where no place is named.
    """
    A_inverse = np.asarray(np.linalg.inv(curvature(scores) + prior), dtype=np.float64)
    place: Matrix = scores.H[:, EAST : NORTH + 1]
    considered = []
    if model.height_index < 0 and sigmas.height_m > 0.0:
        considered.append(sigmas.height_m * _height_partials(rows, mean, scores, model))
    if sigmas.lag_s > 0.0:
        velocity = np.tile(_velocities(rows, times_s), (3, 1))
        considered.append(sigmas.lag_s * np.sum(place * velocity, axis=1))
    lasting = np.zeros((2, 2))
    if considered:
        lasting = _considered(np.stack(considered, axis=1), scores, A_inverse, prior)
    wander = np.zeros((2, 2))
    if sigmas.own_m > 0.0 and len(times_s):
        wander = sigmas.own_m**2 * _wander(times_s, A_inverse[:2], scores, place)
    wander = wander + sigmas.jump_m**2 * np.eye(2)
    return SharedErrors(lasting, wander)


def _considered(partials: Matrix, scores: Scores, A_inverse: Matrix, prior: Matrix) -> Matrix:
    """What parameters with these whitened partials (3 n, j), each by its sigma, make of the place.

    One Newton step finds them, and the sandwich of both how well: by as much as the residuals then
    speak about them, each counts by what it comes to and not by what it may be.
    """
    k, j = len(prior), partials.shape[1]
    both = replace(scores, H=np.hstack([scores.H, partials]))
    A = curvature(both)
    A_wide = np.zeros((k + j, k + j))
    A_wide[:k, :k], A_wide[k:, k:] = A_inverse, np.eye(j)
    shift = A_inverse @ A[:k, k:]
    alone = np.hstack([-shift.T, np.eye(j)])  # of a score, what the state does not explain
    told = alone @ A[:, k:]
    fixed = alone[:, :k] @ prior @ alone[:, :k].T
    white = pooled_variability(both, A_wide, scores.repetition)
    B = max(white, correlated_variability(both), key=lambda each: np.trace(alone @ each @ alone.T))
    weight = told @ np.linalg.inv(alone @ B @ alone.T + fixed + LEAST_TOLD * np.eye(j))
    V = np.linalg.inv(weight @ told + np.eye(j))
    found = V @ weight @ (partials.T @ scores.psi.reshape(-1))
    counted: Matrix = shift[:2] @ (V + np.outer(found, found)) @ shift[:2].T
    return counted


def _height_partials(rows: Matrix, mean: Vector, scores: Scores, model: RangingModel) -> Vector:
    """Whitened partials by the target's height, (3 n,), 0 where nothing was measured."""
    at = np.array(mean)  # as in `WindowMap.scores`
    sigmas = row_sigmas(rows, at, model)
    low, high = (
        row_residuals(rows, at, sigmas, model._replace(height_m=model.height_m + step))
        for step in (-HEIGHT_STEP_M, HEIGHT_STEP_M)
    )
    partials = np.where(scores.is_measured, (low - high) / (2.0 * HEIGHT_STEP_M), 0.0)
    return partials.reshape(-1)


def _velocities(rows: Matrix, times_s: Vector) -> Matrix:
    """Of the vehicle at every row, (n, 2), m/s; 0 where its neighbours are too far off."""
    n = len(rows)
    before = np.maximum(np.arange(n) - 1, 0)
    after = np.minimum(np.arange(n) + 1, n - 1)
    gap_s = times_s[after] - times_s[before]
    is_known = (gap_s > 1e-3) & (gap_s < LONGEST_GAP_S)
    moved = rows[after, :2] - rows[before, :2]
    velocities: Matrix = np.where(
        is_known[:, None], moved / np.where(is_known, gap_s, 1.0)[:, None], 0.0
    )
    return velocities


def _wander(times_s: Vector, A_inverse: Matrix, scores: Scores, place: Matrix) -> Matrix:
    """W / sigma^2, (2, 2)."""
    n, now_s = len(times_s), float(times_s.max())
    span_s = max(now_s - float(times_s.min()), 1e-6)
    which = np.minimum((BINS * (now_s - times_s) / span_s).astype(int), BINS - 1)
    middles_s = (np.arange(BINS) + 0.5) * span_s / BINS
    kept = np.exp(-middles_s / TIME_CONSTANT_S)
    apart = np.exp(-np.abs(middles_s[:, None] - middles_s[None]) / TIME_CONSTANT_S)
    C = apart - kept[:, None] - kept[None] + 1.0
    shift = np.repeat(scores.slopes, n)[:, None] * (scores.H @ A_inverse.T)  # (3 n, 2)
    total = np.zeros((2, 2))
    for axis in range(2):
        each = (shift * place[:, axis : axis + 1]).reshape(3, n, 2).sum(axis=0)
        G = np.stack([np.bincount(which, each[:, row], BINS) for row in range(2)], axis=1)
        total += G.T @ C @ G
    return total
