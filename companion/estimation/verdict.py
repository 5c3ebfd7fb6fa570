"""From hypotheses to the estimate that is told: place, R95, and whether that is enough."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.domain import EstimateState, TargetEstimate
from companion.estimation.consistency import r95_of_covariance_m, r95_of_mixture_m
from companion.estimation.hypotheses import Hypothesis, probabilities
from companion.geometry.arrays import Matrix, Vector
from companion.models.ranging_model import BEARING_OFFSET, RANGE_OFFSET, RangingModel

AMBIGUOUS_PROBABILITY = 0.05
"""A second hypothesis with at least this probability makes the estimate ambiguous."""
MAX_AMBIGUOUS = 3
"""More distinct places than this is searching, not ambiguous."""


def estimate_of(
    hypotheses: Sequence[Hypothesis],
    model: RangingModel,
    localised_r95_m: float,
    measurements: int,
    now_s: float,
    *,
    is_diverged: bool,
) -> TargetEstimate:
    """What the hypotheses add up to.

    Args:
        hypotheses: At least one, best first.
        model: Layout of the state.
        localised_r95_m: The state is `localised` while R95 is at most this.
        measurements: Accepted so far.
        now_s: The present.
        is_diverged: Whether the filter was started anew a short while ago.
    """
    weights, best = probabilities(hypotheses), hypotheses[0]
    covariances = [position_covariance_m2(h, model.own_sigma_m) for h in hypotheses]
    r95_m = _r95_m(hypotheses, weights, covariances)
    state = EstimateState.DIVERGED if is_diverged else _state(weights, r95_m, localised_r95_m)
    is_ambiguous = state is EstimateState.AMBIGUOUS
    mean, P = best.state.mean, best.state.covariance
    height, scale = model.height_index, model.scale_index
    (a, b), (_, c) = covariances[0].tolist()
    return TargetEstimate(
        time_s=now_s,
        state=state,
        position_enu_m=best.place_enu_m,
        covariance_m2=((a, b), (b, c)),
        r95_m=r95_m,
        range_offset_m=float(mean[RANGE_OFFSET]),
        bearing_offset_rad=float(mean[BEARING_OFFSET]),
        measurements=measurements,
        alternative_enu_m=hypotheses[1].place_enu_m if is_ambiguous else None,
        height_m=float(mean[height]) if height >= 0 else model.height_m,
        height_sigma_m=math.sqrt(P[height, height]) if height >= 0 else None,
        range_scale=float(mean[scale]) if scale >= 0 else 0.0,
    )


def position_covariance_m2(hypothesis: Hypothesis, own_sigma_m: float) -> Matrix:
    """The filter's covariance, not below what the window found, plus the own position's, (2, 2).

    All measurements share the error of the own position.
    """
    covariance = hypothesis.state.covariance[:2, :2]
    least = hypothesis.least_covariance_m2
    if least is not None and least[0, 0] + least[1, 1] > covariance[0, 0] + covariance[1, 1]:
        covariance = least
    total: Matrix = covariance + own_sigma_m * own_sigma_m * np.eye(2)
    return total


def _r95_m(
    hypotheses: Sequence[Hypothesis], weights: Vector, covariances: Sequence[Matrix]
) -> float:
    if len(hypotheses) == 1:
        return r95_of_covariance_m(covariances[0])
    components = [
        (float(weight), h.state.mean[:2], covariance)
        for weight, h, covariance in zip(weights, hypotheses, covariances, strict=True)
    ]
    return r95_of_mixture_m(hypotheses[0].state.mean[:2], components)


def _state(weights: Vector, r95_m: float, localised_r95_m: float) -> EstimateState:
    likely = sum(weight >= AMBIGUOUS_PROBABILITY for weight in weights.tolist())
    if 1 < likely <= MAX_AMBIGUOUS:
        return EstimateState.AMBIGUOUS
    if likely == 1 and r95_m <= localised_r95_m:
        return EstimateState.LOCALISED
    return EstimateState.SEARCHING
