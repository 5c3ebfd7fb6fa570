"""Covariance of an M-estimate: Huber's sandwich.

Theory of operation. With partials H and influences psi (all whitened), A = sum psi' H H^T and B =
the variance of sum psi H, the estimate's covariance is A^-1 B A^-1. The slope psi' and the second
moment psi^2 are pooled per modality, because 2 numbers are estimated faster than a matrix.

A measurement that dominates the estimate is not balanced by others: its error enters unclipped.
With its leverage h, the share of the curvature along its own direction, the second moment is (1 -
h) E[psi^2] + h slope^2 E[u^2].

Where residuals are correlated, as recorded ranges are, B accounts for it in two ways: by the factor
(1 + rho) / (1 - rho) of a first-order process, and as the long-run variance (Bartlett weights),
whose small-sample bias is corrected by the fixed-bandwidth critical value.

Sources: P. J. Huber, Robust Statistics (1981), chapter 6; for the critical value N. M. Kiefer and
T. J. Vogelsang, Econometric Theory 21 (2005).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from companion.estimation.measurement_model import MODALITIES, POWER
from companion.estimation.stepwise import Steps
from companion.estimation.window.spatial_noise import SpatialNoise
from companion.kernel import Matrix, Vector

SpatialNoises = tuple[SpatialNoise | None, ...]
"""Spatial noise of each modality; None: its errors are white."""
ALL_WHITE: SpatialNoises = (None,) * MODALITIES
"""No spatial correlation in any modality."""
Shares = tuple[float, ...]
"""Weight of a measurement of each modality, as a share of an independent one."""
ALL_WHOLE: Shares = (1.0,) * (MODALITIES + 1)
"""Full weight of every modality."""


def is_all_white(spatial_noise: SpatialNoises) -> bool:
    """Return True if no modality has spatially correlated errors."""
    return all(field is None for field in spatial_noise)


BANDWIDTH = 0.2
"""Bandwidth of the Bartlett weights, as a share of the window.

Chosen: a wider one has less bias by long correlation, and more scatter, which `CRITICAL_RATIO`
corrects.
"""
CRITICAL_RATIO = (1.96 + 2.9694 * BANDWIDTH + 0.416 * BANDWIDTH**2 - 0.5324 * BANDWIDTH**3) / 1.96
"""Fixed-bandwidth 97.5 % critical value over the normal one (Kiefer and Vogelsang)."""
MIN_SLOPE = 0.05
"""Lower limit of the share of measurements on the quadratic part.

Chosen: a variance scales with its inverse square, which below this is mostly chance.
"""
PRIOR_COUNT = 4.0
"""Weight of thermal noise in the pooled second moment, in measurements.

