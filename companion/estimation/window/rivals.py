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
of it on average along the path. But two places differ by residuals that change along the path,
which shared errors do not imitate as easily as an offset: the difference of the costs may decide
although it is small. So its value is judged by the two distributions that it has if one place or
the other is true. Their means are D and -D, with D half the weighted square of the difference of
the influences, and both have the variance S of the sum above, with the covariance of the spatial
noise. To S belongs that the path itself is only known to the vehicle's position error, because a
path that bends no more than this does not tell mirror images apart. S is estimated from so few
independent places that the distributions are Student's t, with the degrees of freedom that they
leave (F. E. Satterthwaite, Biometrics Bulletin 2, 1946).
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
"""Log odds to the best optimum below which one is dropped."""


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
    systematic. The volume of an optimum is ignored, or the vaguest would win. `own_sigma_m` is the
    standard deviation of the vehicle's position at each place.
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
    """Return the log odds of a rival of which only cost and linearised problem are known."""
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
    """Distribution of the difference of two costs, if one of the two places is the true one."""

    mean: float
    """Expected difference, from the geometry."""
    variance: float
    degrees: float
    """Degrees of freedom of the variance, from the measurement errors; the vehicle's position error
    is known only by its standard deviation."""

    def log_ratio(self, gap: float) -> float:
        """Return the log odds of the place that costs more by `gap`, at most 0."""
        if self.variance <= 0.0:
            return -gap
        scale = self.degrees * self.variance
        far, near = (gap + self.mean) ** 2 / scale, (gap - self.mean) ** 2 / scale
        return min(0.0, 0.5 * (self.degrees + 1.0) * (math.log1p(near) - math.log1p(far)))


def contrast_of(
    rival: Scores, best: Scores, spatial_noise: SpatialNoises, own_sigma_m: float
) -> Contrast:
    """Return the contrast of two places under spatially correlated errors in some modality."""
    mean = variance = uncertain = of_own = 0.0
    turned = rival.by_place - best.by_place
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
