"""How wrong the estimate may be: R95, and the inflation that keeps it honest.

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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.losses import asymmetric_huber_influence
from companion.geometry.arrays import Matrix, Vector

R95_OF_EQUAL_AXES = 2.447746830680816
"""sqrt of the chi-square 0.95 quantile with 2 degrees of freedom."""

FORGETTING = 1.0 - 1.0 / 300.0
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
            count=FORGETTING * self.count + 1.0,
            weight_sum=FORGETTING * self.weight_sum + (influence / u if u != 0.0 else 1.0),
            influence_sum=FORGETTING * self.influence_sum + influence,
            influence2_sum=FORGETTING * self.influence2_sum + influence * influence,
            slope_sum=FORGETTING * self.slope_sum + (1.0 if influence == u else 0.0),
            pair_count=FORGETTING * self.pair_count + has_pair,
            lag_sum=FORGETTING * self.lag_sum + influence * (self.previous or 0.0),
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
