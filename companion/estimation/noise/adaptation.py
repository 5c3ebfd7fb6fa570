"""On-line EM for a radio's noise: sigma, share and mean bias of NLOS ranges, bearing noise.

Theory of operation. A range residual r = y - h(x) is an offset mu, thermal noise N(0, sigma^2) and,
with probability p, a reflection's bias b ~ Exp(lambda). Its density is a mixture,

    f(r) = (1 - p) N(r; mu, sigma^2) + p lambda exp(k^2/2 - k u) Phi(u - k)

with u = (r - mu) / sigma and k = lambda sigma. Given r and that there is a bias, b / sigma is the
normal N(u - k, 1) truncated at 0. The E-step takes the *moments* of that posterior and the
probability g of a bias, the M-step the maximum of the expected likelihood:

    p = mean g    1/lambda = sum g b / sum g    mu = mean (r - g b)    sigma^2 = mean (r - b - mu)^2

A prior worth a few measurements is added in every M-step, so that it never fades: in line of sight
nothing is learnt about lambda, and it stays at its prior. On line, the sums are forgotten
exponentially. Where nearly every range is reflected, a free offset and the share can hardly be
separated. Bearings have no sign: theirs is a mixture of two zero-mean normals.

Paper: section IV-C, "Path to Adaptive Estimation". Deviations: as described; the EM as printed, and
why it is biased, is in `tools/study/printed_adaptation.py`. Sources: O. Cappe and E. Moulines, J.
Royal Statistical Society B 71 (2009), for EM on sums that are updated measurement by measurement;
P. J. Huber, Robust Statistics (1981), for the variance of an M-estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec

from companion.domain import Params, Positive
from companion.estimation.noise.mixtures import (
    bearing_expectations,
    least_variance_k,
    least_variance_k_long,
    range_expectations,
)

SHORTEST_U = 3.0
"""Residuals are clipped at this many sigma on the short side: the mixture does not model gross
errors there, and a burst of them would raise sigma."""
SHARE_MARGIN = 1e-6
"""Distance of shares from 0 and 1, which are fixed points of EM."""


class AdaptationParams(Params, frozen=True):
    """Rate, priors and bounds of learning a radio's noise."""

    memory: Annotated[float, msgspec.Meta(ge=2.0)] = 300.0
    """Measurements after which one has decayed to 1/e of its weight."""
    prior_count: Positive = 3.0
    """Weight of the prior sigma, share and offset, in measurements; it does not fade."""
    tail_prior_count: Positive = 10.0
    """Weight of the prior mean bias, in reflections, and of the wide sigma, in gross bearing
    errors: larger, because informative measurements may never come."""
    estimate_offset: bool = False
    """True: the location of the residuals is learnt too; false: it stays at its prior."""
    range_sigma_min_m: Positive = 0.02
    range_sigma_max_m: Positive = 20.0
    mean_bias_min_m: Positive = 0.2
    mean_bias_max_m: Positive = 100.0
    bearing_sigma_min_deg: Positive = 0.1
    bearing_sigma_max_deg: Positive = 60.0
    wide_ratio_min: Annotated[float, msgspec.Meta(gt=1.0)] = 1.5
    """Least ratio of wide to narrow sigma, below which the two are indistinguishable."""
    k_min: Positive = 0.1
    """Least threshold for the filter, below which a loss has hardly any curvature."""
    k_max: Positive = 5.0
    """Largest threshold for the filter, above which a loss is practically quadratic."""

    def __post_init__(self) -> None:
        """Reject bounds that exclude every value."""
        for low, high in (
            ("range_sigma_min_m", "range_sigma_max_m"),
            ("mean_bias_min_m", "mean_bias_max_m"),
            ("bearing_sigma_min_deg", "bearing_sigma_max_deg"),
            ("k_min", "k_max"),
        ):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} must be below {high}")

    @property
    def forgetting(self) -> float:
        """Factor on all sums per measurement."""
        return 1.0 - 1.0 / self.memory


DEFAULTS = AdaptationParams()
"""Adaptation as shipped."""


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """Parameters of the range mixture."""

    sigma_m: float
    mean_bias_m: float
    """Mean bias of a reflection, 1/lambda."""
    nlos_share: float
    offset_m: float = 0.0
    """Location of the thermal noise."""

    @property
    def k(self) -> float:
        """Threshold lambda sigma of the paper's loss. Paper: eq. (10)."""
        return 1.0 / self.mean_bias_m * self.sigma_m

    @property
    def parameters(self) -> tuple[float, float, float, float]:
        """Arguments of the kernels of `mixtures`."""
        return (self.sigma_m, self.mean_bias_m, self.nlos_share, self.offset_m)


class RangeSums(NamedTuple):
    """Expected sufficient statistics of the range mixture, summed over measurements."""

    measurements: float = 0.0
    nlos: float = 0.0
    bias_m: float = 0.0
    noise_m: float = 0.0
    """Sum of residual minus bias."""
    noise2_m2: float = 0.0

    def most_likely(self, prior: RangeNoise, params: AdaptationParams) -> RangeNoise:
        """Return the M-step, the prior included."""
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
"""Sums before the first measurement."""


