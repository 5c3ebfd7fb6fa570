"""Batch fit of the range mixture by EM; `noise_adaptation` has the mixture and its prior."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.kernel import Vector, kernel
from tools.study.noise_adaptation import (
    DEFAULTS,
    AdaptationParams,
    RangeNoise,
    RangeSums,
)
from tools.study.noise_mixtures import range_expectations


@kernel
def summed_range_expectations(
    residuals_m: Vector, sigma_m: float, mean_bias_m: float, nlos_share: float, offset_m: float
) -> tuple[float, float, float, float, float]:
    """Return the sums of `range_expectations` over residuals (n,)."""
    nlos, bias_m, noise_m, noise2_m2, log_density = 0.0, 0.0, 0.0, 0.0, 0.0
    for residual_m in residuals_m:
        one = range_expectations(float(residual_m), sigma_m, mean_bias_m, nlos_share, offset_m)
        nlos += one[0]
        bias_m += one[1]
        noise_m += one[2]
        noise2_m2 += one[3]
        log_density += one[4]
    return nlos, bias_m, noise_m, noise2_m2, log_density


def log_prior(noise: RangeNoise, prior: RangeNoise, params: AdaptationParams) -> float:
    """Return the log of the conjugate prior density of `noise`, but for a constant.

    Beta for the share, gamma for the rate of the biases, normal and inverse gamma for the noise.
    """
    from_prior_m = noise.offset_m - prior.offset_m
    square = (prior.sigma_m**2 + from_prior_m**2) / noise.sigma_m**2
    body = prior.nlos_share * math.log(noise.nlos_share)
    body += (1.0 - prior.nlos_share) * math.log1p(-noise.nlos_share)
    body -= math.log(noise.sigma_m) + 0.5 * square
    tail = -math.log(noise.mean_bias_m) - prior.mean_bias_m / noise.mean_bias_m
    return params.prior_count * body + params.tail_prior_count * tail


@dataclass(frozen=True, slots=True)
class RangeFit:
    """A batch fit."""

    noise: RangeNoise
    objectives: tuple[float, ...]
    """Log-likelihood plus log prior (but for a constant) before each iteration; never falls."""
    is_converged: bool


def fit_range_noise(
    residuals_m: Vector,
    start: RangeNoise,
    params: AdaptationParams = DEFAULTS,
    max_iterations: int = 1000,
    tolerance: float = 1e-8,
) -> RangeFit:
    """Return the noise that explains these residuals best, by EM.

    Args:
        residuals_m: (n,) measured minus predicted ranges.
        start: Start of EM, and the prior.
        max_iterations: EM is slow if biases are no larger than sigma.
        tolerance: Gain of the objective, per measurement, below which EM ends.
    """
    noise = RangeSums().most_likely(start, params)
    objectives: list[float] = []
    while len(objectives) < max_iterations:
        *sums, log_likelihood = summed_range_expectations(residuals_m, *noise.parameters)
        objectives.append(log_likelihood + log_prior(noise, start, params))
        noise = RangeSums(len(residuals_m), *sums).most_likely(start, params)
        gain = math.inf if len(objectives) < 2 else objectives[-1] - objectives[-2]
        if gain <= tolerance * (len(residuals_m) + 1.0):
            return RangeFit(noise, tuple(objectives), True)
    return RangeFit(noise, tuple(objectives), False)
