"""AsymmetricHuberEKF: an extended Kalman filter with the one-sided Huber loss on ranges.

With whitened innovations u = y / sqrt(R) and the weights w(u) of `losses`, the update is

    R_eff = R / w                            the same R_eff in S, K and the Joseph form
    S     = H P H^T + R_eff
    K     = P H^T S^-1
    x    <- x + K y
    P    <- (I - K H) P (I - K H)^T + K R_eff K^T

Range and bearing have independent noise, so the joint update is done one row after the other with
both rows linearised at the same prior mean, which is the same thing without a matrix inverse.

Paper: eqs. (7) to (9), used recursively. Deviations: the range is slant; R contains the
second-order terms and the vehicle's own position uncertainty (`models.ranging_model`), without
which the filter diverges near the target and is over-confident right above it.
"""

from __future__ import annotations

import math

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.base import FilterParams, FilterState, ModalityReport, UpdateReport
from companion.estimation.losses import asymmetric_huber_weight, threshold
from companion.geometry.arrays import Matrix, Vector, frozen
from companion.geometry.frames import wrap_pi
from companion.kernel import kernel
from companion.models.ranging_model import (
    BEARING_OFFSET,
    RANGE_OFFSET,
    bearing_jacobian,
    bearing_variance,
    predicted_bearing,
    predicted_range,
    range_jacobian,
    range_variance,
)


@kernel
def scalar_update(
    mean: Vector, P: Matrix, H: Vector, innovation: float, R: float
) -> tuple[Vector, Matrix, float]:
    """One measurement row in Joseph form.

    Args:
        mean: (n,).
        P: (n, n), symmetric positive definite.
        H: (n,) row of partials.
        innovation: z - h, with respect to `mean`.
        R: Effective variance.

    Returns:
        The new mean and covariance, and the innovation variance S.
    """
    PH = P @ H
    S = float(H @ PH) + R
    K = PH / S
    A = np.eye(mean.size) - np.outer(K, H)
    updated = A @ P @ A.T + np.outer(K, K) * R
    return mean + K * innovation, 0.5 * (updated + updated.T), S


@kernel
def bound_component(mean: Vector, P: Matrix, index: int, value: float) -> Vector:
    """The most probable mean whose component `index` equals `value` (estimate projection)."""
    shifted: Vector = mean + P[:, index] * ((value - mean[index]) / P[index, index])
    return shifted


