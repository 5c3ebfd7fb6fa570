"""Innovations of a measurement: their gate, the hypotheses they favour, and the noise they show.

Theory of operation of the gate. It decides which innovations a credible estimate can explain. An
innovation is tested in standard deviations of the estimate's own uncertainty and of the measured
noise. Reflections make ranges longer by any amount and are left to the robust loss, but no path is
shorter than the straight one: a range that is too short by more than the gate is an error, and so
are a bearing that is off by more and a signal that is too strong. Those are not fused. A range that
is too long even for a reflection is fused, because the loss bounds its influence, but it does not
count as agreement. Obstruction weakens a signal by any amount.

Theory of operation of the noise. A robust filter adds w / R of information per measurement, as if
its noise were thermal wherever the weight is 1. Under NLOS that is too much: the residuals of an
M-estimator with influence psi carry only E[psi']^2 / E[psi^2] / R (Huber's sandwich), and
consecutive residuals of a recorded walk are correlated, which divides by (1 + rho) / (1 - rho) for
a lag-1 correlation rho of psi. The ratio of the two is the variance inflation

    c = E[w] E[psi^2] / E[psi']^2 (1 + rho) / (1 - rho)

measured on the innovations and applied to R in gain and covariance alike. With well-specified white
noise c = 1. A consistent filter's NIS, y^T S^-1 y, is chi-square distributed with as many degrees
of freedom as y has components; its mean lies in a band about that number.

Sources: P. J. Huber, Robust Statistics (1981), chapter 6, for the sandwich; Y. Bar-Shalom, X. R.
Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4; E.
B. Wilson and M. M. Hilferty, PNAS 17 (1931), for the quantile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from typing import NamedTuple

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import asymmetric_huber_loss
from companion.estimation.filters.target_filter import (
    Inflation,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.hypotheses import AMBIGUOUS_PROBABILITY, Hypothesis
from companion.estimation.measurement_model import AZIMUTH, COSINES, MODALITIES
from companion.estimation.screen import RejectReason
from companion.estimation.window.rivals import Observability
from companion.estimation.window.sandwich import (
    MAX_CORRELATION,
    MIN_MEASUREMENTS,
    MIN_SLOPE,
    SIGNIFICANT_SIGMAS,
)
from companion.kernel import Matrix

GATE_SIGMAS = 6.0
"""Innovation or residual, in sigma, beyond which a short range or a bearing is a gross error:
recorded Wi-Fi and UWB walks and flights in the shadow of buildings stay within it. With 3, one of
16 recorded targets is outside R95, with 12 one R95 is 1.6 times as large."""
LONG_SIGMAS = 25.0
"""Innovation, in sigma, beyond which a range is too long even for a reflection: those occasionally
reach 20 of the inflated standard deviations. With 12 or 50 no recorded walk changes."""


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
        """Return the gate's result for an update; two direction cosines count as one direction.

        Each innovation counts in its own standard deviations; what was not measured agrees.
        """
        ranged, borne, elevated, *powers = [
            0.0
            if row is None
            else row.innovation / (row.noise_sigma * math.sqrt(c + row.prior_share))
            for row, c in zip(report.modalities, inflation, strict=False)
        ]
        off = max(abs(borne), abs(elevated)) if antenna == COSINES else abs(borne)
        is_short, is_off = ranged < -GATE_SIGMAS, off > GATE_SIGMAS
        is_strong = max(powers, default=0.0) > GATE_SIGMAS
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
        """Return the combined result of two hypotheses: what either explains is not an outlier."""
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
    # any that would make the estimate ambiguous takes part in the gate
    least = max(before, default=0.0) + math.log(AMBIGUOUS_PROBABILITY)
    judged = [
        Gate.of(report, gate_inflation, target_filter.params.model.antenna)
        for log_weight, report in zip(before, reports, strict=True)
        if log_weight >= least
    ]
    gate = reduce(Gate.joined, judged) if judged else OPEN
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


NOISE_FORGETTING = 1.0 - 1.0 / 300.0
"""Forgetting factor of the noise monitor: a memory of 300 measurements. A longer one knows the
noise better, and follows it later: with 150 R95 of recorded walks changes by up to 3 %, with 600 or
all of them by less than 1 %.
"""
PRIOR_COUNT = 8.0
"""Weight of the monitor's prior, in measurements: with less the first innovations dominate, more
delays the estimate. With 4, R95 of recorded walks changes by less than 1 %.
"""
MAX_INFLATION = 400.0
"""Upper limit of the inflation of a variance: 20 times the thermal sigma. A stuck value could cause
any; without the limit no recorded walk changes.
"""
NORMAL_975 = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % above it."""
MAX_PRIOR_SHARE = 1.0
"""Largest share of the state's own uncertainty, a ratio of variances, in an innovation from which
noise is learnt: above it the innovation is mostly the state's."""


