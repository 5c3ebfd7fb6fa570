"""Is the estimate as wrong as it says? R95, variance inflation, NIS, NEES and divergence.

Theory of operation. A robust filter adds w / R of information per measurement, as if its noise
were the thermal one wherever the weight is 1. Under NLOS that is too much: the residuals of an
M-estimator with influence psi carry only

    E[psi']^2 / E[psi^2] / R        (Huber's sandwich)

and consecutive residuals of a recorded walk repeat each other, which divides by
(1 + rho) / (1 - rho) for a lag-1 correlation rho of psi. The ratio of the two is the variance
inflation c = E[w] E[psi^2] / E[psi']^2 (1 + rho) / (1 - rho), measured on the innovations of the
run itself and applied to R in gain and covariance alike. With well-specified white noise c = 1.

The radius R95 about the estimate holds 95 % of the probability of all hypotheses.

Source: P. J. Huber, Robust Statistics (1981), chapter 6, for the sandwich.

NIS and NEES. A consistent filter's y^T S^-1 y (NIS, needs no truth) and e^T P^-1 e (NEES, needs it)
are chi-square distributed with as many degrees of freedom as they have components. Their mean over
a window or over runs lies in a band about that number.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation (2001), section 5.4; E. B. Wilson and M. M. Hilferty, PNAS 17 (1931), for the quantile.

Divergence. The contradiction needs forty measurements that all say the same. An estimate may fail
more gently, for instance because the target moves: innovations are merely larger than they should
be, until the measured inflation has grown to hide them. So the NIS of the last seconds is held
against its band. The median is taken, because outliers are the gate's task, and a range that is
taken for a reflection says nothing of the estimate.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.filters.robust_update import asymmetric_huber_influence
from companion.estimation.filters.target_filter import Inflation, ModalityReport, UpdateReport
from companion.kernel import Matrix, Vector

R95_OF_EQUAL_AXES = 2.447746830680816
"""sqrt of the chi-square 0.95 quantile with 2 degrees of freedom."""

NOISE_FORGETTING = 1.0 - 1.0 / 300.0
"""Memory of the noise monitor, in measurements."""

PRIOR_COUNT = 8.0
"""How many measurements the monitor's prior is worth."""
MIN_PAIRS = 12.0
"""Fewer pairs of neighbours than this tell nothing of correlation."""
SIGNIFICANT_SIGMAS = 2.0
"""A correlation counts from this many standard errors: white noise reaches it once in 44."""

MAX_INFLATION = 400.0
MAX_CORRELATION = 0.98

GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
"""Turn between neighbours on a spiral that covers a disc evenly."""

MIN_AXIS_RATIO = 4e-3
"""Ellipses thinner than this (in variance) are taken as this thin; R95 differs by under 0.1 %."""
LOG_OUTSIDE = math.log(0.05)
R95_START = 0.5 * 1.9**2
"""R^2 / 2 that the search for R95 begins from, less than that of the narrowest ellipse."""
R95_TOLERANCE = 1e-12
R95_MAX_STEPS = 20

_PHI_RAD = (np.arange(64) + 0.5) * (math.pi / 128.0)
_COS2, _SIN2 = np.cos(_PHI_RAD) ** 2, np.sin(_PHI_RAD) ** 2


@dataclass(frozen=True, slots=True)
class NoiseMonitor:
    """Running moments of one modality's whitened innovations, with forgetting."""

    initial_inflation: float
    """What is believed until the data say otherwise."""
    count: float = 0.0
    weight_sum: float = 0.0
    influence_sum: float = 0.0
    influence2_sum: float = 0.0
    slope_sum: float = 0.0
    """Count of measurements on the quadratic part (psi' = 1)."""
    pair_count: float = 0.0
    lag_sum: float = 0.0
    """Sum of products of consecutive influences; the first of a chain has none before it."""
    previous: float | None = None

    def after(self, u: float, k_long: float, k_short: float) -> NoiseMonitor:
        """The moments after one more whitened innovation `u`."""
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
    def mean_influence(self) -> float:
        """Mean of psi; near zero while the estimate agrees with its measurements."""
        return self.influence_sum / max(self.count, 1.0)

    @property
    def bilateral_share(self) -> float:
        """Share of measurements on the quadratic part: those that add curvature."""
        return self.slope_sum / self.count if self.count else 1.0

    @property
    def correlation(self) -> float:
        """Lag-1 correlation of psi, 0 where it cannot be told from white noise."""
        if self.pair_count < MIN_PAIRS:
            return 0.0
        variance = self.influence2_sum / self.count - self.mean_influence**2
        if variance <= 0.0:
            return 0.0
        rho = (self.lag_sum / self.pair_count - self.mean_influence**2) / variance
        significant = SIGNIFICANT_SIGMAS / math.sqrt(self.pair_count)
        return min(rho, MAX_CORRELATION) if rho > significant else 0.0

    @property
    def inflation(self) -> float:
        """The variance inflation c >= 1."""
        count = self.count + PRIOR_COUNT
        weight = (self.weight_sum + PRIOR_COUNT) / count
        influence2 = (self.influence2_sum + PRIOR_COUNT * self.initial_inflation) / count
        slope = max((self.slope_sum + PRIOR_COUNT) / count, 0.05)
        sandwich = weight * influence2 / slope**2
        return min(max(1.0, sandwich) * self.repetition, MAX_INFLATION)

    @property
    def repetition(self) -> float:
        """The factor (1 + rho) / (1 - rho) for innovations that repeat each other."""
        rho = self.correlation
        return (1.0 + rho) / (1.0 - rho)

    def reset_correlation(self) -> NoiseMonitor:
        """The same moments with the chain of consecutive innovations broken."""
        return replace(self, previous=None)


