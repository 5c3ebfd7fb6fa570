"""One measurement through every hypothesis: states, likelihoods, and what the gate says of it."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.base import Inflation, UpdateReport
from companion.estimation.gate import OPEN, Gate
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.losses import asymmetric_huber_loss
from companion.estimation.recursive_filter import RecursiveFilter

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


def updated(
    hypotheses: Iterable[Hypothesis],
    target_filter: RecursiveFilter,
    measurement: RangingMeasurement,
    sensor_enu_m: PositionEnu,
    inflation: Inflation,
    shown: Inflation,
) -> BankUpdate:
    """All hypotheses after a measurement.

    Args:
        hypotheses: Before it.
        target_filter: What each is run by.
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
        report: Of the update.
        thresholds: Long and short one of range, bearing and elevation.
        inflation: Of their variances.
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