Chosen: with less, a few small residuals underestimate the noise; more delays its estimate.
"""
MAX_CORRELATION = 0.98
"""Upper limit of a lag-1 correlation, at which 99 measurements have the weight of one."""
SIGNIFICANT_SIGMAS = 2.0
"""Standard errors from which a correlation is significant: white residuals exceed it once in 44."""
MIN_MEASUREMENTS = 12
"""Fewest measurements for a solution, a correlation, or a scatter: three times the basic state."""


@dataclass(frozen=True)
class Scores:
    """Linearised problem at an estimate, modality by modality."""

    u: Matrix
    """(m, n) whitened residuals of the model's modalities."""
    psi: Matrix
    """(m, n) influence of each residual: the derivative of its loss."""
    H: Matrix
    """(m n, k) whitened partials, zero rows where nothing was measured."""
    is_measured: Matrix
    """(m, n) booleans."""
    thermal: tuple[float, ...] = (1.0,) * (MODALITIES + 1)
    """Second moment of each modality's influence under thermal noise alone."""
    root_weights: Vector | None = None
    """(n,) square roots of the weights of received powers, by which their partials are multiplied;
    None: there are none."""

    def weighed(self, weights: Vector) -> Scores:
        """Return the same problem with weights (n,) of received powers.

        They account for shadows that neighbours share, so that a weighted measurement is as good as
        an independent one: A and B contain the same weight.
        """
        n, roots = self.u.shape[1], np.sqrt(weights)
        H = self.H.copy()
        H[POWER * n :] *= roots[:, None]
        return replace(self, H=H, root_weights=roots)

    @cached_property
    def scored(self) -> Matrix:
        """(m, n) influences as they enter the score with H, weights included."""
        if self.root_weights is None:
            return self.psi
        scored = self.psi.copy()
        scored[POWER] *= self.root_weights
        return scored

    @cached_property
    def by_position(self) -> Matrix:
        """(m, n, 2) derivative of each measurement's cost by the vehicle's position, per metre."""
        H = self.H[:, :2].reshape(*self.psi.shape, 2)
        return np.asarray(self.scored[:, :, None] * H)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of measurements of each modality, (m,)."""
        counts: list[int] = np.count_nonzero(self.is_measured, axis=1).tolist()
        return tuple(counts)

    @cached_property
    def slopes(self) -> tuple[float, ...]:
        """Share of each modality's measurements on the quadratic part, (m,)."""
        quadratic = np.count_nonzero((self.u == self.psi) & self.is_measured, axis=1).tolist()
        return tuple(
            max(part / n, MIN_SLOPE) if n else 1.0
            for part, n in zip(quadratic, self.counts, strict=True)
        )

    @cached_property
    def measured(self) -> list[int]:
        """Modalities with any measurement: the others' rows are zero."""
        return [modality for modality, n in enumerate(self.counts) if n]

    def part(self, modality: int) -> Matrix:
        """Return the partials of one modality, (n, k)."""
        n = self.u.shape[1]
        rows: Matrix = self.H[modality * n : (modality + 1) * n]
        return rows

    def entering(self, modality: int) -> Matrix:
        """Return the derivatives of the score by one modality's influences, (n, k).

        They are its partials, with their weights as a whole, where `part` has the roots.
        """
        part = self.part(modality)
        if modality != POWER or self.root_weights is None:
            return part
        return np.asarray(self.root_weights[:, None] * part)

    def moment(self, modality: int, parameters: int) -> float:
        """Return the pooled second moment of the influence, limited below near thermal noise."""
        n = self.counts[modality]
        thermal = self.thermal[modality]
        total = float(np.sum(self.psi[modality] ** 2))
        pooled = (
            (total + PRIOR_COUNT * thermal)
            / (n + PRIOR_COUNT)
            * (n + 1.0)
            / max(n + 1.0 - parameters, 1)
        )
        return max(pooled, thermal * (1.0 - 2.0 * math.sqrt(2.0 / (n + PRIOR_COUNT))))

    def quantile_ratio(self, modality: int) -> float:
        """Return the ratio of the 95 % interval to the normal one: slope and moment are estimates.

        Its degrees of freedom match the variance of the estimated ratio moment / slope^2
        (Satterthwaite).
        """
        n, slope = self.counts[modality], self.slopes[modality]
        variance = (1.0 + 4.0 * (1.0 - slope) / slope) / (n + PRIOR_COUNT)
        return student_ratio(2.0 / variance)

    def finite_sample_ratio(self, modality: int, parameters: float) -> float:
        """Return Huber's K: a fit makes residuals look more quadratic than they are.

        K = 1 + p / n Var[psi'] / E[psi']^2, eq. (6.5) of chapter 7 in Huber (1981), with p the
        parameters that this modality determines.
        """
        n, slope = max(self.counts[modality], 1), self.slopes[modality]
        return 1.0 + parameters / n * (1.0 - slope) / slope

    def inflation(self, modality: int, parameters: int) -> float:
        """Return the variance of a measurement at its mean weight over thermal noise."""
        seen = self.is_measured[modality]
        u, psi = self.u[modality][seen], self.psi[modality][seen]
        weights = np.where(u == psi, 1.0, psi / np.where(u == psi, 1.0, u))
        mean_weight = (float(weights.sum()) + PRIOR_COUNT) / (len(u) + PRIOR_COUNT)
        moment = self.moment(modality, parameters) * self.quantile_ratio(modality) ** 2
        return mean_weight * moment / self.slopes[modality] ** 2

    def unclipped_moment(self, modality: int) -> float:
        """Return the pooled second moment of the residuals themselves."""
        n = self.counts[modality]
        most = 10.0  # sigma; chosen: where the loss does not clip, no residual is all of the sum
        u = np.clip(self.u[modality], -most, most)
        return (float(np.sum(u**2)) + PRIOR_COUNT) / (n + PRIOR_COUNT)

    def correlation(self, modality: int) -> float:
        """Return the lag-1 correlation of the influences in time order, 0 if not significant."""
        if self.counts[modality] < MIN_MEASUREMENTS:
            return 0.0
        psi = self.psi[modality][self.is_measured[modality]]
        psi = psi - psi.mean()
        variance = float(np.mean(psi**2))
        if variance <= 0.0:
            return 0.0
        rho = float(np.mean(psi[1:] * psi[:-1])) / variance
        if rho <= SIGNIFICANT_SIGMAS / math.sqrt(len(psi)):
            return 0.0
        fitted = self.H.shape[1] / len(psi)  # share of the correlation that the fit absorbed
        return float(min(rho + fitted * (1.0 + rho), MAX_CORRELATION))

    @cached_property
    def correlations(self) -> tuple[float, ...]:
        """Lag-1 `correlation` of each modality, (m,)."""
        weighed = POWER if self.root_weights is not None else None
        return tuple(0.0 if m == weighed else self.correlation(m) for m in range(len(self.u)))

    @cached_property
    def repetition(self) -> Vector:
        """Factor (1 + rho) / (1 - rho) of each modality, (m,), for a first-order process."""
        rho = np.array(self.correlations)
        return np.asarray((1.0 + rho) / (1.0 - rho))


