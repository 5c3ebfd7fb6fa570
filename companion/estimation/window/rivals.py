"""Rival optima of the window, and the odds between them.

The difference of the costs of two optima is a log-likelihood ratio if the noise is that of the
loss. It is divided by the inflation, because inflated noise carries less information. And it
depends on the realisation of the noise: a change e of a residual changes it by (psi_rival -
psi_best) e, so that the sum of these products (with its long-run variance, because residuals are
correlated) shows how easily the difference arises by chance. With z the difference over that
deviation, the odds are no better than Phi(z) / Phi(-z). The smaller of the two odds is used.

Source: Q. H. Vuong, Econometrica 57 (1989), tests two models by the scatter of their likelihood
ratio; here only the noise's part of the scatter counts, because the rest is geometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.estimation.filters.target_filter import Inflation
from companion.estimation.window.sandwich import (
    ALL_WHITE,
    CRITICAL_RATIO,
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
    psi: Matrix
    """(m, n) influences of the measurements."""
    noise: Inflation
    """The same inflation of one range, bearing or elevation at its mean weight, uncorrelated."""


def weigh_optima(
    optima: Sequence[Optimum], spatial_noise: SpatialNoises = ALL_WHITE
) -> list[tuple[float, Optimum]]:
    """Return the optima with log-weights, best first, without the improbable ones.

    Only the inflation of the best one is used, because a wrong position makes its residuals
    systematic. The volume of an optimum is ignored, or the vaguest would win.
    """
    if not optima:
        return []
    best = min(optima, key=lambda optimum: optimum.cost)
    logs = [(log_ratio(each, best, spatial_noise), each) for each in optima]
    return [(log, optimum) for log, optimum in logs if log > IMPROBABLE_LOG_RATIO]


def log_ratio(rival: Optimum, best: Optimum, spatial_noise: SpatialNoises = ALL_WHITE) -> float:
    """Return the log odds of `rival` to `best`, at most 0."""
    return 0.0 if rival is best else log_ratio_of(rival.cost, rival.psi, best, spatial_noise)


def log_ratio_of(cost: float, psi: Matrix, best: Optimum, spatial_noise: SpatialNoises) -> float:
    """Return the log odds of a rival of which only cost and influences (m, n) are known."""
    by_noise = (cost - best.cost) / best.inflation
    scatter = scatter_of(psi, best.psi, spatial_noise)
    if scatter <= 0.0:
        return -by_noise
    z = (cost - best.cost) / math.sqrt(scatter)
    by_chance = math.log(math.erfc(-z / math.sqrt(2.0))) - log_erfc(z / math.sqrt(2.0))
    return -min(by_noise, by_chance)


def scatter_of(rival: Matrix, best: Matrix, spatial_noise: SpatialNoises) -> float:
    """Return the variance of the difference of two costs by the noise.

    It follows from the influences (m, n) of the rival and of the best; spatially correlated errors
    contribute by the covariance of their `spatial_noise`.
    """
    if is_all_white(spatial_noise):
        sensitivity = np.sum((rival - best) * best, axis=0)
        return float(CRITICAL_RATIO**2 * long_run_variance(sensitivity[:, None])[0, 0])
    scatter = 0.0
    for index, field in enumerate(spatial_noise[: len(best)]):
        away = (rival[index] - best[index])[:, None]
        if field is None:
            scatter += float(np.sum((away[:, 0] * best[index]) ** 2))
        else:
            scatter += float(field.variance(away)[0, 0]) / field.repetition**2
    return scatter


def log_erfc(x: float) -> float:
    """Return log(erfc(x)) without underflow."""
    if x < 20.0:
        return math.log(math.erfc(x))
    return -x * x - math.log(x * math.sqrt(math.pi))
