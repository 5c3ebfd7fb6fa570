"""Common parts of the filters of the target's position: protocol, states, reports, parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Protocol

import msgspec
import numpy as np

from companion.domain import (
    MAX_SETTING,
    NonNegative,
    Params,
    PositionEnu,
    Positive,
    RangingMeasurement,
    Signed,
)
from companion.estimation.antenna import LEVEL, MODELS, AntennaParams
from companion.estimation.measurement_model import (
    ABSENT,
    AZIMUTH,
    BEARING,
    BEARING_OFFSET,
    COSINES,
    ELEVATION,
    MODALITIES,
    PLANAR,
    RANGE,
    RANGE_OFFSET,
    RangingModel,
    rows_of,
)
from companion.kernel import Matrix, Vector, frozen

Inflation = tuple[float, ...]
"""Factors on the variances of the modalities."""
NO_INFLATION: Inflation = (1.0,) * (MODALITIES + 1)
"""Factors without inflation: thermal noise only."""


@dataclass(frozen=True, slots=True)
class FilterState:
    """Mean (n,) and covariance (n, n); `measurement_model` lists the components."""

    time_s: float
    mean: Vector
    covariance: Matrix

    @classmethod
    def of(cls, time_s: float, mean: Vector, covariance: Matrix) -> FilterState:
        """Return a state whose arrays are copied and read-only."""
        return cls(time_s, frozen(np.array(mean)), frozen(np.array(covariance)))


@dataclass(frozen=True, slots=True)
class ModalityReport:
    """Result of one modality in an update."""

    innovation: float
    """z - h(x), metres, radians or dB; positive when a range is longer than predicted."""
    innovation_variance: float
    """S with the robust weight in it, after the modalities before this one were fused."""
    noise_sigma: float
    """Square root of R before weight and inflation: the unit of `whitened_innovation`."""
    whitened_innovation: float
    weight: float
    """Robust weight, in (0, 1]."""
    prior_share: float
    """H P H^T / R: the state's own uncertainty in the innovation."""


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """State after a measurement, and the result of each modality."""

    state: FilterState
    modalities: tuple[ModalityReport | None, ...]
    """Range, bearing, elevation and, if the model has one, power; None: not measured."""
    nis: float
    """y^T S^-1 y over the modalities measured, with the robust weights in S."""
    is_positive_definite: bool
    """False: `state` is the previous one, and the filter must be reset."""

    @property
    def range(self) -> ModalityReport | None:
        """Result of the range; None: not measured."""
        return self.modalities[RANGE]

    @property
    def bearing(self) -> ModalityReport | None:
        """Result of the bearing, or of an array's first component; None: not measured."""
        return self.modalities[BEARING]

    @property
    def elevation(self) -> ModalityReport | None:
        """Result of the elevation, or of an array's second component; None: not measured."""
        return self.modalities[ELEVATION]


class TargetFilter(Protocol):
    """Recursive filter of a target's position; pure, the caller keeps the state."""

    @property
    def params(self) -> FilterParams:
        """Parameters in force, shared with window, likelihood and noise monitor."""

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """Return the state at a later time."""

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        """Return the state after a measurement taken at `sensor_enu_m`.

        Args:
            state: At the measurement's time, or later: then the measurement is late, and the random
                walk since then is added to its noise.
            measurement: Range, bearing in ENU, elevation, power, or several of them.
            inflation: Factors on the variance of each modality.
        """


POWER_SIGMA_DB = 4.5
"""Standard deviation of fast fading, little of it averaged by a radio: the middle of 3 to 6 dB."""
POWER_SHADOW_SIGMA_DB, POWER_LENGTH_M = 6.0, 30.0
"""Standard deviation of shadowing, the middle of 4 to 8 dB, and its correlation length: 10 m in
rubble to 100 m in the open (M. Gudmundson, Electronics Letters 27, 1991)."""
POWER_TOTAL_SIGMA_DB = math.hypot(POWER_SIGMA_DB, POWER_SHADOW_SIGMA_DB, 1.0 / math.sqrt(12.0))
"""Standard deviation of one received power, its rounding to 1 dB included."""
EXPONENT = 2.75
"""Prior mean of the path-loss exponent: the middle of 2 in free space and 3.5 in urban areas
(Rappaport, table 4.2)."""


def threshold(k: float | None) -> float:
    """Return a configured threshold as a number; infinity for null."""
    return math.inf if k is None else k


