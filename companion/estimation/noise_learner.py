"""Learns one emitter's noise from the filter's innovations, and retunes the filter to it.

The innovations that are noise, and not the state's own uncertainty, go through the on-line EM of
`adaptation`; now and then the filter gets the sigma and the thresholds that it has found. What the
radio reports of its own sigma no longer counts then.

Paper: section IV-C, "Path to Adaptive Estimation", per emitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec

from companion.estimation.adaptation import (
    AdaptationParams,
    AdaptiveBearingNoise,
    AdaptiveRangeNoise,
    BearingNoise,
    RangeNoise,
    thresholds_of,
)
from companion.estimation.base import ModalityReport, UpdateReport
from companion.estimation.filter_params import FilterParams

RETUNE_EVERY = 50
"""Measurements learnt from between two tunings."""
FIRST_NLOS_SHARE = 0.5
"""What is believed of reflections before anything is learnt."""
WIDE_RATIO = 3.0
"""How much wider gross bearing errors are taken to be before anything is learnt."""
MAX_PRIOR_SHARE = 1.0
"""Innovations that are more of the state's own uncertainty than this are not learnt from."""


@dataclass(frozen=True, slots=True)
class NoiseLearner:
    """What has been learnt about one emitter."""

    ranges: AdaptiveRangeNoise
    bearings: AdaptiveBearingNoise
    params: AdaptationParams
    count: int = 0
    """Measurements learnt from."""

    @classmethod
    def starting(cls, believed: FilterParams, params: AdaptationParams) -> NoiseLearner:
        """Before the first measurement: what the filter's own parameters mean."""
        k = believed.range_k_long or params.k_max
        sigma_rad = math.radians(believed.bearing_sigma_deg)
        ranges = RangeNoise(
            sigma_m=believed.range_sigma_m,
            mean_bias_m=believed.range_sigma_m / k,
            nlos_share=FIRST_NLOS_SHARE,
        )
        bearings = BearingNoise(sigma_rad, WIDE_RATIO * sigma_rad, FIRST_NLOS_SHARE)
        return cls(
            AdaptiveRangeNoise.starting(ranges, params),
            AdaptiveBearingNoise.starting(bearings, params),
            params,
        )

    def after(self, report: UpdateReport) -> NoiseLearner:
        """With one more update learnt from."""
        ranges, bearings = self.ranges, self.bearings
        has_range, has_bearing = _is_noise(report.range), _is_noise(report.bearing)
        if report.range is not None and has_range:
            ranges = ranges.after(report.range.innovation)
        if report.bearing is not None and has_bearing:
            bearings = bearings.after(report.bearing.innovation)
        return replace(
            self,
            ranges=ranges,
            bearings=bearings,
            count=self.count + (has_range or has_bearing),
        )

    @property
    def is_due(self) -> bool:
        """Whether the filter should be tuned to what has been learnt."""
        return self.count > 0 and self.count % RETUNE_EVERY == 0

    def tuned(self, believed: FilterParams) -> FilterParams:
        """The filter's parameters with the noise that was learnt."""
        found = thresholds_of(self.ranges.noise, self.bearings.noise, self.params)
        return msgspec.structs.replace(
            believed,
            range_sigma_m=found.range_sigma_m,
            range_k_long=found.range_k_least_variance if believed.range_k_long else None,
            bearing_sigma_deg=math.degrees(found.bearing_sigma_rad),
            bearing_k=found.bearing_k if believed.bearing_k else None,
            use_reported_sigma=False,
        )


def _is_noise(report: ModalityReport | None) -> bool:
    return report is not None and report.prior_share <= MAX_PRIOR_SHARE