@dataclass(frozen=True)
class NoiseMonitor:
    """Running moments of one modality's whitened innovations, with forgetting."""

    initial_inflation: float
    """Prior of the second moment."""
    count: float = 0.0
    weight_sum: float = 0.0
    influence_sum: float = 0.0
    influence2_sum: float = 0.0
    slope_sum: float = 0.0
    """Number of measurements on the quadratic part of the loss (psi' = 1)."""
    pair_count: float = 0.0
    lag_sum: float = 0.0
    """Sum of products of consecutive influences; the first of a chain has no predecessor."""
    previous: float | None = None

    def after(self, u: float, k_long: float, k_short: float) -> NoiseMonitor:
        """Return the moments after one more whitened innovation `u`."""
        influence = min(max(u, -k_short), k_long)  # without the cost of calling a kernel
        has_pair = self.previous is not None
        return NoiseMonitor(
            initial_inflation=self.initial_inflation,
            count=NOISE_FORGETTING * self.count + 1.0,
            weight_sum=NOISE_FORGETTING * self.weight_sum + (influence / u if u != 0.0 else 1.0),
            influence_sum=NOISE_FORGETTING * self.influence_sum + influence,
            influence2_sum=NOISE_FORGETTING * self.influence2_sum + influence * influence,
            slope_sum=NOISE_FORGETTING * self.slope_sum + (1.0 if influence == u else 0.0),
            pair_count=NOISE_FORGETTING * self.pair_count + has_pair,
            lag_sum=NOISE_FORGETTING * self.lag_sum + influence * (self.previous or 0.0),
            previous=influence,
        )

    @property
    def bilateral_share(self) -> float:
        """Share of measurements on the quadratic part of the loss, which add curvature."""
        return self.slope_sum / self.count if self.count else 1.0

    @cached_property
    def correlation(self) -> float:
        """Lag-1 correlation of psi; 0 where it is not significant."""
        if self.pair_count < MIN_MEASUREMENTS:
            return 0.0
        mean = self.influence_sum / max(self.count, 1.0)
        variance = self.influence2_sum / self.count - mean**2
        if variance <= 0.0:
            return 0.0
        rho = (self.lag_sum / self.pair_count - mean**2) / variance
        significant = SIGNIFICANT_SIGMAS / math.sqrt(self.pair_count)
        return min(rho, MAX_CORRELATION) if rho > significant else 0.0

    @property
    def inflation(self) -> float:
        """Variance inflation c >= 1."""
        count = self.count + PRIOR_COUNT
        weight = (self.weight_sum + PRIOR_COUNT) / count
        influence2 = (self.influence2_sum + PRIOR_COUNT * self.initial_inflation) / count
        slope = max((self.slope_sum + PRIOR_COUNT) / count, MIN_SLOPE)
        sandwich = weight * influence2 / slope**2
        return min(max(1.0, sandwich) * self.repetition, MAX_INFLATION)

    @cached_property
    def repetition(self) -> float:
        """Factor (1 + rho) / (1 - rho) of correlated innovations."""
        rho = self.correlation
        return (1.0 + rho) / (1.0 - rho)


@lru_cache(maxsize=256)
def mean_band(dof: float, count: float) -> tuple[float, float]:
    """Return the 95 % band of the mean of `count` chi-square values of `dof` degrees of freedom.

    By the cube-root normal approximation: within 5 % for 5 degrees of freedom in all, 1 % for 20. A
    sum of weights may replace the count.
    """
    total = dof * count
    spread = math.sqrt(2.0 / (9.0 * total))
    low, high = (
        total * (1.0 - 2.0 / (9.0 * total) + sign * NORMAL_975 * spread) ** 3
        for sign in (-1.0, 1.0)
    )
    return max(low, 0.0) / count, high / count


