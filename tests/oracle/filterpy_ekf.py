"""filterpy's extended Kalman filter as the standard baseline.

Behind the companion's protocol prediction and update are filterpy's own (Joseph form, all rows at
once), with the companion's measurement model and variances; bounds and a bearing offset within half
a turn are applied to its result.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation import measurement_model
from companion.estimation.filters import kalman, target_filter
from companion.estimation.filters.target_filter import FilterState, ModalityReport
from companion.estimation.measurement_model import BEARING, MODALITIES
from companion.estimation.number_or_array import wrapped
from companion.estimation.window.map_kernels import argument_columns
from companion.kernel import Vector


class FilterpyEkf:
    """Extended Kalman filter of a library; thresholds in the params are ignored."""

    def __init__(self, params: target_filter.FilterParams) -> None:
        self.params = params
        self._model = params.model
        self._bounds = params.bounds

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """Return the state at `time_s`; the covariance grows by the random walk, if any."""
        ekf = self._filter(state, MODALITIES)
        q2_m2 = self.params.process_noise_m_per_sqrt_s**2 * max(time_s - state.time_s, 0.0)
        ekf.Q = np.zeros_like(ekf.P)
        moving = (measurement_model.EAST, measurement_model.NORTH, self._model.height_index)
        for index in moving:
            if index >= 0:
                ekf.Q[index, index] = q2_m2
        ekf.predict()
        return FilterState.of(max(time_s, state.time_s), ekf.x, ekf.P)

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: target_filter.Inflation = target_filter.NO_INFLATION,
    ) -> target_filter.UpdateReport:
        """Return the state after a measurement; see `TargetFilter.update`."""
        sensor = np.array(sensor_enu_m)
        row = self.params.kernel_row(measurement, sensor_enu_m)
        _, z, sigma = [row[columns] for columns in argument_columns(self.params.model)]
        rows = np.flatnonzero(~np.isnan(z)).tolist()
        late_s = max(state.time_s - measurement.measured_at_s, 0.0)
        noise = self._variances(state, sensor, sigma, late_s)
        effective = noise * np.array(inflation[: len(noise)])
        ekf = self._filter(state, len(rows))
        if rows:
            ekf.update(
                z[rows],
                HJacobian=lambda x: measurement_model.jacobian(x, sensor, self._model)[rows],
                Hx=lambda x: measurement_model.predicted(x, sensor, self._model)[rows],
                R=np.diag(effective[rows]),
                residual=partial(_residual, rows),
            )
        covariance = 0.5 * (ekf.P + ekf.P.T)
        mean = kalman.settled(ekf.x, covariance, self._bounds)
        is_sane = bool(kalman.is_positive_definite(mean, covariance))
        after = FilterState.of(state.time_s, mean, covariance) if is_sane else state
        ranged, borne, elevated = _reports(ekf, rows, noise, effective)
        nis = float(ekf.y @ ekf.SI @ ekf.y) if rows else 0.0
        return target_filter.UpdateReport(after, (ranged, borne, elevated), nis, is_sane)

    def _filter(self, state: FilterState, rows: int) -> Any:
        """Return the library's filter at a state, for a number of rows."""
        size = len(state.mean)
        ekf = ExtendedKalmanFilter(dim_x=size, dim_z=max(rows, 1))
        ekf.x, ekf.P = np.array(state.mean), np.array(state.covariance)
        ekf.F = np.eye(size)
        return ekf

    def _variances(
        self, state: FilterState, sensor: Vector, sigma: Vector, late_s: float
    ) -> Vector:
        """Return the variances of all rows, (3,), as in the companion's filters, uninflated."""
        mean, model = state.mean, self._model
        noise: Vector = measurement_model.variances(state.covariance, mean, sensor, sigma, model)
        late_m2 = self.params.process_noise_m_per_sqrt_s**2 * late_s
        for row, partials in enumerate(measurement_model.jacobian(mean, sensor, model)):
            noise[row] += kalman.lateness_variance(partials, late_m2, model)
        return noise


def _residual(rows: list[int], z: Vector, expected: Vector) -> Vector:
    y = z - expected
    if BEARING in rows:
        index = rows.index(BEARING)
        y[index] = wrapped(float(y[index]))
    return y


def _reports(
    ekf: Any, rows: list[int], noise: Vector, effective: Vector
) -> list[ModalityReport | None]:
    """Report each modality given those before it; variances of shape (3,)."""
    reports: list[ModalityReport | None] = [None] * MODALITIES
    conditional = np.diag(np.linalg.cholesky(ekf.S)) ** 2 if rows else np.zeros(0)
    for index, row in enumerate(rows):
        variance, noise_sigma = float(conditional[index]), math.sqrt(noise[row])
        innovation = float(ekf.y[index])
        reports[row] = ModalityReport(
            innovation=innovation,
            innovation_variance=variance,
            noise_sigma=noise_sigma,
            whitened_innovation=innovation / noise_sigma,
            weight=1.0,
            prior_share=float((variance - effective[row]) / noise[row]),
        )
    return reports