class FilterConfig(Params, frozen=True):
    """Assumptions about the radio that a file configures; `FilterParams` completes them.

    The defaults are the paper's canonical scenario.
    """

    range_sigma_m: Positive = 1.5
    """Thermal noise of a range where the radio reports none, and the lower limit of a reported one:
    a radio, or a forger, that reports less gets no more weight. Of an unknown radio the limit is
    the scatter of its measurements, if that is less."""
    bearing_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] = 2.0
    """Thermal noise of a bearing, in the same way."""
    use_reported_sigma: bool = True
    """True: the radio's own standard deviations are used where they are larger than the above."""
    range_k_long: Positive | None = 1.5
    """Threshold for ranges that are too long, in sigma; null: quadratic loss on that side."""
    range_k_short: Positive | None = None
    """Threshold for ranges that are too short; null: the paper's one-sided loss."""
    bearing_k: Positive | None = 1.5
    """Threshold for bearings and elevations on both sides; null: quadratic loss."""
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
    """Quantisation step of ranges, as with a cell's timing advance; 0: none."""
    range_scale_sigma: NonNegative = 0.0
    """Prior standard deviation of the range's scale error; 0: no scale error."""
    range_scale_max: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.5
    """Hard bound of the scale error, to both sides."""
    power_at_1m_dbm: Annotated[float, msgspec.Meta(ge=-174.0, le=60.0)] | None = None
    """Prior mean of the received power 1 m from the emitter, known to 10 dB; null: unknown, and
    power is used only for an emitter that at first provides nothing else."""
    reach_m: Positive | None = None
    """Reach of this radio, as the standard deviation per axis of the target about the path; null:
    unlimited."""
    place_range_sigma_m: NonNegative = 0.0
    """Spatially correlated part of a range's error, before it is measured; 0: none is assumed until
    errors are seen to repeat."""
    place_bearing_sigma_deg: NonNegative = 0.0
    """Spatially correlated part of a bearing's error, in the same way."""
    place_length_m: Positive = 4.0
    """Correlation length of those errors, before it is measured."""
    position_sigma_m: Positive = 30.0
    """Prior standard deviation of the first position, each axis."""
    own_position_sigma_m: NonNegative = 0.1
    """Standard deviation of the vehicle position; part of every measurement's noise, and of R95
    until the drift is known."""
    process_noise_m_per_sqrt_s: NonNegative = 0.0
    """Random walk of the target in the vehicle's frame: of itself, or by drift of the vehicle
    position; 0: it is stationary."""
    stamp_lag_sigma_s: NonNegative | None = None
    """Standard deviation of the delay of the radio's stamps; null: 0 with a configured antenna,
    else 0.15 s."""
    target_height_m: Signed = 0.0
    """Height of the emitter above the local origin."""
    target_height_sigma_m: NonNegative = 0.0
    """Standard deviation of that height; above 0 it is estimated."""
    antenna: AntennaParams = AntennaParams()
    """Antenna that measures the bearing."""

    def __post_init__(self) -> None:
        """Reject bounds that exclude every value."""
        low, high = self.range_offset_min_m, self.range_offset_max_m
        if low is not None and high is not None and low >= high:
            raise ValueError("range_offset_min_m must be below range_offset_max_m")

    def params(self) -> FilterParams:
        """Return the parameters of a filter with these assumptions."""
        return FilterParams(**msgspec.structs.asdict(self))


