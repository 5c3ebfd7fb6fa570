"""Rival optima of the window, and the odds between them.

The difference of the costs of two optima is a log-likelihood ratio if the noise is that of the
loss. It is divided by the inflation, because inflated noise carries less information. And it
depends on the realisation of the noise: a change e of a residual changes it by (psi_rival -
psi_best) e, so that the sum of these products (with its long-run variance, because residuals are
correlated) shows how easily the difference arises by chance. With z the difference over that
deviation, the odds are no better than Phi(z) / Phi(-z). The smaller of the two odds is used.

Source: Q. H. Vuong, Econometrica 57 (1989), tests two models by the scatter of their likelihood
ratio; here only the noise's part of the scatter counts, because the rest is geometry.

Where errors are spatially correlated, every measurement has the weight that the correlation leaves
of it on average along the path. But two optima differ by residuals that change along the path,
which shared errors do not imitate as easily as an offset: the difference of the costs may decide
although it is small. So its value is judged by the two distributions that it has if one optimum or
the other is true. Their means are D and -D, with D half the weighted square of the difference of
the influences, and both have the variance S of the sum above, with the covariance of the spatial
noise. To S belongs that the path itself is only known to the vehicle's position error, because a
path that bends no more than this does not separate mirror images. S is estimated from so few
independent positions that the distributions are Student's t, with the degrees of freedom that they
leave (F. E. Satterthwaite, Biometrics Bulletin 2, 1946).

Observability. The expected robust curvature matrix is C = sum rho''(r) H H^T / sigma^2, where rho''
is 1 on the quadratic part of the loss and 0 on the saturated ones. Only non-saturated measurements
from diverse directions make it positive definite; the paper calls that bilateral information. With
ranges alone, a target and its mirror image about a straight track are indistinguishable (paper:
section IV-D, Lemma B.1, Propositions B.1 and B.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.estimation.filters.target_filter import Inflation
from companion.estimation.measurement_model import POWER
from companion.estimation.window.sandwich import (
    ALL_WHITE,
    CRITICAL_RATIO,
    Scores,
    SpatialNoises,
    is_all_white,
    long_run_variance,
)
from companion.kernel import Matrix, Vector

IMPROBABLE_LOG_RATIO = math.log(1e-4)
"""Log odds to the best optimum below which one is dropped.

Those that are kept cost a covariance each, a dropped one returns by a fresh start only. With 1e-2
or 1e-8 no R95 of recorded walks changes, nor with 1e-14 for those that a measurement leaves.
"""


@dataclass(frozen=True, slots=True)
class Optimum:
    """Local minimum of the objective."""

    mean: Vector
    cost: float
    covariance: Matrix
    """Sandwich covariance, (n, n), with correlation if requested."""
    inflation: float
    """Variance of the measurements over white thermal noise."""
    scores: Scores
    """Problem linearised at it."""
    noise: Inflation
    """The same inflation of one range, bearing or elevation at its mean weight, uncorrelated."""


def weigh_optima(
    optima: Sequence[Optimum], spatial_noise: SpatialNoises = ALL_WHITE, own_sigma_m: float = 0.0
) -> list[tuple[float, Optimum]]:
    """Return the optima with log-weights, best first, without the improbable ones.

    Only the inflation of the best one is used, because a wrong position makes its residuals
    systematic. The volume of an optimum is ignored, or the least certain one would win.
    `own_sigma_m` is the standard deviation of the vehicle's position at each measurement.
    """
    if not optima:
        return []
    best = min(optima, key=lambda optimum: optimum.cost)
    logs = [(log_ratio(each, best, spatial_noise, own_sigma_m), each) for each in optima]
    return [(log, optimum) for log, optimum in logs if log > IMPROBABLE_LOG_RATIO]


def log_ratio(
    rival: Optimum,
    best: Optimum,
    spatial_noise: SpatialNoises = ALL_WHITE,
    own_sigma_m: float = 0.0,
) -> float:
    """Return the log odds of `rival` to `best`, at most 0."""
    if rival is best:
        return 0.0
    return log_ratio_of(rival.cost, rival.scores, best, spatial_noise, own_sigma_m)


def log_ratio_of(
    cost: float, scores: Scores, best: Optimum, spatial_noise: SpatialNoises, own_sigma_m: float
) -> float:
    """Return the log odds of a rival from its cost and linearised problem alone."""
    if not is_all_white(spatial_noise):
        contrast = contrast_of(scores, best.scores, spatial_noise, own_sigma_m)
        return contrast.log_ratio(cost - best.cost)
    by_noise = (cost - best.cost) / best.inflation
    sensitivity = np.sum((scores.scored - best.scores.scored) * best.scores.scored, axis=0)
    scatter = CRITICAL_RATIO**2 * float(long_run_variance(sensitivity[:, None])[0, 0])
    if scatter <= 0.0:
        return -by_noise
    z = (cost - best.cost) / math.sqrt(scatter)
    by_chance = math.log(math.erfc(-z / math.sqrt(2.0))) - log_erfc(z / math.sqrt(2.0))
    return -min(by_noise, by_chance)


@dataclass(frozen=True, slots=True)
class Contrast:
    """Distribution of the difference of two costs, if one of the two optima is the true one."""

    mean: float
    """Expected difference, from the geometry."""
    variance: float
    degrees: float
    """Degrees of freedom of the variance, from the measurement errors; the vehicle's position error
    is known only by its standard deviation."""

    def log_ratio(self, gap: float) -> float:
        """Return the log odds of the optimum that costs more by `gap`, at most 0."""
        if self.variance <= 0.0:
            return -gap
        scale = self.degrees * self.variance
        far, near = (gap + self.mean) ** 2 / scale, (gap - self.mean) ** 2 / scale
        return min(0.0, 0.5 * (self.degrees + 1.0) * (math.log1p(near) - math.log1p(far)))


def contrast_of(
    rival: Scores, best: Scores, spatial_noise: SpatialNoises, own_sigma_m: float
) -> Contrast:
    """Return the contrast of two optima under spatially correlated errors in some modality."""
    mean = variance = uncertain = of_own = 0.0
    turned = rival.by_position - best.by_position
    for m in best.measured:
        field, away = spatial_noise[m], rival.scored[m] - best.scored[m]
        half_square = 0.5 * float(away @ away)
        if field is None:
            share, degrees = 1.0, float(best.counts[m])
            found = float(np.sum((away * best.scored[m]) ** 2))
        else:
            share, degrees = 1.0 / field.repetition, field.degrees
            roots = best.root_weights
            entering = away if m != POWER or roots is None else roots * away
            found = share**2 * float(field.variance(entering[:, None])[0, 0])
            of_own += share**2 * float(np.sum(field.sums(turned[m]) ** 2))
        mean += share * half_square
        variance += found
        uncertain += found**2 / degrees
    degrees = variance**2 / uncertain if uncertain > 0.0 else 1.0
    return Contrast(mean, variance + own_sigma_m**2 * of_own, degrees)


def log_erfc(x: float) -> float:
    """Return log(erfc(x)) without underflow."""
    if x < 20.0:
        return math.log(math.erfc(x))
    return -x * x - math.log(x * math.sqrt(math.pi))


COLLINEAR_RATIO = 0.05
"""Spread of a track across over its spread along, below which it is a line.

