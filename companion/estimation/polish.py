"""What a solved window means for the hypotheses: confirmed, moved, added or dropped."""

from __future__ import annotations

import math

import numpy as np

from companion.estimation.base import FilterState
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.window_map import Optimum

CONFIRMED_DISTANCE2 = 9.0
"""A hypothesis within this (Mahalanobis, squared) of an optimum is confirmed by it."""

IMPROBABLE_LOG_RATIO = math.log(1e-4)
"""An optimum this much less probable than the best one is dropped."""


def weighted(optima: list[Optimum]) -> list[tuple[float, Optimum]]:
    """Log-weights of the optima, best first, without the improbable ones.

    The cost decides, divided by the inflation at the best one: correlated residuals say less about
    which optimum is right, too. A rival's own inflation does not count, because a wrong place makes
    its residuals systematic; nor does its volume, or the vaguest would win.
    """
    if not optima:
        return []
    best = min(optima, key=lambda optimum: optimum.cost)
    logs = [((best.cost - optimum.cost) / best.inflation, optimum) for optimum in optima]
    return [(log, o) for log, o in logs if log > IMPROBABLE_LOG_RATIO]


def polished(
    hypotheses: tuple[Hypothesis, ...],
    optima: list[Optimum],
    time_s: float,
    *,
    keep_confirmed: bool,
) -> tuple[Hypothesis, ...]:
    """The hypotheses after the window was solved.

    A hypothesis that an optimum confirms may stay, if it has seen more than the window.
    Otherwise the optima replace the hypotheses.

    Args:
        hypotheses: The filter's, best first.
        optima: The window's.
        time_s: The time of the states that replace.
        keep_confirmed: Whether confirmed hypotheses stay; not while the window holds every
            measurement, nor where residuals are correlated, because then the recursive
            covariance is the worse one.
    """
    candidates = weighted(optima)
    if not candidates:
        return hypotheses
    kept: list[Hypothesis] = []
    for log_weight, optimum in candidates:
        state = _confirmed(hypotheses, optimum) if keep_confirmed else None
        if state is None:
            state = FilterState.of(time_s, optimum.mean, optimum.covariance)
        kept.append(Hypothesis(log_weight, state, optimum.covariance))
    return tuple(kept)


def _confirmed(hypotheses: tuple[Hypothesis, ...], optimum: Optimum) -> FilterState | None:
    """The state of the hypothesis that an optimum confirms, or None."""
    for hypothesis in hypotheses:
        difference = hypothesis.state.mean[:2] - optimum.mean[:2]
        spread = hypothesis.state.covariance[:2, :2]
        if float(difference @ np.linalg.solve(spread, difference)) < CONFIRMED_DISTANCE2:
            return hypothesis.state
    return None
