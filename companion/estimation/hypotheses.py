"""Hypotheses about the target's position: the first ones, pruning and merging, navigation jumps.

One range alone puts the target on a ring, one bearing alone on a ray, one power on rings. All are
covered by a small bank of Gaussians, each updated by the same filter and weighted by its (tempered)
likelihood. A straight track leaves two of them, mirror images of each other: the state is then
ambiguous, and both are kept. A range with a bearing needs only one.

When the vehicle's navigation jumps, hypotheses and measurements are shifted with it. Measurements
are relative to the vehicle, so the target, and every position that it was measured from, move by as
much as the reported position; bearings that are measured from the heading turn against it, and so
does their offset. Heights are not shifted here: the tracker keeps those from before a step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.domain import ArrayDirection, PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.estimation.measurement_model import (
    AZIMUTH,
    BEARING,
    BEARING_OFFSET,
    EAST,
    NORTH,
)
from companion.estimation.window.map_kernels import AXES, VALUES
from companion.estimation.window.rivals import IMPROBABLE_LOG_RATIO
from companion.geometry.coordinates import wrap_pi
from companion.geometry.polygons import Point
from companion.kernel import Matrix, Vector
from companion.search.searched_area import SearchPrior

RING_COUNT = 24
"""First hypotheses on the ring of a range: one every 15 degrees, two of their sigmas apart."""
RAY_DISTANCES_M = tuple(3.0 * 1.8**index for index in range(RING_COUNT // 3))
"""Distances of the hypotheses along a bearing, metres: from 3 m, nearer than which a direction is
hardly flown past, to 184 m. With a radial sigma of 0.35 of the distance they overlap."""
AMBIGUOUS_PROBABILITY = 0.05
"""Probability of a second hypothesis above which the estimate is ambiguous: R95 leaves out 5 %."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One position where the target may be, with its log-likelihood up to a constant."""

    log_weight: float
    state: FilterState
    least_covariance_m2: Matrix | None = None
    """Lower limit of the position covariance, (2, 2), from the window; None: no limit."""
    log_prior: float = 0.0
    """Log of the prior probability of its position, up to a constant; `log_weight` is of
    measurements alone."""

    @property
    def position_enu_m(self) -> Point:
        """East and north of the mean."""
        return (float(self.state.mean[0]), float(self.state.mean[1]))


