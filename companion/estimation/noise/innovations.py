"""The run's own noise from its innovations: is it white, how much worse than thermal.

The learner retunes the filter to one emitter's noise. The innovations that are noise, and not the
state's own uncertainty, go through the on-line EM of `adaptation`; now and then the filter gets the
sigma and the thresholds that it has found. What the radio reports of its own sigma no longer counts
then.

Paper: section IV-C, "Path to Adaptive Estimation", per emitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec

from companion.estimation.filters.target_filter import (
    FilterParams,
    Inflation,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.integrity.consistency import MAX_INFLATION, NisMonitor, NoiseMonitor
from companion.estimation.measurement_model import MODALITIES
from companion.estimation.noise.adaptation import (
    AdaptationParams,
    AdaptiveBearingNoise,
    AdaptiveRangeNoise,
    BearingNoise,
    RangeNoise,
    thresholds_of,
)
from companion.estimation.window.sandwich import Observability
from companion.kernel import Matrix

MAX_PRIOR_SHARE = 1.0
"""Innovations that are more of the state's own uncertainty than this say nothing of noise."""


@dataclass(frozen=True, slots=True)
class TrackerHealth:
    """How far an estimate can be trusted."""

    nis: float | None
    """Mean NIS per degree of freedom; 1 is consistent."""
    is_overconfident: bool
    """Whether it is above its 95 % band."""
    correlation: tuple[float, float, float]
    """Lag-1 correlation of range, bearing and elevation innovations; 0: white."""
    inflation: Inflation
    """How much worse than thermal noise each modality is taken to be."""
    nlos_share: float
    """Share of recent ranges taken for reflections."""
    observability: Observability | None
    """Curvature and bilateral information; None before the first measurement."""


@dataclass(frozen=True, slots=True)
class InnovationNoise:
    """What the innovations of a run have shown."""

    monitors: tuple[NoiseMonitor, ...]
    """Of range, bearing and elevation."""
    nis: NisMonitor

    @classmethod
    def starting(cls, initial_inflation: float) -> InnovationNoise:
        """Before the first innovation."""
        return cls((NoiseMonitor(initial_inflation),) * MODALITIES, NisMonitor())

    def after(self, report: UpdateReport, thresholds: Matrix) -> InnovationNoise:
        """With one more update learnt from. Args: thresholds (3, 2)."""
        monitors = tuple(
            _observed(monitor, row, float(k_long), float(k_short))
            for monitor, row, (k_long, k_short) in zip(
                self.monitors, report.modalities, thresholds, strict=True
            )
        )
        return InnovationNoise(monitors, self.nis.after(report))

    @property
    def is_white(self) -> bool:
        """Whether innovations know nothing of each other, as far as can be told."""
        return all(monitor.correlation == 0.0 for monitor in self.monitors)

    @property
    def repetition(self) -> float:
        """How many measurements say as much as one that repeats nothing, at the worst."""
        return max(monitor.repetition for monitor in self.monitors)

    @property
    def nlos_share(self) -> float:
        """Share of recent ranges on the linear branch of the loss: taken for reflections."""
        return 1.0 - self.monitors[0].bilateral_share

    def inflation(self, found: Inflation | None) -> Inflation:
        """Variance inflation of range, bearing and elevation.

        Args:
            found: What the window's best optimum found for single measurements; None: not solved.
        """
        if found is None:
            ranges, bearings, elevations = (monitor.inflation for monitor in self.monitors)
        else:
            ranges, bearings, elevations = (
                min(noise * monitor.repetition, MAX_INFLATION)
                for noise, monitor in zip(found, self.monitors, strict=True)
            )
        return (ranges, bearings, elevations)

    def health(self, inflation: Inflation, observability: Observability | None) -> TrackerHealth:
        """The live values."""
        ranges, bearings, elevations = self.monitors
        return TrackerHealth(
            nis=self.nis.mean,
            is_overconfident=self.nis.is_overconfident,
            correlation=(ranges.correlation, bearings.correlation, elevations.correlation),
            inflation=inflation,
            nlos_share=self.nlos_share,
            observability=observability,
        )


def _observed(
    monitor: NoiseMonitor, report: ModalityReport | None, k_long: float, k_short: float
) -> NoiseMonitor:
    if report is None:
        return monitor
    if report.prior_share > MAX_PRIOR_SHARE:
        return monitor.reset_correlation()
    return monitor.after(report.whitened_innovation, k_long, k_short)


RETUNE_EVERY = 50
"""Measurements learnt from between two tunings."""
FIRST_NLOS_SHARE = 0.5
"""What is believed of reflections before anything is learnt."""
WIDE_RATIO = 3.0
"""How much wider gross bearing errors are taken to be before anything is learnt."""
MAX_LEARNT_PRIOR_SHARE = 1.0
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
    return report is not None and report.prior_share <= MAX_LEARNT_PRIOR_SHARE
