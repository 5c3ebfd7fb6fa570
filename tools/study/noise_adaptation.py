"""Mixture of line of sight and reflections for range residuals, and its M-step.

Theory of operation. A range residual r = y - h(x) is an offset mu, thermal noise N(0, sigma^2)
and, with probability p, a reflection's bias b ~ Exp(lambda). Its density is a mixture,

    f(r) = (1 - p) N(r; mu, sigma^2) + p lambda exp(k^2/2 - k u) Phi(u - k)

with u = (r - mu) / sigma and k = lambda sigma. Given r and that there is a bias, b / sigma is the
normal N(u - k, 1) cut off at 0. The E-step takes the *moments* of that posterior and the
probability g that there is a bias at all, the M-step the maximum of the expected likelihood:

    p = mean g    1/lambda = sum g b / sum g    mu = mean (r - g b)    sigma^2 = mean (r - b - mu)^2

A prior worth a few measurements is added in every M-step, so that it never fades: in line of sight
nothing is learnt about lambda, and it rests at its prior. Where reflections are nearly all there
is, a free offset and the share can hardly be separated.

Paper: section IV-C, "Path to Adaptive Estimation". Deviations: as said; the EM as printed, and why
it is biased, is in `printed_adaptation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

SHARE_MARGIN = 1e-6
"""Shares stay this far from 0 and 1, where EM would never leave again."""


@dataclass(frozen=True, slots=True)
class AdaptationParams:
    """Prior weights and bounds of the fit."""

    prior_count: float = 3.0
    """Measurements that the first sigma, share and offset are worth in every M-step."""
    tail_prior_count: float = 10.0
    """Reflections that the first mean bias is worth: more, as line of sight brings none."""
    estimate_offset: bool = False
    """True: the location of the residuals is fitted, too; False: it is the prior's."""
    range_sigma_min_m: float = 0.02
    range_sigma_max_m: float = 20.0
    mean_bias_min_m: float = 0.2
    mean_bias_max_m: float = 100.0


DEFAULTS = AdaptationParams()


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """The parameters of the range mixture."""

    sigma_m: float
    mean_bias_m: float
    """1/lambda, the mean bias of a reflection."""
    nlos_share: float
    offset_m: float = 0.0
    """Location of the thermal noise."""

    @property
    def k(self) -> float:
        """Threshold lambda sigma of the paper's loss. Paper: eq. (10)."""
        return 1.0 / self.mean_bias_m * self.sigma_m

    @property
    def parameters(self) -> tuple[float, float, float, float]:
        """Sigma (m), mean bias (m), share and offset (m), as `noise_mixtures` takes them."""
        return (self.sigma_m, self.mean_bias_m, self.nlos_share, self.offset_m)


class RangeSums(NamedTuple):
    """Expected sufficient statistics of the range mixture, summed over measurements."""

    measurements: float = 0.0
    nlos: float = 0.0
    bias_m: float = 0.0
    noise_m: float = 0.0
    """Noise of residual - bias."""
    noise2_m2: float = 0.0

    def most_likely(self, prior: RangeNoise, params: AdaptationParams) -> RangeNoise:
        """The M-step, the prior counted in."""
        extra, extra_tail = params.prior_count, params.tail_prior_count
        count, noise_m = self.measurements + extra, self.noise_m + extra * prior.offset_m
        noise2_m2 = self.noise2_m2 + extra * (prior.sigma_m**2 + prior.offset_m**2)
        bias_m = (self.bias_m + extra_tail * prior.mean_bias_m) / (self.nlos + extra_tail)
        share = (self.nlos + extra * prior.nlos_share) / count
        offset_m = noise_m / count if params.estimate_offset else prior.offset_m
        variance_m2 = (noise2_m2 - 2.0 * offset_m * noise_m) / count + offset_m**2
        sigma_m = math.sqrt(max(variance_m2, 0.0))
        return RangeNoise(
            sigma_m=_clipped(sigma_m, params.range_sigma_min_m, params.range_sigma_max_m),
            mean_bias_m=_clipped(bias_m, params.mean_bias_min_m, params.mean_bias_max_m),
            nlos_share=_clipped(share, SHARE_MARGIN, 1.0 - SHARE_MARGIN),
            offset_m=offset_m,
        )


NOTHING_LEARNT = RangeSums()


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