def first_hypotheses(
    measurement: RangingMeasurement,
    sensor_enu_m: PositionEnu,
    filter_params: FilterParams,
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses that a target's first measurement gives rise to."""
    range_m, power_dbm = measurement.range_m, measurement.power_dbm
    if range_m is None and not measurement.has_direction and power_dbm is not None:
        polar = _on_rings(sensor_enu_m, power_dbm, filter_params)
    elif range_m is None:
        polar = [
            each
            for direction_rad in _directions_rad(measurement)
            for each in _along_ray(direction_rad, filter_params)
        ]
    else:
        rise_m = sensor_enu_m[2] - filter_params.target_height_m
        ground_m = math.sqrt(max(range_m**2 - rise_m**2, 1.0))
        if measurement.bearing_enu_rad is None:
            polar = _on_ring(ground_m, filter_params)
        else:
            covariance = np.eye(2) * filter_params.position_sigma_m**2
            directions_rad = _directions_rad(measurement)
            polar = [(direction_rad, ground_m, covariance) for direction_rad in directions_rad]
    hypotheses = []
    for direction_rad, distance_m, position_covariance in polar:
        mean, sigmas = filter_params.prior
        mean[0] = sensor_enu_m[0] + distance_m * math.cos(direction_rad)
        mean[1] = sensor_enu_m[1] + distance_m * math.sin(direction_rad)
        P = np.diag(sigmas**2)
        P[:2, :2] = position_covariance
        hypotheses.append(Hypothesis(0.0, FilterState.of(measurement.measured_at_s, mean, P)))
    return tuple(hypotheses)


_Polar = list[tuple[float, float, Matrix]]
"""Direction from the sensor, ground distance, and position covariance (2, 2) of each hypothesis."""


def _directions_rad(measurement: RangingMeasurement) -> list[float]:
    """Return the horizontal directions that a measurement may mean, one or two.

    A line of antennas does not distinguish its two sides, nor a two-axis array front from back,
    unless one of them points into the sky.
    """
    array = measurement.array
    if array is not None and array.second is not None:
        return _before_and_behind_rad(array, array.second)
    if measurement.bearing_enu_rad is not None:
        return [measurement.bearing_enu_rad]
    assert array is not None
    east, north, _ = array.first_axis_enu
    level = max(math.hypot(east, north), 1e-6)
    aside_rad = math.acos(min(1.0, max(-1.0, array.first / level)))
    along_rad = math.atan2(north, east)
    return [along_rad - aside_rad, along_rad + aside_rad]


def _before_and_behind_rad(array: ArrayDirection, second: float) -> list[float]:
    first_axis, second_axis = np.array(array.first_axis_enu), np.array(array.second_axis_enu)
    seen = array.first * first_axis + second * second_axis
    ahead = math.sqrt(max(0.0, 1.0 - array.first**2 - second**2)) * np.cross(
        second_axis, first_axis
    )
    pointed = [(seen + ahead).tolist(), (seen - ahead).tolist()]
    below = [direction for direction in pointed if direction[2] <= 0.0]
    return [math.atan2(north, east) for east, north, _ in below or pointed]


def _on_ring(ground_m: float, params: FilterParams) -> _Polar:
    radial_m = math.hypot(params.range_offset_sigma_m, params.range_sigma_m, 0.25 * ground_m)
    across_m = math.pi * ground_m / RING_COUNT
    directions_rad = [2.0 * math.pi * index / RING_COUNT for index in range(RING_COUNT)]
    return [
        (direction_rad, ground_m, _polar_covariance(direction_rad, radial_m, across_m))
        for direction_rad in directions_rad
    ]


def distance_by_power_m(power_dbm: float, params: FilterParams) -> float:
    """Return the slant range at which the prior expects a power, metres, at most 1 km."""
    mean, index = params.prior[0], params.model.power_index
    decades = float(mean[index] - power_dbm) / (10.0 * float(mean[index + 1]))
    return math.pow(10.0, min(max(decades, 0.0), 3.0))


def _on_rings(sensor_enu_m: PositionEnu, power_dbm: float, params: FilterParams) -> _Polar:
    """Return the positions about the prior distance, which is known to a factor of three."""
    rise_m = sensor_enu_m[2] - params.target_height_m
    polar: _Polar = []
    ratios = 0.33, 1.0, 3.0  # 10 to 15 dB at an exponent of 2.75 are a factor of 2.3 to 3.5
    count = RING_COUNT // len(ratios)  # on each ring, two sigmas apart
    for ratio in ratios:
        slant_m = ratio * distance_by_power_m(power_dbm, params)
        ground_m = math.sqrt(max(slant_m**2 - rise_m**2, 1.0))
        across_m = math.pi * ground_m / count
        for index in range(count):
            turn_rad = 2.0 * math.pi * index / count
            covariance = _polar_covariance(turn_rad, 0.5 * ground_m, across_m)
            polar.append((turn_rad, ground_m, covariance))
    return polar


def _along_ray(bearing_rad: float, params: FilterParams) -> _Polar:
    sigma_rad = math.radians(
        math.hypot(params.bearing_offset_sigma_deg, 2 * params.bearing_sigma_deg)
    )
    return [
        (bearing_rad, far_m, _polar_covariance(bearing_rad, 0.35 * far_m, far_m * sigma_rad))
        for far_m in RAY_DISTANCES_M
    ]


def _polar_covariance(direction_rad: float, radial_sigma_m: float, across_sigma_m: float) -> Matrix:
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    axes = np.array([[c, -s], [s, c]])
    rotated: Matrix = axes @ np.diag([radial_sigma_m**2, across_sigma_m**2]) @ axes.T
    return rotated


def probabilities(hypotheses: Iterable[Hypothesis]) -> Vector:
    """Return the probabilities of the hypotheses, in order; their sum is 1.

    The prior counts until measurements alone have decided for one position: it never delays that.
    """
    hypotheses = tuple(hypotheses)
    if len(hypotheses) == 1:
        return np.ones(1)
    return _normalised(_logs(hypotheses))


def _logs(hypotheses: Sequence[Hypothesis]) -> list[float]:
    measured = [h.log_weight for h in hypotheses]
    if not any(h.log_prior for h in hypotheses):
        return measured
    if np.count_nonzero(_normalised(measured) >= AMBIGUOUS_PROBABILITY) == 1:
        return measured
    return [h.log_weight + h.log_prior for h in hypotheses]


def _normalised(logs: Sequence[float]) -> Vector:
    weights: Vector = np.exp(np.array(logs) - max(logs))
    normalised: Vector = weights / weights.sum()
    return normalised


def ranked(
    hypotheses: Iterable[Hypothesis], prior: SearchPrior | None = None
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses best first, with the prior of their positions."""
    unranked = tuple(hypotheses)
    if prior is not None and len(unranked) > 1:
        unranked = tuple(replace(h, log_prior=prior.log_at(h.position_enu_m)) for h in unranked)
    logs = _logs(unranked)
    return tuple(unranked[i] for i in sorted(range(len(unranked)), key=lambda i: -logs[i]))


def consolidated(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Return the hypotheses best first, the improbable ones dropped and close ones merged."""
    ordered = sorted(hypotheses, key=lambda h: -h.log_weight)
    best = ordered[0].log_weight
    kept: list[Hypothesis] = []
    for candidate in ordered:
        log_weight = candidate.log_weight - best
        if log_weight < IMPROBABLE_LOG_RATIO:
            break
        for index, other in enumerate(kept):
            # within 2 sigma it is the same optimum; more would merge mirror images: with 1 or 4,
            # R95 of recorded walks changes by up to 3 %, and with 4 that of a flight by 15 %
            if _distance2(candidate.state, other.state) < 2.0**2:
                kept[index] = _merged(other, replace(candidate, log_weight=log_weight))
                break
        else:
            kept.append(replace(candidate, log_weight=log_weight))
    return ranked(kept)


def _merged(better: Hypothesis, other: Hypothesis) -> Hypothesis:
    """Return two hypotheses as one at the better position, with the probability of both.

    Of a window's two covariances it has the mixture's second moment about that position, so that
    R95 still contains the other position with its probability.
    """
    log_weight = float(np.logaddexp(better.log_weight, other.log_weight))
    here_m2, there_m2 = better.least_covariance_m2, other.least_covariance_m2
    if here_m2 is not None and there_m2 is not None:
        share = math.exp(other.log_weight - log_weight)
        away = other.state.mean[:2] - better.state.mean[:2]
        here_m2 = here_m2 + share * (there_m2 + np.outer(away, away) - here_m2)
    return replace(better, log_weight=log_weight, least_covariance_m2=here_m2)


def _distance2(a: FilterState, b: FilterState) -> float:
    """Return the squared Mahalanobis distance of two positions under their summed covariance."""
    difference = a.mean[:2] - b.mean[:2]
    (ee, en), (_, nn) = (a.covariance[:2, :2] + b.covariance[:2, :2]).tolist()
    e, n = difference.tolist()
    return float((nn * e * e - 2.0 * en * e * n + ee * n * n) / (ee * nn - en * en))


def state_step(params: FilterParams, shift_en_m: Point, turn_rad: float) -> Vector:
    """Return the change of a state (n,) in a jump; `turn_rad` counts counter-clockwise."""
    step = np.zeros(len(params.prior[0]))
    step[EAST], step[NORTH], step[BEARING_OFFSET] = *shift_en_m, turn_rad
    return step


def shift_hypothesis(hypothesis: Hypothesis, step: Vector, sigma_m: float) -> Hypothesis:
    """Return the hypothesis after a jump whose size is known to `sigma_m` per axis."""
    state = hypothesis.state
    mean = state.mean + step
    mean[BEARING_OFFSET] = wrap_pi(float(mean[BEARING_OFFSET]))
    added_variance = np.where(step == 0.0, 0.0, sigma_m**2)
    if step[BEARING_OFFSET] != 0.0:
        # a compass that jumps is as vague afterwards as a bearing
        added_variance[BEARING_OFFSET] = math.radians(2.0) ** 2
    covariance = state.covariance + np.diag(added_variance)
    return replace(hypothesis, state=FilterState.of(state.time_s, mean, covariance))


def shift_rows(rows: Matrix, shift_en_m: Point, step: Vector, params: FilterParams) -> Matrix:
    """Return measurements as they would have been made after a jump, of the same shape."""
    after = np.array(rows)
    after[:, :2] += shift_en_m
    if params.model.antenna == AZIMUTH:
        after[:, VALUES + BEARING] += step[BEARING_OFFSET]
        return after
    c, s = math.cos(step[BEARING_OFFSET]), math.sin(step[BEARING_OFFSET])
    for axis in (AXES, AXES + 3):
        east, north = after[:, axis].copy(), after[:, axis + 1].copy()
        after[:, axis], after[:, axis + 1] = c * east - s * north, s * east + c * north
    return after