def r95_of_covariance_m(covariance_m2: Matrix) -> float:
    """Radius of the circle about the mean that holds 95 % of a 2-D Gaussian, metres.

    Args:
        covariance_m2: (2, 2).

    The probability outside radius R is the mean over directions of exp(-R^2 q / 2) / (q sqrt(det))
    with q the inverse variance in that direction. Its logarithm is convex in R^2 / 2, so Newton's
    method from below climbs to the root without a step too far.
    """
    low, high = (float(v) for v in np.linalg.eigvalsh(covariance_m2))
    if high <= 0.0:
        return 0.0
    ratio = max(low / high, MIN_AXIS_RATIO)
    q = _COS2 + _SIN2 / ratio
    share = 1.0 / q
    share /= share.sum()
    half_square = R95_START
    for _ in range(R95_MAX_STEPS):
        outside = share * np.exp(-half_square * q)
        total = float(outside.sum())
        step = (math.log(total) - LOG_OUTSIDE) * total / float(outside @ q)
        half_square += step
        if step < R95_TOLERANCE:
            break
    return math.sqrt(2.0 * half_square * high)


def r95_of_mixture_m(
    centre_m: Vector, components: Sequence[tuple[float, Vector, Matrix]], rings: int = 24
) -> float:
    """Radius about `centre_m` that holds 95 % of a mixture of 2-D Gaussians, metres.

    Args:
        centre_m: (2,).
        components: (probability, mean (2,), covariance (2, 2)), probabilities summing to 1.
        rings: Resolution; each component is `2 * rings**2` points of equal probability, laid out
            along a spiral so that no two share a radius.
    """
    order = np.arange(2 * rings**2)
    radii = np.sqrt(-2.0 * np.log1p(-(order + 0.5) / order.size))
    normal = radii * np.stack([np.cos(GOLDEN_ANGLE_RAD * order), np.sin(GOLDEN_ANGLE_RAD * order)])
    distances, weights = [], []
    for probability, mean, covariance in components:
        values, vectors = np.linalg.eigh(covariance)
        points = mean[:, None] + vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * normal)
        distances.append(np.hypot(*(points - centre_m[:, None])))
        weights.append(np.full(normal.shape[1], probability / normal.shape[1]))
    distance, weight = np.concatenate(distances), np.concatenate(weights)
    nearest_first = np.argsort(distance)
    reached = np.searchsorted(np.cumsum(weight[nearest_first]), 0.95)
    return float(distance[nearest_first][min(int(reached), distance.size - 1)])


