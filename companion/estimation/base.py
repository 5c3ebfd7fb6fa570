"""Values and the protocol that every filter of the target's position shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol

import msgspec
import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.geometry.arrays import Matrix, Vector, frozen
from companion.params import NonNegative, Params, Positive


class FilterParams(Params, frozen=True):
    """What a filter believes about the radio; the defaults are the paper's canonical scenario."""

    range_sigma_m: Positive = 1.5
    """Thermal noise of a range, where the radio does not report one."""
    bearing_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] = 2.0
    """Thermal noise of a bearing, where the radio does not report one."""
    use_reported_sigma: bool = True
    """Whether the radio's own standard deviations replace the two above."""
    range_k_long: Positive | None = 1.5
    """Threshold for ranges that are too long, in sigma; null: never robust on that side."""
    range_k_short: Positive | None = None
    """Threshold for ranges that are too short; null is the paper's one-sided loss."""
    bearing_k: Positive | None = 1.5
    """Threshold for bearings on both sides; null: never robust."""
    range_offset_sigma_m: Positive = 5.0
    """Prior standard deviation of the constant range offset, about zero."""
    range_offset_min_m: float | None = None
    """Hard lower bound of the range offset; null: none."""
    range_offset_max_m: float | None = None
    """Hard upper bound of the range offset; null: none."""
    bearing_offset_sigma_deg: Positive = 5.0
    """Prior standard deviation of the constant bearing offset, about zero."""
    position_sigma_m: Positive = 30.0
    """Prior standard deviation of the first position fix, each axis."""
    own_position_sigma_m: NonNegative = 0.1
    """How well the vehicle knows its own place; it counts in every measurement and in R95."""
    process_noise_m_per_sqrt_s: NonNegative = 0.0
    """Random walk of the target; 0: it lies still."""
    target_height_m: float = 0.0
    """Height of the emitter above the local origin."""
    near_target_terms: bool = True
    """Second-order terms of the measurement model, which keep the filter sane close by."""

    def __post_init__(self) -> None:
        """Refuse bounds that leave nothing between them."""
        low, high = self.range_offset_min_m, self.range_offset_max_m
        if low is not None and high is not None and low >= high:
            raise ValueError("range_offset_min_m must be below range_offset_max_m")


@dataclass(frozen=True, slots=True)
class FilterState:
    """Mean (4,) and covariance (4, 4) of [east, north, range offset, bearing offset]."""

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
    """S with the robust weight in it."""
    noise_sigma: float
    """Square root of R before weight and inflation: the unit of `whitened_innovation`."""
    whitened_innovation: float
    weight: float
    """Robust weight, in (0, 1]."""
    prior_share: float
    """H P H^T / R: how much of the innovation is the state's own uncertainty."""


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """The state after a measurement, and what the measurement said."""

    state: FilterState
    range: ModalityReport | None
    bearing: ModalityReport | None
    nis: float
    """y^T S^-1 y over the modalities measured."""
    is_positive_definite: bool
    """False: `state` is the one from before, and the filter must be restarted."""


class TargetFilter(Protocol):
    """A recursive filter of a target's position; pure, the caller keeps the state."""

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at a later time."""

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: tuple[float, float] = (1.0, 1.0),
    ) -> UpdateReport:
        """The state after a measurement taken at `sensor_enu_m`.

        Args:
            state: The state at the measurement's time.
            measurement: With range, bearing in ENU, or both.
            sensor_enu_m: Where the antenna was at that time.
            inflation: Factors on the variance of range and bearing.
        """
