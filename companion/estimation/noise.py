"""Noise monitor: whiteness of innovations, and their variance over thermal noise.

Theory of operation. A robust filter adds w / R of information per measurement, as if its noise were
thermal wherever the weight is 1. Under NLOS that is too much: the residuals of an M-estimator with
influence psi carry only E[psi']^2 / E[psi^2] / R (Huber's sandwich), and consecutive residuals of a
recorded walk are correlated, which divides by (1 + rho) / (1 - rho) for a lag-1 correlation rho of
psi. The ratio of the two is the variance inflation

    c = E[w] E[psi^2] / E[psi']^2 (1 + rho) / (1 - rho)

measured on the innovations and applied to R in gain and covariance alike. With well-specified white
noise c = 1. A consistent filter's NIS, y^T S^-1 y, is chi-square distributed with as many degrees
of freedom as y has components; its mean lies in a band about that number.

Sources: P. J. Huber, Robust Statistics (1981), chapter 6, for the sandwich; Y. Bar-Shalom, X. R.
Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4;
E. B. Wilson and M. M. Hilferty, PNAS 17 (1931), for the quantile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from companion.estimation.filters.kalman import asymmetric_huber_influence
from companion.estimation.filters.target_filter import (
    Inflation,
    UpdateReport,
)
from companion.estimation.measurement_model import MODALITIES
from companion.estimation.window.sandwich import (
    MAX_CORRELATION,
    SIGNIFICANT_SIGMAS,
    Observability,
)
from companion.kernel import Matrix

NOISE_FORGETTING = 1.0 - 1.0 / 300.0
"""Forgetting factor of the noise monitor: a memory of 300 measurements."""
PRIOR_COUNT = 8.0
"""Weight of the monitor's prior, in measurements."""
MIN_PAIRS = 12.0
"""Fewest pairs of neighbours for an estimate of correlation."""
MAX_INFLATION = 400.0
"""Upper limit of the inflation: 20 times the thermal sigma."""
NORMAL_975 = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % above it."""
NIS_FORGETTING = 1.0 - 1.0 / 200.0
"""Forgetting factor of the mean NIS: a memory of 200 measurements."""
MAX_PRIOR_SHARE = 1.0
"""Largest share of the state's own uncertainty in an innovation from which noise is learnt."""


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
        influence = float(asymmetric_huber_influence(u, k_long, k_short))
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
        if self.pair_count < MIN_PAIRS:
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
        slope = max((self.slope_sum + PRIOR_COUNT) / count, 0.05)
        sandwich = weight * influence2 / slope**2
        return min(max(1.0, sandwich) * self.repetition, MAX_INFLATION)

    @cached_property
    def repetition(self) -> float:
        """Factor (1 + rho) / (1 - rho) of correlated innovations."""
        rho = self.correlation
        return (1.0 + rho) / (1.0 - rho)


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
    """Indicators of how far an estimate can be trusted."""

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

    @classmethod
    def starting(cls, initial_inflation: float, rows: int = MODALITIES) -> InnovationNoise:
        """Return the noise of a model with so many rows before the first innovation."""
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
        return InnovationNoise(
            (*monitors, *self.monitors[len(monitors) :]),  # a report without power has fewer rows
            NIS_FORGETTING * self.dof + dof,
            NIS_FORGETTING * self.nis_sum + report.nis,
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

    def inflation(self, found: Inflation | None) -> Inflation:
        """Return the variance inflation of each modality; `found` is the window's, if solved."""
        if found is None:
            return tuple([monitor.inflation for monitor in self.monitors])
        return tuple(
            [
                min(noise * monitor.repetition, MAX_INFLATION)
                for noise, monitor in zip(found, self.monitors, strict=True)
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
