"""How much more probable one optimum of the window is than another.

The difference of their costs is a log-likelihood ratio if the noise is what the loss believes. It
is divided by the inflation, because inflated noise says that much less. And it depends on the very
noise that was drawn: a residual e more changes it by (psi_rival - psi_best) e, so that the sum of
these products (with its long-run variance, because residuals repeat each other) tells how easily
the difference came about by chance. With z the difference over that deviation, the odds are no
better than Phi(z) / Phi(-z). The more careful of the two counts.

Source: Q. H. Vuong, Econometrica 57 (1989), tests two models by the scatter of their likelihood
ratio; here only the part of the scatter that noise makes counts, because the rest is geometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.estimation.sandwich import CRITICAL_RATIO, long_run_variance
from companion.estimation.window_map import Optimum

IMPROBABLE_LOG_RATIO = math.log(1e-4)
"""An optimum this much less probable than the best one is dropped."""


def weighted(optima: Sequence[Optimum]) -> list[tuple[float, Optimum]]:
    """Log-weights of the optima, best first, without the improbable ones.

    Only the inflation of the best one counts: a wrong place makes its residuals systematic. Nor
    does volume, or the vaguest would win.
    """
    if not optima:
        return []
    best = min(optima, key=lambda optimum: optimum.cost)
    logs = [(log_ratio(optimum, best), optimum) for optimum in optima]
    return [(log, optimum) for log, optimum in logs if log > IMPROBABLE_LOG_RATIO]


def log_ratio(rival: Optimum, best: Optimum) -> float:
    """Log of how probable `rival` is beside `best`, at most 0."""
    if rival is best:
        return 0.0
    by_noise = (rival.cost - best.cost) / best.inflation
    sensitivity = np.sum((rival.psi - best.psi) * best.psi, axis=0)
    scatter = float(long_run_variance(sensitivity[:, None])[0, 0])
    if scatter <= 0.0:
        return -by_noise
    z = (rival.cost - best.cost) / (CRITICAL_RATIO * math.sqrt(scatter))
    by_chance = math.log(math.erfc(-z / math.sqrt(2.0))) - log_erfc(z / math.sqrt(2.0))
    return -min(by_noise, by_chance)


def log_erfc(x: float) -> float:
    """log(erfc(x)) without underflow."""
    if x < 20.0:
        return math.log(math.erfc(x))
    return -x * x - math.log(x * math.sqrt(math.pi))