def student_ratio(degrees: float) -> float:
    """Return the 97.5 % quantile of Student's t over the normal one (Cornish-Fisher).

    Below two degrees of freedom it is that of two.
    """
    dof, z2 = max(degrees, 2.0), 1.96**2
    return 1.0 + (z2 + 1.0) / (4.0 * dof) + (5.0 * z2**2 + 16.0 * z2 + 3.0) / (96.0 * dof**2)


def thermal_moment(k_long: float, k_short: float) -> float:
    """Return E[psi^2] of a standard normal residual, clipped at the two thresholds."""
    return sum(
        0.5
        if math.isinf(k)
        else 0.5 * math.erf(k / math.sqrt(2.0))
        - k * math.exp(-0.5 * k * k) / math.sqrt(2.0 * math.pi)
        + 0.5 * k * k * math.erfc(k / math.sqrt(2.0))
        for k in (k_long, k_short)
    )


def curvature(scores: Scores, shares: Shares = ALL_WHOLE) -> Matrix:
    """Return A = sum psi' H H^T with pooled slopes, (k, k), each modality times its share."""
    k = scores.H.shape[1]
    A: Matrix = np.zeros((k, k))
    for m in scores.measured:
        H = scores.part(m)
        A += shares[m] * scores.slopes[m] * (H.T @ H)
    return A


def pooled_variability(scores: Scores, A_inverse: Matrix, repetition: Vector) -> Matrix:
    """Return B with pooled second moments, (k, k), each modality times its `repetition` (m,)."""
    k = scores.H.shape[1]
    B = np.zeros((k, k))
    for m in scores.measured:
        H = scores.part(m)
        slope, moment = scores.slopes[m], scores.moment(m, k)
        leverage = np.minimum(slope * np.sum((H @ A_inverse) * H, axis=1), 1.0)
        unclipped = max(slope**2 * scores.unclipped_moment(m), moment)
        spread = scores.quantile_ratio(m) * scores.finite_sample_ratio(m, float(leverage.sum()))
        H = math.sqrt(repetition[m]) * spread * H
        B += H.T @ ((moment + leverage * (unclipped - moment))[:, None] * H)
    return B


