"""What every filter of the target's position shares: protocol, states, reports and parameters.

Another filter is a class with the members of `TargetFilter` and a row in `kalman.KINDS`: tracker,
window, gate and first hypotheses ask for nothing else.

`FilterParams` is what a filter believes (noise, thresholds, priors and bounds), and the kernels'
form of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Protocol

import msgspec
import numpy as np

from companion.domain import (
    MOST,
    NonNegative,
    Params,
    PositionEnu,
    Positive,
    RangingMeasurement,
    Signed,
)
from companion.estimation.antenna import LEVEL, MODELS, AntennaParams
from companion.estimation.filters.robust_update import threshold
from companion.estimation.measurement_model import (
    ABSENT,
    AZIMUTH,
    BEARING_OFFSET,
    COSINES,
    PLANAR,
    RANGE_OFFSET,
    RangingModel,
)
from companion.kernel import Matrix, Vector, frozen

Pose = tuple[float, ...]
"""A sensor's place, and behind it the two axes of an antenna array: 3 or 9 numbers, ENU."""
Inflation = tuple[float, float, float]
"""Factors on the variances of range, bearing and elevation."""
NO_INFLATION: Inflation = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class FilterState:
    """Mean (n,) and covariance (n, n); see `measurement_model` for what the components are."""

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
    def of_row(cls, row: list[float]) -> ModalityReport | None:
        """A row of six numbers of what the update kernels report; None if nothing was measured."""
        return None if math.isnan(row[0]) else cls(*row)


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

    @property
    def params(self) -> FilterParams:
        """What it believes, as in force; window, likelihood and noise monitor believe the same."""

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
            state: At the measurement's time, or later: then the measurement is late, and the random
                walk since then counts as noise of it.
            measurement: With range, bearing in ENU, elevation, or several of them.
            inflation: Factors on the variance of range, bearing and elevation.
        """


NO_AXES = (0.0,) * 6
"""Of a measurement without a direction."""
VAGUEST = (MOST, math.pi, math.pi)
"""The largest standard deviations that count, of a range (m), a bearing and an elevation (rad):
half a turn says nothing of a direction."""
FLOAT32_STEP = 2.0**-23
"""Relative: the configured number as a float32 message has it is not below the configured one."""


class FilterParams(Params, frozen=True, dict=True):
    """What a filter believes about the radio; the defaults are the paper's canonical scenario.

    What follows from it for the kernels is found once; those arrays are not to be written to.
    """

    range_sigma_m: Positive = 1.5
    """Thermal noise of a range where the radio reports none, and the least that a reported one
    counts as: a radio, or a forger, that claims less gets no more weight."""
    bearing_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] = 2.0
    """The same of a bearing."""
    use_reported_sigma: bool = True
    """Whether the radio's own standard deviations count where they are larger than the above."""
    range_k_long: Positive | None = 1.5
    """Threshold for ranges that are too long, in sigma; null: never robust on that side."""
    range_k_short: Positive | None = None
    """Threshold for ranges that are too short; null is the paper's one-sided loss."""
    bearing_k: Positive | None = 1.5
    """Threshold for bearings and elevations on both sides; null: never robust."""
    elevation_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] = 5.0
    """The same of an elevation."""
    use_elevation: bool = True
    """Whether measured elevations count; false where the antenna tilts with the vehicle."""
    range_offset_m: Signed = 0.0
    """Prior mean of the constant range offset."""
    range_offset_sigma_m: Positive = 5.0
    """Prior standard deviation of the constant range offset."""
    range_offset_min_m: Signed | None = None
    """Hard lower bound of the range offset; null: none."""
    range_offset_max_m: Signed | None = None
    """Hard upper bound of the range offset; null: none."""
    bearing_offset_sigma_deg: Positive = 5.0
    """Prior standard deviation of the constant bearing offset, about zero."""
    bearing_offset_max_deg: Annotated[float, msgspec.Meta(gt=0.0, le=180.0)] = 180.0
    """Hard bound of the bearing offset, to both sides."""
    range_step_m: NonNegative = 0.0
    """Ranges come in steps of so much, as a cell's timing advance does; 0: they do not."""
    range_scale_sigma: NonNegative = 0.0
    """Prior standard deviation of the range's scale error; 0: ranges have none."""
    range_scale_max: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.5
    """Hard bound of the scale error, to both sides."""
    range_scale_min: Annotated[float, msgspec.Meta(gt=-1.0, le=0.0)] | None = None
    """Hard lower bound of the scale error, where it is another; 0: ranges never come out short."""
    reach_m: Positive | None = None
    """How far this radio is heard: the target is about as near to the path, as the standard
    deviation of a Gaussian per axis; null: anywhere."""
    place_range_sigma_m: NonNegative = 0.0
    """How much of a range's error stays with the place, before the run has shown it; 0: nothing is
    believed before errors are seen to repeat each other."""
    place_bearing_sigma_deg: NonNegative = 0.0
    """The same of a bearing's."""
    place_length_m: Positive = 4.0
    """Over which distance those errors change, before the run has shown it."""
    position_sigma_m: Positive = 30.0
    """Prior standard deviation of the first position fix, each axis."""
    own_position_sigma_m: NonNegative = 0.1
    """How well the vehicle knows its own place; it counts in every measurement and in R95."""
    process_noise_m_per_sqrt_s: NonNegative = 0.0
    """Random walk of the target; 0: it lies still."""
    stamp_lag_s: NonNegative = 0.0
    """How much later than it measured the radio stamps."""
    stamp_lag_sigma_s: NonNegative | None = None
    """How well that is known; null: as told with the antenna, 0.15 s where nobody told it."""
    target_height_m: Signed = 0.0
    """Height of the emitter above the local origin."""
    target_height_sigma_m: NonNegative = 0.0
    """How well that height is known; above 0 it is estimated."""
    near_target_terms: bool = True
    """Second-order terms of the measurement model, which keep the filter sane close by."""
    antenna: AntennaParams = AntennaParams()
    """What measures the bearing."""

    def __post_init__(self) -> None:
        """Refuse bounds that leave nothing between them."""
        low, high = self.range_offset_min_m, self.range_offset_max_m
        if low is not None and high is not None and low >= high:
            raise ValueError("range_offset_min_m must be below range_offset_max_m")

    @cached_property
    def model(self) -> RangingModel:
        """What the kernels need to know of the measurement model and of the state's layout."""
        has_scale, has_height = self.range_scale_sigma > 0.0, self.target_height_sigma_m > 0.0
        return RangingModel(
            height_m=self.target_height_m,
            height_index=4 + has_scale if has_height else ABSENT,
            scale_index=4 if has_scale else ABSENT,
            own_sigma_m=self.own_position_sigma_m,
            near_target_terms=self.near_target_terms,
            antenna=MODELS[self.antenna.kind],
        )

    @property
    def step_sigma_m(self) -> float:
        """Standard deviation of a value that is even within a step of the ranges."""
        return self.range_step_m / math.sqrt(12.0)

    @property
    def place_sigmas(self) -> tuple[float, float]:
        """Of a range's and a bearing's errors that stay with the place, metres and radians.

        A range repeats its step's error from wherever it is within the same step.
        """
        range_m = math.hypot(self.place_range_sigma_m, self.step_sigma_m)
        return range_m, math.radians(self.place_bearing_sigma_deg)

    @property
    def range_length_m(self) -> float:
        """Over which distance a range's errors change: half a step flies out of it on average."""
        return max(self.place_length_m, 0.5 * self.range_step_m)

    @property
    def prior(self) -> tuple[Vector, Vector]:
        """Mean and standard deviations of the state, each (n,), new, before any measurement."""
        offset_m = self.range_offset_m
        if self.range_offset_min_m is not None:
            offset_m = max(offset_m, self.range_offset_min_m)
        if self.range_offset_max_m is not None:
            offset_m = min(offset_m, self.range_offset_max_m)
        place = self.position_sigma_m
        bearing_rad = math.radians(self.bearing_offset_sigma_deg)
        mean = [0.0, 0.0, offset_m, 0.0]
        sigmas = [place, place, self.range_offset_sigma_m, bearing_rad]
        if self.range_scale_sigma > 0.0:
            mean.append(0.0)
            sigmas.append(self.range_scale_sigma)
        if self.target_height_sigma_m > 0.0:
            mean.append(self.target_height_m)
            sigmas.append(self.target_height_sigma_m)
        return np.array(mean), np.array(sigmas)

    @cached_property
    def bounds(self) -> Matrix:
        """Lower and upper bounds of the state, (2, n), infinite where there are none."""
        model = self.model
        size = self.prior[0].size
        bounds = np.stack([np.full(size, -np.inf), np.full(size, np.inf)])
        if self.range_offset_min_m is not None:
            bounds[0, RANGE_OFFSET] = self.range_offset_min_m
        if self.range_offset_max_m is not None:
            bounds[1, RANGE_OFFSET] = self.range_offset_max_m
        if self.bearing_offset_max_deg < 180.0:
            largest_rad = math.radians(self.bearing_offset_max_deg)
            bounds[:, BEARING_OFFSET] = -largest_rad, largest_rad
        if model.scale_index != ABSENT:
            least = self.range_scale_min
            bounds[0, model.scale_index] = -self.range_scale_max if least is None else least
            bounds[1, model.scale_index] = self.range_scale_max
        return bounds

    @cached_property
    def thresholds(self) -> Matrix:
        """Long and short threshold of range, bearing and elevation, (3, 2), in sigma."""
        angle = threshold(self.bearing_k)
        ranges = (threshold(self.range_k_long), threshold(self.range_k_short))
        return np.array([ranges, (angle, angle), (angle, angle)])

    def seen(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu
    ) -> tuple[Pose, Vector, Vector]:
        """A measurement as the kernels take it: the sensor's pose, values and sigmas, each (3,)."""
        m = measurement
        pose: Pose = sensor_enu_m
        has_elevation = self.use_elevation and not m.is_array_angle
        values = (m.range_m, m.bearing_enu_rad, m.elevation_rad if has_elevation else None)
        if self.model.antenna != AZIMUTH:
            values, pose = (m.range_m, None, None), (*sensor_enu_m, *NO_AXES)
            if m.array is None and m.bearing_enu_rad is not None and self.model.antenna == PLANAR:
                values = (m.range_m, -m.bearing_enu_rad, None)  # by north: of a level array
                pose = (*sensor_enu_m, *LEVEL[0], *LEVEL[1])
            elif m.array is not None:
                values = (m.range_m, m.array.first, m.array.second)
                pose = (*sensor_enu_m, *m.array.first_axis_enu, *m.array.second_axis_enu)
        z = np.array([math.nan if v is None else v for v in values])
        return pose, z, np.array(self.seen_sigmas(m))

    def seen_sigmas(self, measurement: RangingMeasurement) -> tuple[float, float, float]:
        """Return the standard deviations of range, bearing and elevation that count.

        No range is better than its steps, and nothing is better than its radio is configured to
        be, whatever the radio reports.
        """
        m, least_m = measurement, self.step_sigma_m
        believed = (
            max(self.range_sigma_m, least_m),
            math.radians(self.bearing_sigma_deg),
            math.radians(self.elevation_sigma_deg),
        )
        if self.model.antenna == COSINES:  # one array measures both components alike
            believed = (*believed[:2], believed[1])
        if not self.use_reported_sigma:
            return believed
        reported = (m.range_sigma_m, m.bearing_sigma_rad, m.elevation_sigma_rad)
        if reported == (None, None, None):
            return believed
        ranged, borne, elevated = (
            _within(sigma, own if least is None else least, most, own)
            for sigma, least, most, own in zip(
                reported, m.least_sigmas, VAGUEST, believed, strict=True
            )
        )
        return (max(ranged, least_m), borne, elevated)


def _within(reported: float | None, least: float, most: float, default: float) -> float:
    """Return a reported standard deviation within its range, or the default of one that is none."""
    if reported is None:
        return default
    return least if reported < least * (1.0 - FLOAT32_STEP) else min(reported, most)