class AsymmetricHuberEkf:
    """The filter of the paper over [east, north, range offset, bearing offset].

    Args:
        params: Noise, thresholds and priors.
    """

    def __init__(self, params: FilterParams) -> None:
        self.params = params
        self._k_range = (threshold(params.range_k_long), threshold(params.range_k_short))
        self._k_bearing = (threshold(params.bearing_k), threshold(params.bearing_k))

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at `time_s`; the covariance grows by the random walk, if any."""
        q = self.params.process_noise_m_per_sqrt_s
        dt_s = time_s - state.time_s
        if q == 0.0 or dt_s <= 0.0:
            return FilterState(max(time_s, state.time_s), state.mean, state.covariance)
        P = np.array(state.covariance)
        P[0, 0] += q * q * dt_s
        P[1, 1] += q * q * dt_s
        return FilterState(time_s, state.mean, frozen(P))

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: tuple[float, float] = (1.0, 1.0),
    ) -> UpdateReport:
        """The state after a measurement; see `TargetFilter.update`."""
        prior, P = state.mean, state.covariance
        sensor = np.array(sensor_enu_m)
        mean: Vector = prior
        nis = 0.0
        range_report = bearing_report = None
        if measurement.range_m is not None:
            H, y, R = self._range_row(prior, P, sensor, measurement)
            mean, P, range_report, term = _robust_row(
                prior, mean, P, H, y, R, self._k_range, inflation[0]
            )
            nis += term
        if measurement.bearing_enu_rad is not None:
            H, y, R = self._bearing_row(prior, state.covariance, sensor, measurement)
            mean, P, bearing_report, term = _robust_row(
                prior, mean, P, H, y, R, self._k_bearing, inflation[1]
            )
            nis += term
        mean = self._within_bounds(mean, P)
        if not _is_positive_definite(mean, P):
            return UpdateReport(state, range_report, bearing_report, nis, False)
        updated = FilterState(state.time_s, frozen(mean), frozen(P))
        return UpdateReport(updated, range_report, bearing_report, nis, True)

    def range_sigma_m(self, measurement: RangingMeasurement) -> float:
        """The thermal noise that a range is taken to have."""
        reported = measurement.range_sigma_m
        if self.params.use_reported_sigma and reported is not None:
            return reported
        return self.params.range_sigma_m

    def bearing_sigma_rad(self, measurement: RangingMeasurement) -> float:
        """The thermal noise that a bearing is taken to have."""
        reported = measurement.bearing_sigma_rad
        if self.params.use_reported_sigma and reported is not None:
            return reported
        return math.radians(self.params.bearing_sigma_deg)

    def _range_row(
        self, prior: Vector, P: Matrix, sensor: Vector, measurement: RangingMeasurement
    ) -> tuple[Vector, float, float]:
        p = self.params
        assert measurement.range_m is not None
        H = range_jacobian(prior, sensor, p.target_height_m)
        y = measurement.range_m - predicted_range(prior, sensor, p.target_height_m)
        R = range_variance(
            P,
            prior,
            sensor,
            p.target_height_m,
            self.range_sigma_m(measurement),
            p.own_position_sigma_m,
            p.near_target_terms,
        )
        return H, y, R

    def _bearing_row(
        self, prior: Vector, P: Matrix, sensor: Vector, measurement: RangingMeasurement
    ) -> tuple[Vector, float, float]:
        p = self.params
        assert measurement.bearing_enu_rad is not None
        H = bearing_jacobian(prior, sensor)
        y = wrap_pi(measurement.bearing_enu_rad - predicted_bearing(prior, sensor))
        R = bearing_variance(
            P,
            prior,
            sensor,
            self.bearing_sigma_rad(measurement),
            p.own_position_sigma_m,
            p.near_target_terms,
        )
        return H, y, R

    def _within_bounds(self, mean: Vector, P: Matrix) -> Vector:
        low, high = self.params.range_offset_min_m, self.params.range_offset_max_m
        if low is not None and mean[RANGE_OFFSET] < low:
            mean = bound_component(mean, P, RANGE_OFFSET, low)
        if high is not None and mean[RANGE_OFFSET] > high:
            mean = bound_component(mean, P, RANGE_OFFSET, high)
        if abs(mean[BEARING_OFFSET]) > math.pi:
            mean = np.array(mean)
            mean[BEARING_OFFSET] = wrap_pi(mean[BEARING_OFFSET])
        return mean


def _robust_row(
    prior: Vector,
    mean: Vector,
    P: Matrix,
    H: Vector,
    innovation: float,
    R: float,
    thresholds: tuple[float, float],
    inflation: float,
) -> tuple[Vector, Matrix, ModalityReport, float]:
    """Weigh and apply one row linearised at `prior`, after earlier rows led to `mean` and `P`."""
    sigma = math.sqrt(R)
    weight = asymmetric_huber_weight(innovation / sigma, *thresholds)
    remaining = innovation - float(H @ (mean - prior))
    prior_share = float(H @ P @ H) / R
    mean, P, S = scalar_update(mean, P, H, remaining, inflation * R / weight)
    report = ModalityReport(
        innovation=innovation,
        innovation_variance=float(S),
        noise_sigma=sigma,
        whitened_innovation=innovation / sigma,
        weight=weight,
        prior_share=prior_share,
    )
    return mean, P, report, remaining * remaining / float(S)


def _is_positive_definite(mean: Vector, P: Matrix) -> bool:
    if not (np.isfinite(mean).all() and np.isfinite(P).all()):
        return False
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True