def spatial_variability(scores: Scores, spatial_noise: SpatialNoises, A_inverse: Matrix) -> Matrix:
    """Return B under spatially correlated errors, (k, k); modalities without a field are white."""
    k = scores.H.shape[1]
    white = np.array([1.0 if field is None else 0.0 for field in spatial_noise])
    B = pooled_variability(scores, A_inverse, white)
    for m in scores.measured:
        field = spatial_noise[m]
        if field is None:
            continue
        H, share = scores.part(m), 1.0 / field.repetition
        leverage = share * scores.slopes[m] * float(np.sum((H @ A_inverse) * H))
        spread = scores.quantile_ratio(m) * scores.finite_sample_ratio(m, min(leverage, k))
        B += (share * spread) ** 2 * field.variance(scores.entering(m))
    return B


def shares_of(spatial_noise: SpatialNoises) -> Shares:
    """Return the weight of a measurement of each modality that its spatial noise leaves, (m,)."""
    return tuple(1.0 if field is None else 1.0 / field.repetition for field in spatial_noise)


def correlated_variability(scores: Scores, shares: Shares = ALL_WHOLE) -> Matrix:
    """Return B as the long-run variance of the scores, (k, k), critical value included."""
    steps = np.zeros((scores.u.shape[1], scores.H.shape[1]))
    for m in scores.measured:
        steps += shares[m] * scores.part(m) * scores.scored[m][:, None]
    return CRITICAL_RATIO**2 * long_run_variance(steps)


def covariance_of(A: Matrix, B: Matrix) -> Matrix:
    """Return A^-1 B A^-1, positive definite; `LinAlgError` if the position is unobservable."""
    A_inverse = np.linalg.inv(A)
    share = 1e-3  # of the thermal covariance, for a singular B: sigmas grow by 0.05 %
    covariance = A_inverse @ (B + share * A) @ A_inverse
    covariance = 0.5 * (covariance + covariance.T)
    np.linalg.cholesky(covariance)
    return np.asarray(covariance, dtype=np.float64)


