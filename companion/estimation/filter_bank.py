"""One measurement through every hypothesis, and the estimate that they come to.

An update gives states, likelihoods and what the gate says of the measurement; the estimate is the
place that is told, its R95, and whether that is enough.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.domain import EstimateState, PositionEnu, RangingMeasurement, TargetEstimate
from companion.estimation.filters.kalman import RecursiveFilter
from companion.estimation.filters.robust_update import asymmetric_huber_loss
from companion.estimation.filters.target_filter import Inflation, UpdateReport
from companion.estimation.hypotheses import Hypothesis, probabilities
from companion.estimation.integrity.consistency import r95_of_covariance_m, r95_of_mixture_m
from companion.estimation.measurement_model import BEARING_OFFSET, RANGE_OFFSET, RangingModel
from companion.estimation.screening.validation import OPEN, Gate
from companion.kernel import Matrix, Vector

LIKELY_LOG_RATIO = math.log(0.05)
"""A hypothesis at least this probable beside the best one has a say at the gate."""


@dataclass(frozen=True, slots=True)
class BankUpdate:
    """Hypotheses after a measurement; those that lost their covariance are gone."""

    hypotheses: tuple[Hypothesis, ...]
    """In the order of those before."""
    reports: tuple[UpdateReport, ...]

    gate: Gate
    """What the hypotheses that were likely before it can explain."""

    @property
    def best(self) -> UpdateReport | None:
        """The update of the first hypothesis that survived; None: none did."""
        return self.reports[0] if self.reports else None


def update_hypotheses(
    hypotheses: Iterable[Hypothesis],
    target_filter: RecursiveFilter,
    measurement: RangingMeasurement,
    sensor_enu_m: PositionEnu,
    inflation: Inflation,
    shown: Inflation,
) -> BankUpdate:
    """All hypotheses after a measurement.

    Args:
        measurement: With its bearing, if any, in ENU.
        sensor_enu_m: Where the antenna was at its time.
        inflation: Variance inflation of range, bearing and elevation that the filter is told.
        shown: That the run has shown, which the gate goes by.
    """
    before, survivors, reports = [], [], []
    thresholds = target_filter.params.thresholds.tolist()
    for hypothesis in hypotheses:
        state = target_filter.predict(hypothesis.state, measurement.measured_at_s)
        report = target_filter.update(state, measurement, sensor_enu_m, inflation)
        if not report.is_positive_definite:
            continue
        log_weight = hypothesis.log_weight + log_likelihood(report, thresholds, inflation)
        before.append(hypothesis.log_weight)
        survivors.append(replace(hypothesis, log_weight=log_weight, state=report.state))
        reports.append(report)
    return BankUpdate(tuple(survivors), tuple(reports), _gate(before, reports, shown))


def _gate(
    log_weights: Sequence[float], reports: Sequence[UpdateReport], inflation: Inflation
) -> Gate:
    """What the likely ones can explain; open where there is none."""
    least = max(log_weights, default=0.0) + LIKELY_LOG_RATIO
    judged = [
        Gate.of(report, inflation)
        for log_weight, report in zip(log_weights, reports, strict=True)
        if log_weight >= least
    ]
    return functools.reduce(Gate.joined, judged) if judged else OPEN


def log_likelihood(
    report: UpdateReport, thresholds: Sequence[Sequence[float]], inflation: Sequence[float]
) -> float:
    """Robust log-likelihood of all innovations of an update, tempered by the inflation.

    Args:
        thresholds: Long and short one of range, bearing and elevation.
    """
    total = 0.0
    for row, (k_long, k_short), c in zip(report.modalities, thresholds, inflation, strict=True):
        if row is None:
            continue
        spread2 = row.noise_sigma**2 * (1.0 + row.prior_share)
        u = row.innovation / math.sqrt(spread2)
        loss = asymmetric_huber_loss(u, k_long, k_short)
        total -= (loss + 0.5 * math.log(spread2)) / c
    return total


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
        localised_r95_m: The state is `localised` while R95 is at most this.
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