@dataclass(frozen=True, slots=True)
class TrackerHealth:
    """Indicators of the trust in an estimate."""

    nis: float | None
    """Mean NIS per degree of freedom; 1 is consistent."""
    is_overconfident: bool
    """True if it is above its 95 % band."""
    correlation: tuple[float, ...]
    """Lag-1 correlation of each modality's innovations; 0: white."""
    inflation: Inflation
    """Variance of each modality over thermal noise."""
    nlos_share: float
    """Share of recent ranges identified as reflections."""
    observability: Observability | None
    """Curvature and bilateral information; None before the first measurement."""


@dataclass(frozen=True)
class InnovationNoise:
    """Noise of a run as measured on its innovations, and the running mean of their NIS.

    S is the innovation variance that the filter works with, robust weight and inflation included:
    with these the mean NIS per degree of freedom is near 1 or slightly below it, because saturated
    innovations are assigned more variance than they have. Above the band the filter is
    over-confident.
    """

    monitors: tuple[NoiseMonitor, ...]
    dof: float = 0.0
    """Degrees of freedom of the NIS in memory."""
    nis_sum: float = 0.0
    found: Inflation | None = None
    """Inflation over thermal noise at the best optimum of the window; None: not solved yet."""

    @classmethod
    def starting(cls, initial_inflation: float, rows: int = MODALITIES) -> InnovationNoise:
        """Return the noise of a model with this number of rows before the first innovation."""
        return cls((NoiseMonitor(initial_inflation),) * rows)

    def after(self, report: UpdateReport, thresholds: Matrix) -> InnovationNoise:
        """Return the noise after one more update; `thresholds` are (m, 2)."""
        monitors = []
        for monitor, row, (k_long, k_short) in zip(
            self.monitors, report.modalities, thresholds.tolist(), strict=False
        ):
            if row is None:
                monitors.append(monitor)
            elif row.prior_share > MAX_PRIOR_SHARE:
                monitors.append(replace(monitor, previous=None))  # the chain is broken
            else:
                monitors.append(monitor.after(row.whitened_innovation, k_long, k_short))
        dof = sum([row is not None for row in report.modalities])
        kept = 1.0 - 1.0 / 200.0  # a memory of 200 measurements: the band of their mean is +-20 %
        return InnovationNoise(
            (*monitors, *self.monitors[len(monitors) :]),  # a report without power has fewer rows
            kept * self.dof + dof,
            kept * self.nis_sum + report.nis,
            self.found,
        )

    @property
    def nis(self) -> float | None:
        """Mean NIS per degree of freedom; 1 is consistent, None before the first update."""
        return self.nis_sum / self.dof if self.dof > 0.0 else None

    @property
    def is_overconfident(self) -> bool:
        """True if that mean is above the band of white, consistent innovations."""
        return self.dof >= 1.0 and self.nis_sum / self.dof > mean_band(1.0, self.dof)[1]

    @cached_property
    def is_white(self) -> bool:
        """True if no correlation of innovations is significant."""
        return all([monitor.correlation == 0.0 for monitor in self.monitors])

    @property
    def nlos_share(self) -> float:
        """Share of recent ranges on the linear branch of the loss, identified as reflections."""
        return 1.0 - self.monitors[0].bilateral_share

    @cached_property
    def inflation(self) -> Inflation:
        """Variance inflation of each modality."""
        if self.found is None:
            return tuple([monitor.inflation for monitor in self.monitors])
        return tuple(
            [
                min(noise * monitor.repetition, MAX_INFLATION)
                for noise, monitor in zip(self.found, self.monitors, strict=True)
            ]
        )

    def health(self, inflation: Inflation, observability: Observability | None) -> TrackerHealth:
        """Return the live values."""
        return TrackerHealth(
            nis=self.nis,
            is_overconfident=self.is_overconfident,
            correlation=tuple(monitor.correlation for monitor in self.monitors),
            inflation=inflation,
            nlos_share=self.nlos_share,
            observability=observability,
        )
