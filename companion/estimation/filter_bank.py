"""One measurement through every hypothesis, and the gate that they hold it against.

The gate tells which innovations a believable estimate can explain. An innovation is judged in
standard deviations of the estimate's own uncertainty and of the noise that the run has shown.
Reflections make ranges longer by any amount and are the robust loss's task, but no path is shorter
than the straight one: a range that is too short by more than the gate is wrong, and so is a bearing
that is off by more. Those are not fused. A range that is longer than reflections make it is fused,
because the loss holds it at bay, but agrees with nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.robust_update import asymmetric_huber_loss
from companion.estimation.filters.target_filter import (
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.measurement_model import AZIMUTH, COSINES
from companion.estimation.screening.measurement_screen import RejectReason

LIKELY_LOG_RATIO = math.log(0.05)
"""A hypothesis at least this probable beside the best one has a say at the gate."""
GATE_SIGMAS = 6.0
"""Recorded Wi-Fi and UWB walks and flights in the shadow of buildings stay within it."""
LONG_SIGMAS = 25.0
"""Reflections reach 20 of the inflated standard deviations now and then."""


class Gate(NamedTuple):
    """What became of one measurement at the gate."""

    passes_range: bool = True
    """False: too short to be fused."""
    passes_bearing: bool = True
    """False: off by too much to be fused."""
    agrees_in_range: bool = True
    """Whether the range, if there is one, agrees with the estimate: neither too short nor absurdly
    long."""
    agrees_in_bearing: bool = True

    @property
    def agrees(self) -> bool:
        """Whether all that was measured agrees with the estimate."""
        return self.agrees_in_range and self.agrees_in_bearing

    @classmethod
    def of(cls, report: UpdateReport, inflation: Inflation, antenna: int = AZIMUTH) -> Gate:
        """The gate's judgement of an update; two direction cosines are one direction."""
        ranged = _in_sigmas(report.range, inflation[0])
        borne = abs(_in_sigmas(report.bearing, inflation[1]))
        if antenna == COSINES:
            borne = max(borne, abs(_in_sigmas(report.elevation, inflation[2])))
        is_short, is_off = ranged < -GATE_SIGMAS, borne > GATE_SIGMAS
        return cls(
            passes_range=not is_short,
            passes_bearing=not is_off,
            agrees_in_range=not is_short and ranged <= LONG_SIGMAS,
            agrees_in_bearing=not is_off,
        )

    def unarmed(self) -> Gate:
        """The same judgement with nothing kept out, while the estimate has yet to prove itself."""
        return self._replace(passes_range=True, passes_bearing=True)

    def joined(self, other: Gate) -> Gate:
        """The judgement of two hypotheses: what either can explain is no outlier."""
        return Gate(*(mine or its for mine, its in zip(self, other, strict=True)))

    @property
    def reject_reason(self) -> RejectReason:
        """What a measurement that does not pass is counted as."""
        return RejectReason.BEARING_OUTLIER if self.passes_range else RejectReason.RANGE_OUTLIER

    def passed(self, measurement: RangingMeasurement) -> RangingMeasurement | None:
        """What of a measurement is fused; None: nothing."""
        if self.passes_range and self.passes_bearing:
            return measurement
        if not self.passes_range:
            measurement = replace(measurement, range_m=None)
        if not self.passes_bearing:
            measurement = measurement.without_direction()
        has_any = measurement.range_m is not None or measurement.has_direction
        return measurement if has_any else None


OPEN = Gate()


def _in_sigmas(report: ModalityReport | None, inflation: float) -> float:
    """The innovation in its own standard deviations; 0 where nothing was measured."""
    if report is None:
        return 0.0
    return report.innovation / (report.noise_sigma * math.sqrt(inflation + report.prior_share))


@dataclass(frozen=True, slots=True)
class BankUpdate:
    """Hypotheses after a measurement; those that lost their covariance are gone."""

    hypotheses: tuple[Hypothesis, ...]
    """In the order of those before."""
    reports: tuple[UpdateReport, ...]
    """Of each that survived, the best one's first."""
    gate: Gate
    """What the hypotheses that were likely before it can explain."""


def update_hypotheses(
    hypotheses: Sequence[Hypothesis],
    target_filter: TargetFilter,
    measurement: RangingMeasurement,
    sensor_enu_m: PositionEnu,
    told: Inflation,
    shown: Inflation,
) -> BankUpdate:
    """All hypotheses after a measurement by the inflation `told`; the gate goes by that `shown`."""
    before, survivors, reports = [], [], []
    thresholds = target_filter.params.thresholds.tolist()
    for hypothesis in hypotheses:
        state = target_filter.predict(hypothesis.state, measurement.measured_at_s)
        report = target_filter.update(state, measurement, sensor_enu_m, told)
        if not report.is_positive_definite:
            continue
        log_weight = hypothesis.log_weight
        before.append(log_weight)
        if len(hypotheses) > 1:  # one alone has no rival to be weighed against
            log_weight += log_likelihood(report, thresholds, told)
        survivors.append(replace(hypothesis, log_weight=log_weight, state=report.state))
        reports.append(report)
    least = max(before, default=0.0) + LIKELY_LOG_RATIO
    judged = [
        Gate.of(report, shown, target_filter.params.model.antenna)
        for log_weight, report in zip(before, reports, strict=True)
        if log_weight >= least
    ]
    gate = functools.reduce(Gate.joined, judged) if judged else OPEN
    return BankUpdate(tuple(survivors), tuple(reports), gate)


def log_likelihood(
    report: UpdateReport, thresholds: Sequence[Sequence[float]], inflation: Sequence[float]
) -> float:
    """Robust log-likelihood of all innovations of an update, tempered by the inflation."""
    total = 0.0
    for row, (k_long, k_short), c in zip(report.modalities, thresholds, inflation, strict=True):
        if row is None:
            continue
        spread2 = row.noise_sigma**2 * (1.0 + row.prior_share)
        u = row.innovation / math.sqrt(spread2)
        loss = asymmetric_huber_loss(u, k_long, k_short)
        total -= (loss + 0.5 * math.log(spread2)) / c
    return total
