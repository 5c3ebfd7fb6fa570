"""Values and the protocol that every filter of the target's position shares."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.arrays import Matrix, Vector, frozen

Inflation = tuple[float, float, float]
"""Factors on the variances of range, bearing and elevation."""
NO_INFLATION: Inflation = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class FilterState:
    """Mean (n,) and covariance (n, n); see `models.ranging_model` for what the components are."""

    time_s: float
    mean: Vector
    covariance: Matrix

    @classmethod
    def of(cls, time_s: float, mean: Vector, covariance: Matrix) -> FilterState:
        """A state whose arrays are its own and read-only."""
        return cls(time_s, frozen(np.array(mean)), frozen(np.array(covariance)))


@dataclass(frozen=True, slots=True)
class ModalityReport:
    """What one range or one bearing did in an update."""

    innovation: float
    """z - h(x), metres or radians; positive when a range is longer than predicted."""
    innovation_variance: float
    """S with the robust weight in it, beside what the modalities before this one explained."""
    noise_sigma: float
    """Square root of R before weight and inflation: the unit of `whitened_innovation`."""
    whitened_innovation: float
    weight: float
    """Robust weight, in (0, 1]."""
    prior_share: float
    """H P H^T / R: how much of the innovation is the state's own uncertainty."""

    @classmethod
    def of_row(cls, row: Vector) -> ModalityReport | None:
        """A row (6,) of what the update kernels report; None if nothing was measured."""
        innovation, *rest = row.tolist()
        return None if math.isnan(innovation) else cls(innovation, *rest)


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """The state after a measurement, and what the measurement said."""

    state: FilterState
    range: ModalityReport | None
    bearing: ModalityReport | None
    elevation: ModalityReport | None
    nis: float
    """y^T S^-1 y over the modalities measured, with the robust weights in S."""
    is_positive_definite: bool
    """False: `state` is the one from before, and the filter must be restarted."""

    @property
    def modalities(self) -> tuple[ModalityReport | None, ...]:
        """Range, bearing and elevation, in this order."""
        return (self.range, self.bearing, self.elevation)


class TargetFilter(Protocol):
    """A recursive filter of a target's position; pure, the caller keeps the state."""

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at a later time."""

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        """The state after a measurement taken at `sensor_enu_m`.

        Args:
            state: The state at the measurement's time, or later: then the measurement is late, and
                the random walk since then counts as noise of it.
            measurement: With range, bearing in ENU, elevation, or several of them.
            sensor_enu_m: Where the antenna was at that time.
            inflation: Factors on the variance of range, bearing and elevation.
        """
