"""The run's own noise, all modalities: is it white, and how much worse than thermal is it."""

from __future__ import annotations

from dataclasses import dataclass

from companion.estimation.base import Inflation, ModalityReport, UpdateReport
from companion.estimation.chi_square import NisMonitor
from companion.estimation.consistency import MAX_INFLATION, NoiseMonitor
from companion.estimation.observability import Observability
from companion.geometry.arrays import Matrix
from companion.models.ranging_model import MODALITIES

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
