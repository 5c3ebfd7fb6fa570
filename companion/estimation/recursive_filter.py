"""What the recursive filters share: prediction, and the update with one weight per modality."""

from __future__ import annotations

import math

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.base import (
    NO_INFLATION,
    FilterState,
    Inflation,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.filter_params import FilterParams
from companion.estimation.robust_update import robust_update
from companion.geometry.arrays import Matrix, Vector, frozen

KernelResult = tuple[Vector, Matrix, Matrix, bool]
"""Mean, covariance, report and whether they are sane, as the update kernels return them."""


class RecursiveFilter:
    """An extended Kalman filter whose rows are weighed by the params' thresholds.

    Args:
        params: Noise, thresholds, priors and bounds.
    """

    def __init__(self, params: FilterParams) -> None:
        self.params = params
        self._model = params.model
        self._bounds = params.bounds
        self._thresholds = params.thresholds

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at `time_s`; the covariance grows by the random walk, if any."""
        q = self.params.process_noise_m_per_sqrt_s
        dt_s = time_s - state.time_s
        if q == 0.0 or dt_s <= 0.0:
            return FilterState(max(time_s, state.time_s), state.mean, state.covariance)
        P = np.array(state.covariance)
        for index in (0, 1, self._model.height_index):
            if index >= 0:
                P[index, index] += q * q * dt_s
        return FilterState(time_s, state.mean, frozen(P))

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        """The state after a measurement; see `TargetFilter.update`.

        A late measurement of a target that walks is fused where the sensor was at its time; the
        walk since then is noise of it. (Its correlation with the state's own error is left out,
        which makes the filter a little more careful than it had to be.)
        """
        late_s = max(state.time_s - measurement.measured_at_s, 0.0)
        late_m2 = self.params.process_noise_m_per_sqrt_s**2 * late_s
        z, sigma = self.params.seen(measurement)
        mean, P, rows, is_sane = self._updated(
            state, np.array(sensor_enu_m), z, sigma, late_m2, np.array(inflation)
        )
        if is_sane:
            state = FilterState(state.time_s, frozen(mean), frozen(P))
        ranged, borne, elevated = (ModalityReport.of_row(row[:-1]) for row in rows)
        nis = sum(share for share in rows[:, -1].tolist() if not math.isnan(share))
        return UpdateReport(state, ranged, borne, elevated, nis, is_sane)

    def _updated(
        self,
        state: FilterState,
        sensor: Vector,
        z: Vector,
        sigma: Vector,
        late_m2: float,
        inflation: Vector,
    ) -> KernelResult:
        return robust_update(
            state.mean,
            state.covariance,
            sensor,
            z,
            sigma,
            late_m2,
            inflation,
            self._thresholds,
            self._bounds,
            self._model,
        )
