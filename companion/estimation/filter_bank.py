"""Update of every hypothesis with one measurement, and the outlier gate.

The gate decides which innovations a credible estimate can explain. An innovation is tested in
standard deviations of the estimate's own uncertainty and of the measured noise. Reflections make
ranges longer by any amount and are left to the robust loss, but no path is shorter than the
straight one: a range that is too short by more than the gate is an error, and so are a bearing that
is off by more and a signal that is too strong. Those are not fused. A range that is too long even
for a reflection is fused, because the loss bounds its influence, but it does not count as
agreement. Obstruction weakens a signal by any amount.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import asymmetric_huber_loss
from companion.estimation.filters.target_filter import (
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.measurement_model import AZIMUTH, COSINES, POWER
from companion.estimation.screen import RejectReason

LIKELY_LOG_RATIO = math.log(0.05)
"""Log of the probability, relative to the best, from which a hypothesis takes part in the gate."""
GATE_SIGMAS = 6.0
"""Recorded Wi-Fi and UWB walks and flights in the shadow of buildings stay within it."""
LONG_SIGMAS = 25.0
"""Reflections occasionally reach 20 of the inflated standard deviations."""


class Gate(NamedTuple):
    """Result of the outlier gate for one measurement."""

    passes_range: bool = True
    """False: too short to be fused."""
    passes_bearing: bool = True
    """False: off by too much to be fused."""
    passes_power: bool = True
    """False: too strong to be fused."""
    agrees_in_range: bool = True
    """True if the range, if any, agrees with the estimate: neither too short nor absurdly long."""
    agrees_in_bearing: bool = True
    agrees_in_power: bool = True

    @property
    def agrees(self) -> bool:
        """True if every measured component agrees with the estimate."""
        return self.agrees_in_range and self.agrees_in_bearing and self.agrees_in_power

    @classmethod
    def of(cls, report: UpdateReport, inflation: Inflation, antenna: int = AZIMUTH) -> Gate:
        """Return the gate's result for an update; two direction cosines count as one direction."""
        ranged = _in_sigmas(report.range, inflation[0])
        borne = abs(_in_sigmas(report.bearing, inflation[1]))
        if antenna == COSINES:
            borne = max(borne, abs(_in_sigmas(report.elevation, inflation[2])))
        is_short, is_off = ranged < -GATE_SIGMAS, borne > GATE_SIGMAS
        is_strong = report.power is not None and (
            _in_sigmas(report.power, inflation[POWER]) > GATE_SIGMAS
        )
        return cls(
            passes_range=not is_short,
            passes_bearing=not is_off,
            passes_power=not is_strong,
            agrees_in_range=not is_short and ranged <= LONG_SIGMAS,
            agrees_in_bearing=not is_off,
            agrees_in_power=not is_strong,
        )

    def unarmed(self) -> Gate:
        """Return the same result with nothing rejected, for an estimate that is not yet proven."""
        return self._replace(passes_range=True, passes_bearing=True, passes_power=True)

    def joined(self, other: Gate) -> Gate:
        """Return the combined result of two hypotheses: what either explains is no outlier."""
        return Gate(*(mine or its for mine, its in zip(self, other, strict=True)))

    @property
    def reject_reason(self) -> RejectReason:
        """Reason under which a measurement that does not pass is counted."""
        if not self.passes_range:
            return RejectReason.RANGE_OUTLIER
        return RejectReason.POWER_OUTLIER if self.passes_bearing else RejectReason.BEARING_OUTLIER

    def passed(self, measurement: RangingMeasurement) -> RangingMeasurement | None:
        """Return the components of a measurement that may be fused; None: none."""
        if self.passes_range and self.passes_bearing and self.passes_power:
            return measurement
        if not self.passes_range:
            measurement = replace(measurement, range_m=None)
        if not self.passes_bearing:
            measurement = measurement.without_direction()
        if not self.passes_power:
            measurement = replace(measurement, power_dbm=None)
        return measurement if measurement.has_any else None


OPEN = Gate()
"""Gate that passes everything."""


def _in_sigmas(report: ModalityReport | None, inflation: float) -> float:
    """Return the innovation in its own standard deviations; 0 where nothing was measured."""
    if report is None:
        return 0.0
    return report.innovation / (report.noise_sigma * math.sqrt(inflation + report.prior_share))


@dataclass(frozen=True, slots=True)
class BankUpdate:
    """Hypotheses after a measurement, without those whose covariance became indefinite."""

    hypotheses: tuple[Hypothesis, ...]
    """Survivors, in their order before the update."""
    reports: tuple[UpdateReport, ...]
    """One for each survivor, the best one's first."""
    gate: Gate
    """Joint gate of the hypotheses that were likely before the update."""


def update_hypotheses(
    hypotheses: Sequence[Hypothesis],
    target_filter: TargetFilter,
    measurement: RangingMeasurement,
    sensor_enu_m: PositionEnu,
    filter_inflation: Inflation,
    gate_inflation: Inflation,
) -> BankUpdate:
    """Return all hypotheses after a measurement.

    The filters use the first inflation, the gate the second one, which is as measured.
    """
    before, survivors, reports = [], [], []
    thresholds = target_filter.params.thresholds.tolist()
    for hypothesis in hypotheses:
        state = target_filter.predict(hypothesis.state, measurement.measured_at_s)
        report = target_filter.update(state, measurement, sensor_enu_m, filter_inflation)
        if not report.is_positive_definite:
            continue
        log_weight = hypothesis.log_weight
        before.append(log_weight)
        if len(hypotheses) > 1:  # a single hypothesis needs no weight
            log_weight += log_likelihood(report, thresholds, filter_inflation)
        least_m2, prior = hypothesis.least_covariance_m2, hypothesis.log_prior
        survivors.append(Hypothesis(log_weight, report.state, least_m2, prior))
        reports.append(report)
    least = max(before, default=0.0) + LIKELY_LOG_RATIO
    judged = [
        Gate.of(report, gate_inflation, target_filter.params.model.antenna)
        for log_weight, report in zip(before, reports, strict=True)
        if log_weight >= least
    ]
    gate = functools.reduce(Gate.joined, judged) if judged else OPEN
    return BankUpdate(tuple(survivors), tuple(reports), gate)


def log_likelihood(
    report: UpdateReport, thresholds: Sequence[Sequence[float]], inflation: Sequence[float]
) -> float:
    """Return the robust log-likelihood of an update's innovations, tempered by the inflation."""
    total = 0.0
    for row, (k_long, k_short), c in zip(report.modalities, thresholds, inflation, strict=False):
        if row is None:
            continue
        spread2 = row.noise_sigma**2 * (1.0 + row.prior_share)
        u = row.innovation / math.sqrt(spread2)
        loss = asymmetric_huber_loss(u, k_long, k_short)
        total -= (loss + 0.5 * math.log(spread2)) / c
    return total
