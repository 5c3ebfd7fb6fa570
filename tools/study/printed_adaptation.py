"""Fixed point of the paper's EM for lambda as printed, and its distance from the truth.

Theory of operation. The paper estimates each bias by its most probable value and takes the mean,

    b* = max(0, r - sigma^2 / m)        m <- mean b*        with m = 1/lambda

That is not EM: the mode stands in for the mean of the posterior, and the update maximises neither
likelihood nor posterior. For r of the mixture of `noise_adaptation` (offset 0) the mean is

    g(m) = sigma (phi(t) - t Phi(-t)) + p m0 (Phi(-t) + exp(k^2/2 - k t) Phi(t - k))

with t = sigma / m, k = sigma / m0 and the true mean bias m0. The method settles at the largest root
of m = g(m). With p = 1 and sigma well below m0 that is m0 - (3/4) sigma^2 / m0. Line-of-sight
measurements count as reflections of bias 0, so that otherwise it is near p m0. And since g(m) falls
faster than m as m goes to 0, m = 0 attracts too: where m0 is not well above sigma there is no other
root, every b* becomes 0 and lambda infinite.

Paper: eq. (6) and section IV-C, "Path to Adaptive Estimation".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.kernel import Vector
from tools.study.noise_adaptation import (
    DEFAULTS,
    AdaptationParams,
    RangeNoise,
)
from tools.study.noise_mixtures import mean_map_bias
from tools.study.range_noise_fit import fit_range_noise

COLLAPSED = 0.05
"""A mean bias below this many sigma is on its way to 0: b* is 0 for all within 20 sigma."""
SETTLED = 1e-10
"""Relative change of the mean bias at which an iteration ends."""


def map_bias_m(residual_m: float, rate_per_m: float, sigma_m: float) -> float:
    """Return the most probable bias b* = max(0, r - lambda sigma^2), metres. Paper: eq. (6)."""
    return max(0.0, residual_m - rate_per_m * sigma_m**2)


def printed_mean_bias_m(residuals_m: Vector, sigma_m: float, start_m: float) -> float:
    """Return the printed EM's result for residuals (n,) from `start_m`; 0: it collapses."""
    return _settled_m(
        lambda m: float(np.mean(np.maximum(0.0, residuals_m - sigma_m**2 / m))), start_m, sigma_m
    )


def printed_fixed_point_m(noise: RangeNoise) -> float:
    """Return the printed EM's fixed point with endless measurements of this noise; 0: it collapses.

    Started from above, it reaches the largest fixed point there is.
    """

    def mean_map_bias_m(threshold: float) -> float:
        """Return the bias of the estimate with a threshold."""
        return noise.sigma_m * float(mean_map_bias(threshold, noise.k, noise.nlos_share))

    return _settled_m(
        lambda m: mean_map_bias_m(noise.sigma_m / m), mean_map_bias_m(0.0), noise.sigma_m
    )


def _settled_m(updated_m: Callable[[float], float], start_m: float, sigma_m: float) -> float:
    """Return the limit of an iteration that is monotone and bounded, and therefore has one."""
    mean_bias_m, change_m = start_m, math.inf
    while change_m > SETTLED * mean_bias_m:
        if mean_bias_m < COLLAPSED * sigma_m:
            return 0.0
        last_m, mean_bias_m = mean_bias_m, updated_m(mean_bias_m)
        change_m = abs(mean_bias_m - last_m)
    return mean_bias_m


@dataclass(frozen=True, slots=True)
class BiasComparison:
    """Mean biases that both methods learnt from the same residuals, averaged over runs."""

    truth: RangeNoise
    printed_limit_m: float
    """Limit of the printed EM with unlimited measurements; 0: it collapses."""
    printed_m: float
    collapsed_share: float
    """Share of runs in which the printed EM collapsed; they count as 0 in `printed_m`."""
    corrected: RangeNoise
    corrected_spread_m: float
    """Standard deviation of the corrected mean bias from run to run."""


def compare_mean_bias(
    truth: RangeNoise,
    start: RangeNoise,
    samples: int,
    runs: int,
    rng: np.random.Generator,
    params: AdaptationParams = DEFAULTS,
) -> BiasComparison:
    """Let both methods learn from `runs` draws of `samples` residuals.

    The printed EM is given the true sigma and starts at the true mean bias, the corrected one
    estimates everything from `start`.
    """
    printed_m, corrected = np.empty(runs), np.empty((runs, 3))
    for run in range(runs):
        residuals_m = drawn_residuals_m(truth, samples, rng)
        printed_m[run] = printed_mean_bias_m(residuals_m, truth.sigma_m, truth.mean_bias_m)
        noise = fit_range_noise(residuals_m, start, params).noise
        corrected[run] = noise.sigma_m, noise.mean_bias_m, noise.nlos_share
    return BiasComparison(
        truth=truth,
        printed_limit_m=printed_fixed_point_m(truth),
        printed_m=float(printed_m.mean()),
        collapsed_share=float(np.mean(printed_m == 0.0)),
        corrected=RangeNoise(*(float(value) for value in corrected.mean(axis=0))),
        corrected_spread_m=float(corrected[:, 1].std()),
    )


def drawn_residuals_m(noise: RangeNoise, count: int, rng: np.random.Generator) -> Vector:
    """Return residuals (count,) of the range mixture."""
    thermal_m = rng.normal(noise.offset_m, noise.sigma_m, count)
    is_reflected = rng.random(count) < noise.nlos_share
    return thermal_m + is_reflected * rng.exponential(noise.mean_bias_m, count)