class FilterParams(FilterConfig, frozen=True, dict=True):
    """Parameters of a filter: those of a file, and those that only studies vary.

    The derived arrays for the kernels are cached; they must not be written to.
    """

    elevation_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] = 5.0
    """Thermal noise of an elevation where the radio reports none, and the lower limit of a reported
    one."""
    use_elevation: bool = True
    """False: measured elevations are ignored."""
    range_scale_min: Annotated[float, msgspec.Meta(gt=-1.0, le=0.0)] | None = None
    """Hard lower bound of the scale error, where it differs; 0: ranges are never too short."""
    stamp_lag_s: NonNegative = 0.0
    """Delay of the radio's stamps after the measurement."""
    power_at_1m_sigma_db: Positive = 10.0
    """Prior standard deviation of the power at 1 m: transmit power and gains of both antennas."""
    near_target_terms: bool = True
    """True: variances contain the second-order terms of the measurement model, without which the
    filter diverges near the target."""

    def params(self) -> FilterParams:
        """Return these parameters."""
        return self

    @cached_property
    def model(self) -> RangingModel:
        """Constants of the measurement model and of the state's layout, for the kernels."""
        has_scale, has_height = self.range_scale_sigma > 0.0, self.target_height_sigma_m > 0.0
        has_power = self.power_at_1m_dbm is not None
        return RangingModel(
            height_m=self.target_height_m,
            height_index=4 + has_scale if has_height else ABSENT,
            scale_index=4 if has_scale else ABSENT,
            own_sigma_m=self.own_position_sigma_m,
            near_target_terms=self.near_target_terms,
            antenna=MODELS[self.antenna.kind],
            power_index=4 + has_scale + has_height if has_power else ABSENT,
        )

    @property
    def with_power(self) -> FilterParams:
        """The same assumptions for an emitter that gives power alone; itself if configured."""
        if self.power_at_1m_dbm is not None:
            return self
        # -59 dBm of a Bluetooth beacon of 0 dBm to -11 dBm of a LoRa module of 20 dBm at 868 MHz
        return msgspec.structs.replace(self, power_at_1m_dbm=-40.0, power_at_1m_sigma_db=15.0)

    @cached_property
    def step_sigma_m(self) -> float:
        """Standard deviation of the quantisation error, uniform within a step of the ranges."""
        return self.range_step_m / math.sqrt(12.0)

    @property
    def spatial_sigmas(self) -> tuple[float, float]:
        """Spatially correlated sigmas of a range and a bearing, metres and radians.

        The quantisation error of a range is part of them: it repeats within the same step.
        """
        range_m = math.hypot(self.place_range_sigma_m, self.step_sigma_m)
        return range_m, math.radians(self.place_bearing_sigma_deg)

    @property
    def range_length_m(self) -> float:
        """Correlation length of range errors: at least half a step, the mean way out of it."""
        return max(self.place_length_m, 0.5 * self.range_step_m)

    @property
    def prior(self) -> tuple[Vector, Vector]:
        """Prior mean and standard deviations of the state, each (n,), as new arrays."""
        offset_m = self.range_offset_m
        if self.range_offset_min_m is not None:
            offset_m = max(offset_m, self.range_offset_min_m)
        if self.range_offset_max_m is not None:
            offset_m = min(offset_m, self.range_offset_max_m)
        position_m = self.position_sigma_m
        bearing_rad = math.radians(self.bearing_offset_sigma_deg)
        mean = [0.0, 0.0, offset_m, 0.0]
        sigmas = [position_m, position_m, self.range_offset_sigma_m, bearing_rad]
        if self.range_scale_sigma > 0.0:
            mean.append(0.0)
            sigmas.append(self.range_scale_sigma)
        if self.target_height_sigma_m > 0.0:
            mean.append(self.target_height_m)
            sigmas.append(self.target_height_sigma_m)
        if self.power_at_1m_dbm is not None:
            mean += [self.power_at_1m_dbm, EXPONENT]
            sigmas += [self.power_at_1m_sigma_db, 0.4]  # the exponent is 2 to 3.5
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
        if model.power_index != ABSENT:
            # Rappaport, table 4.2: a corridor in sight, and an obstructed building
            bounds[:, model.power_index + 1] = 1.6, 6.0
        return bounds

    @cached_property
    def thresholds(self) -> Matrix:
        """Thresholds of positive and negative innovations of each modality, (m, 2), in sigma.

        A weak signal is as little evidence as a long range.
        """
        angle = threshold(self.bearing_k)
        ranges = (threshold(self.range_k_long), threshold(self.range_k_short))
        all_rows = np.array([ranges, (angle, angle), (angle, angle), ranges[::-1]])
        return all_rows[: rows_of(self.model)]

    def kernel_row(self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu) -> Vector:
        """Return a measurement as a row for the kernels, (10 to 19,), see `map_kernels`.

        Its time is in place of the sequence number.
        """
        m = measurement
        axes: tuple[float, ...] = ()
        has_elevation = self.use_elevation and not m.is_array_angle
        angles = (m.bearing_enu_rad, m.elevation_rad if has_elevation else None)
        if self.model.antenna != AZIMUTH:
            angles, axes = (None, None), (0.0,) * 6  # no axes without a direction
            if m.array is None and m.bearing_enu_rad is not None and self.model.antenna == PLANAR:
                # a north-referenced bearing is treated as that of a level array
                angles, axes = (-m.bearing_enu_rad, None), (*LEVEL[0], *LEVEL[1])
            elif m.array is not None:
                angles = (m.array.first, m.array.second)
                axes = (*m.array.first_axis_enu, *m.array.second_axis_enu)
        has_power = self.model.power_index != ABSENT
        power = (m.power_dbm, POWER_TOTAL_SIGMA_DB, 1.0) if has_power else ()
        sigmas = self.effective_sigmas(m)
        numbers = (*sensor_enu_m, m.range_m, *angles, *sigmas, m.measured_at_s, *axes, *power)
        return np.array(numbers, dtype=float)  # None becomes NaN

    def effective_sigmas(self, measurement: RangingMeasurement) -> tuple[float, float, float]:
        """Return the standard deviations of range, bearing and elevation that are used.

        A range's is at least its quantisation error, and a reported one at least the configured
        one.
        """
        m, configured = measurement, self.configured_sigmas
        reported = (m.range_sigma_m, m.bearing_sigma_rad, m.elevation_sigma_rad)
        if not self.use_reported_sigma or reported == (None, None, None):
            return configured
        used = []
        largest = (MAX_SETTING, math.pi, math.pi)  # half a turn is no information about a direction
        rounding = 2.0**-23  # of float32: a configured sigma may be reported this much smaller
        for sigma, least, most, own in zip(
            reported, m.least_sigmas, largest, configured, strict=True
        ):
            lower = own if least is None else least
            if sigma is None:
                used.append(own)
            elif sigma < lower * (1.0 - rounding):
                used.append(lower)
            else:
                used.append(min(sigma, most))
        return (max(used[0], self.step_sigma_m), used[1], used[2])

    @cached_property
    def configured_sigmas(self) -> tuple[float, float, float]:
        """Standard deviations of range, bearing and elevation where the radio reports none."""
        bearing_rad = math.radians(self.bearing_sigma_deg)
        elevation_rad = math.radians(self.elevation_sigma_deg)
        if self.model.antenna == COSINES:  # one array measures both components alike
            elevation_rad = bearing_rad
        return max(self.range_sigma_m, self.step_sigma_m), bearing_rad, elevation_rad