5 m on 100 m: more calls a bend a line, less a line with position errors a bend. It is shown, and
changes no estimate.
"""


@dataclass(frozen=True, slots=True)
class Observability:
    """Live values of the observability at the best hypothesis."""

    ercm: tuple[tuple[float, float], tuple[float, float]]
    """East and north part of the curvature, 1/m^2."""
    min_eigenvalue: float
    """Smallest eigenvalue of it, 1/m^2: curvature in the worst direction."""
    bilateral_share: float
    """Share of measurements on the quadratic part of their loss."""
    track_ratio: float
    """Spread of the track across its own line over the spread along it; 0: collinear."""

    @property
    def is_collinear(self) -> bool:
        """True if the track is a line, so that ranges alone leave a mirror image."""
        return self.track_ratio < COLLINEAR_RATIO


def observability_of(rows: Matrix, scores: Scores) -> Observability:
    """Return the observability of the measurements `rows` (n, 10), linearised as `scores`."""
    is_quadratic = (scores.u == scores.psi) & (scores.is_measured > 0)
    H = scores.H[:, :2]
    C = H.T @ (is_quadratic.reshape(-1, 1) * H)
    measured = int(scores.is_measured.sum())
    _, _, ratio = track_line(rows[:, :2])
    return Observability(
        ercm=((float(C[0, 0]), float(C[0, 1])), (float(C[1, 0]), float(C[1, 1]))),
        min_eigenvalue=float(np.linalg.eigvalsh(C)[0]),
        bilateral_share=float(is_quadratic.sum()) / max(measured, 1),
        track_ratio=ratio,
    )


def track_line(positions: Matrix) -> tuple[Vector, Vector, float]:
    """Return the line that fits a track (n, 2) best: a point, unit direction, and spread ratio.

    The ratio is the spread across over the spread along: 0 for a line or a single position, 1 for a
    track that is as wide as long.
    """
    centre = positions.mean(axis=0)
    values, vectors = np.linalg.eigh(
        np.cov((positions - centre).T) if len(positions) > 1 else np.eye(2)
    )
    along2 = float(values[1])
    ratio = math.sqrt(max(float(values[0]), 0.0) / along2) if along2 > 1e-12 else 0.0
    return centre, vectors[:, 1], ratio


def mirrored(mean: Vector, positions: Matrix) -> Vector:
    """Return the state (k,) reflected about the line of the track of `positions` (n, 2)."""
    centre, direction, _ = track_line(positions)
    away = mean[:2] - centre
    image = np.array(mean)
    image[:2] = centre + 2.0 * direction * float(direction @ away) - away
    return image