NORMAL_975 = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % above it."""
NIS_FORGETTING = 1.0 - 1.0 / 200.0
"""Memory of the NIS monitor, in measurements."""


def nees(error: Vector, covariance: Matrix) -> float:
    """e^T P^-1 e. Args: error (n,), covariance (n, n)."""
    return float(error @ np.linalg.solve(covariance, error))


def mean_band(dof: float, count: float) -> tuple[float, float]:
    """Where the mean of `count` chi-square values lies with 95 % probability.

    By the cube-root normal approximation: within 5 % for 5 degrees of freedom in all, 1 % for 20.

    Args:
        dof: Degrees of freedom of each.
        count: How many; may be a sum of weights.
    """
    total = dof * count
    spread = math.sqrt(2.0 / (9.0 * total))
    low, high = (
        total * (1.0 - 2.0 / (9.0 * total) + sign * NORMAL_975 * spread) ** 3
        for sign in (-1.0, 1.0)
    )
    return max(low, 0.0) / count, high / count


@dataclass(frozen=True, slots=True)
class NisMonitor:
    """Running mean of the NIS per degree of freedom, with forgetting; 1 is consistent.

    S is the innovation variance that the filter works with, robust weight and inflation included:
    with these the mean is near 1 or a little below it, because saturated innovations are given more
    variance than they show. Above the band the filter is over-confident.
    """

    count: float = 0.0
    """Degrees of freedom in memory."""
    total: float = 0.0

    def after(self, report: UpdateReport) -> NisMonitor:
        """With one more update."""
        dof = sum(row is not None for row in report.modalities)
        return NisMonitor(
            NIS_FORGETTING * self.count + dof, NIS_FORGETTING * self.total + report.nis
        )

    @property
    def mean(self) -> float | None:
        """Mean NIS per degree of freedom; None before the first update."""
        return self.total / self.count if self.count > 0.0 else None

    @property
    def is_overconfident(self) -> bool:
        """Whether the mean is above the band of white, consistent innovations."""
        return self.count >= 1.0 and self.total / self.count > mean_band(1.0, self.count)[1]


WINDOW_S = 3.0
WINDOW_COUNT = 30
"""The window holds at least so much time and so many measurements."""
OUT_OF_BAND_S = 3.0
OUT_OF_BAND_COUNT = 10
"""The NIS must be above its band for at least so long and so many measurements in a row."""
NEWEST_COUNT = 5
"""So many of the newest say whether it still is."""
RESTART_MEMORY_S = 60.0
MAX_RESTARTS = 2
"""An estimate that was started anew this often within that time is not flown on."""


class NisWindow:
    """The normalised innovations squared of the last seconds, per degree of freedom."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float, int]] = deque()
        self._dof = 0
        """Degrees of freedom of all of them."""
        self._above_since_s: float | None = None
        self._above_count = 0

    def clear(self) -> None:
        """Forget everything, because the estimate is another one."""
        self._values.clear()
        self._dof = 0
        self._above_since_s = None
        self._above_count = 0

    def add(self, report: UpdateReport, inflation: Inflation, time_s: float) -> bool:
        """Take in an update; whether the NIS has been above its band for too long.

        Args:
            inflation: Variance inflation of range, bearing and elevation that the run has shown,
                whether or not the filter was told.
        """
        shares = [_normalised2(row, c) for row, c in _telling(report, inflation)]
        if not shares:
            return False
        self._values.append((time_s, statistics.fmean(shares), len(shares)))
        self._dof += len(shares)
        while len(self._values) > WINDOW_COUNT and self._values[0][0] < time_s - WINDOW_S:
            self._dof -= self._values.popleft()[2]
        band = self._band()
        if self._median(len(self._values)) <= band:
            self._above_since_s = None
            self._above_count = 0
            return False
        if self._above_since_s is None:
            self._above_since_s = time_s
        self._above_count += 1
        has_lasted = time_s - self._above_since_s >= OUT_OF_BAND_S
        is_over = self._median(NEWEST_COUNT) <= band  # the window is slow to see that
        return has_lasted and self._above_count >= OUT_OF_BAND_COUNT and not is_over

    def _median(self, newest: int) -> float:
        values = [value for _, value, _ in self._values]
        return statistics.median(values[-newest:])

    def _band(self) -> float:
        """What the mean of consistent values stays below; infinite while there are too few."""
        count = len(self._values)
        if count < WINDOW_COUNT:
            return math.inf
        dof = self._dof / count
        return mean_band(dof, count)[1] / dof


def _telling(report: UpdateReport, inflation: Inflation) -> list[tuple[ModalityReport, float]]:
    """What was measured, each with its inflation, without a range taken for a reflection."""
    rows = [
        (row, c) for row, c in zip(report.modalities, inflation, strict=True) if row is not None
    ]
    if report.range is not None and report.range.weight < 1.0 and report.range.innovation > 0.0:
        rows.pop(0)
    return rows


def _normalised2(row: ModalityReport, inflation: float) -> float:
    """The innovation squared over its variance under that inflation."""
    return row.whitened_innovation**2 / (inflation / row.weight + row.prior_share)


class RestartCounter:
    """How often the estimate was started anew lately."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=MAX_RESTARTS)

    def add(self, time_s: float) -> None:
        """Count a restart."""
        self._times_s.append(time_s)

    def is_too_many(self, now_s: float) -> bool:
        """Whether there were `MAX_RESTARTS` within `RESTART_MEMORY_S`."""
        return len(self._times_s) == MAX_RESTARTS and now_s - self._times_s[0] <= RESTART_MEMORY_S