def long_run_variance(scores: Vector) -> Matrix:
    """Return the Bartlett-weighted sum of the scores' autocovariances, (k, k), semi-definite."""
    n = len(scores)
    width = max(1, int(BANDWIDTH * n)) + 1
    # squared sums over all runs of `width` neighbours have exactly these weights
    sums = np.concatenate([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    end = np.arange(1, n + width)
    moving = sums[np.minimum(end, n)] - sums[np.maximum(end - width, 0)]
    total: Matrix = moving.T @ moving / width
    return total


MIN_RISE_SHARE = 0.5
"""Minimum share of the predicted rise of the cost at the edge that confirms the curvature.

Chosen: less accepts a flat valley, more widens an optimum that is merely not parabolic.
"""
STRETCHES = tuple(1.5**i for i in range(1, 9))
"""Stretch factors that are tried, up to 26.

Chosen: smaller steps cost more evaluations; between two a profiled cost is interpolated.
"""


class Valley(NamedTuple):
    """Cost function around an optimum."""

    cost: Callable[[Vector], float]
    """Cost of a state, (k,)."""
    profiled: Callable[[Vector], Steps[float]]
    """The cost minimised over the other states, which is never larger."""
    noise: float
    """Largest variance of the measurements over thermal noise in any direction."""
    is_white: bool = False
    """True if no error is spatially correlated: `cost` alone decides about a stretch."""
    worth: int = 0
    """Work of one evaluation of the cost, in measurements."""


def fit_covariance(covariance: Matrix, A: Matrix, mean: Vector, valley: Valley) -> Steps[Matrix]:
    """Return the covariance with its longest axis fitted to the rise of the cost.

    The profiled cost rises by the profiled curvature 1 / v^T A^-1 v in direction v; it is evaluated
    only where the cost rises enough. With it each side has its own factor, and its share of the
    probability is that of its width. A side shrinks where the cost rises by more than the noise
    explains.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    sigma_m, v = math.sqrt(max(float(values[1]), 0.0)), vectors[:, 1]
    if sigma_m == 0.0:
        return covariance
    axis: Vector = covariance[:, :2] @ v / sigma_m
    curvature = float(axis @ A @ axis)
    if not valley.is_white:
        curvature = float(values[1] / (v @ np.linalg.inv(A)[:2, :2] @ v))
    edge_sigmas = 2.45  # radius of the 95 % circle of a 2-D Gaussian
    least = 0.5 * edge_sigmas**2 * curvature * MIN_RISE_SHARE
    most = 0.5 * edge_sigmas**2 * max(curvature, valley.noise) / MIN_RISE_SHARE
    base, sides = valley.cost(mean), []
    for side in (-1.0, 1.0):
        edge = side * edge_sigmas * axis
        sides.append((yield from _factor(mean, edge, base, least, most, valley)))
    one, other = sides
    if one == other == 1.0:
        return covariance
    # second moment about the mode of a normal whose two halves have these deviations
    factor2 = one * one - one * other + other * other
    if valley.is_white and max(sides) > 1.0:
        factor2 = max(sides) ** 2
    fitted: Matrix = covariance + (factor2 - 1.0) * np.outer(axis, axis)
    return fitted


def _factor(
    mean: Vector, edge: Vector, base: float, least: float, most: float, valley: Valley
) -> Steps[float]:
    """Return the factor on `edge` (k,) at which the cost has risen from `base` by enough.

    It is 1 where it rises by `least` to `most`. Across a straight path on which the target lies,
    ranges have no curvature, but a cost that rises with the fourth power: by the curvature alone,
    the target could be anywhere across.
    """
    last, below = 1.0, valley.cost(mean + edge) - base
    yield valley.worth
    is_unsure = below >= least and not valley.is_white
    while below > most:
        last /= STRETCHES[1]  # two steps at once: every step back profiles
        below = valley.cost(mean + last * edge) - base
        yield valley.worth
    while last < 1.0 or is_unsure:
        factor, is_unsure = min(STRETCHES[1] * last, 1.0), False
        rise = (yield from valley.profiled(mean + factor * edge)) - base
        if rise > most:
            return _between(last, below, factor, rise, most)
        last, below = factor, rise
    if below >= least:
        return 1.0
    return (yield from _stretch(mean, edge, base, least, below, valley))


def _stretch(
    mean: Vector, edge: Vector, base: float, least: float, below: float, valley: Valley
) -> Steps[float]:
    """Return the factor on `edge` (k,), over 1, from a rise `below` that is not enough.

    A cost that is not profiled rises by too much, because the rest of the state stays: the factor
    is the next one that was tried.
    """
    last = 1.0
    for factor in STRETCHES:
        at = mean + factor * edge
        rise = valley.cost(at) - base
        yield valley.worth
        if rise >= least and not valley.is_white:
            rise = (yield from valley.profiled(at)) - base
        if rise >= least:
            return factor if valley.is_white else _between(last, below, factor, rise, least)
        last, below = factor, rise
    return last


def _between(last: float, below: float, factor: float, above: float, wanted: float) -> float:
    """Return the factor at which a cost rises by `wanted`, between two that rise by less and more.

    The rise is taken as a power of the factor, which for a parabola is the second.
    """
    below = max(below, 1e-3 * wanted)  # flat: the factor is nearly the larger one
    share = math.log(wanted / below) / math.log(above / below)
    return float(last * (factor / last) ** share)