@dataclass(frozen=True, slots=True)
class AdaptiveRangeNoise:
    """Range noise of one emitter, learnt measurement by measurement."""

    params: AdaptationParams
    prior: RangeNoise
    noise: RangeNoise
    learnt: RangeSums = NOTHING_LEARNT
    """Sums over the measurements, without the prior."""

    @classmethod
    def starting(cls, prior: RangeNoise, params: AdaptationParams = DEFAULTS) -> AdaptiveRangeNoise:
        """Return the noise before the first measurement: the prior."""
        return cls(params, prior, RangeSums().most_likely(prior, params))

    def after(self, residual_m: float) -> AdaptiveRangeNoise:
        """Return the noise after one more residual, measured minus predicted range."""
        shortest_m = self.noise.offset_m - SHORTEST_U * self.noise.sigma_m
        *sums, _ = range_expectations(max(residual_m, shortest_m), *self.noise.parameters)
        keep = self.params.forgetting
        pairs = zip(self.learnt, (1.0, *sums), strict=True)
        learnt = RangeSums(*(keep * before + newest for before, newest in pairs))
        noise = learnt.most_likely(self.prior, self.params)
        return AdaptiveRangeNoise(self.params, self.prior, noise, learnt)


@dataclass(frozen=True, slots=True)
class BearingNoise:
    """Parameters of the bearing mixture: two zero-mean normals."""

    sigma_rad: float
    wide_sigma_rad: float
    wide_share: float


@dataclass(frozen=True, slots=True)
class AdaptiveBearingNoise:
    """Bearing noise of one emitter, learnt measurement by measurement."""

    params: AdaptationParams
    prior: BearingNoise
    noise: BearingNoise
    count: float = 0.0
    wide: float = 0.0
    """Expected number of bearings of the wide normal."""
    narrow_rad2: float = 0.0
    """Expected sum of squares of the narrow normal."""
    wide_rad2: float = 0.0

    @classmethod
    def starting(
        cls, prior: BearingNoise, params: AdaptationParams = DEFAULTS
    ) -> AdaptiveBearingNoise:
        """Return the noise before the first measurement: the prior."""
        return cls(params, prior, prior)

    def after(self, residual_rad: float) -> AdaptiveBearingNoise:
        """Return the noise after one more residual, measured minus predicted in [-pi, pi)."""
        n, keep, square = self.noise, self.params.forgetting, residual_rad**2
        wide, _ = bearing_expectations(residual_rad, n.sigma_rad, n.wide_sigma_rad, n.wide_share)
        sums = (
            keep * self.count + 1.0,
            keep * self.wide + wide,
            keep * self.narrow_rad2 + (1.0 - wide) * square,
            keep * self.wide_rad2 + wide * square,
        )
        return AdaptiveBearingNoise(self.params, self.prior, self._most_likely(*sums), *sums)

    def _most_likely(
        self, count: float, wide: float, narrow_rad2: float, wide_rad2: float
    ) -> BearingNoise:
        """Return the M-step, the prior included; the ratio of the sigmas is kept at its minimum."""
        prior, ratio = self.prior, self.params.wide_ratio_min
        extra, extra_tail = self.params.prior_count, self.params.tail_prior_count
        narrow_rad2 += extra * prior.sigma_rad**2
        wide_rad2 += extra_tail * prior.wide_sigma_rad**2
        sigma_rad = math.sqrt(narrow_rad2 / (count - wide + extra))
        wide_rad = math.sqrt(wide_rad2 / (wide + extra_tail))
        if wide_rad < ratio * sigma_rad:
            pooled_rad2 = narrow_rad2 + wide_rad2 / ratio**2
            sigma_rad = math.sqrt(pooled_rad2 / (count + extra + extra_tail))
        low_rad = math.radians(self.params.bearing_sigma_min_deg)
        high_rad = math.radians(self.params.bearing_sigma_max_deg)
        sigma_rad = _clipped(sigma_rad, low_rad, high_rad)
        share = (wide + extra * prior.wide_share) / (count + extra)
        return BearingNoise(
            sigma_rad=sigma_rad,
            wide_sigma_rad=max(wide_rad, ratio * sigma_rad),
            wide_share=_clipped(share, SHARE_MARGIN, 1.0 - SHARE_MARGIN),
        )


@dataclass(frozen=True, slots=True)
class LearntThresholds:
    """Noise and thresholds in the terms of `FilterParams`; thresholds in sigma."""

    range_sigma_m: float
    range_k_long: float
    """The paper's threshold lambda sigma, best where nearly every range is reflected."""
    range_k_least_variance: float
    """Threshold of least variance where many ranges are line of sight; it is larger."""
    bearing_sigma_rad: float
    bearing_k: float
    """Threshold of least variance for bearings."""


def thresholds_of(
    ranges: RangeNoise, bearings: BearingNoise, params: AdaptationParams = DEFAULTS
) -> LearntThresholds:
    """Return the noise and thresholds for the filter, within [k_min, k_max].

    Paper: eq. (10). Those of least variance are the best for estimating a constant.
    """
    low, high = params.k_min, params.k_max
    ratio = bearings.wide_sigma_rad / bearings.sigma_rad
    least_variance = float(least_variance_k_long(ranges.k, ranges.nlos_share))
    return LearntThresholds(
        range_sigma_m=ranges.sigma_m,
        range_k_long=_clipped(ranges.k, low, high),
        range_k_least_variance=_clipped(least_variance, low, high),
        bearing_sigma_rad=bearings.sigma_rad,
        bearing_k=float(least_variance_k(ratio, bearings.wide_share, low, high)),
    )


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
