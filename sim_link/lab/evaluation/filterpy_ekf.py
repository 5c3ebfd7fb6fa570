"""filterpy's extended Kalman filter as the standard baseline, and the check of our EKF against it.

Behind the companion's protocol prediction and update are filterpy's own (Joseph form, all rows at
once), with the companion's measurement model and variances; bounds and a bearing offset within half
a turn are applied to its result.

The check: the compiled EKF of the tables flies, and filterpy's filter takes in each measurement
from the state that the EKF was in. It is given the state each time, because an EKF that has lost
its target multiplies a difference of rounding by ten every 40 steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation import measurement_model
from companion.estimation.filters import robust_update, target_filter
from companion.estimation.filters.target_filter import FilterState, ModalityReport
from companion.estimation.measurement_model import BEARING, MODALITIES
from companion.kernel import Vector
from sim_link.lab.evaluation import case as cases
from sim_link.lab.evaluation.campaign import RunSeries, run_trial
from sim_link.lab.evaluation.case import Case, RunSeed
from sim_link.lab.evaluation.systems import System, belief_of
from sim_link.lab.evaluation.walk import RANGE_OFFSET, TARGET_EAST, first_fix, updated
from sim_link.world.environment import NO_MEMORY


class FilterpyEkf:
    """The EKF of a library; thresholds in the params do not count."""

    def __init__(self, params: target_filter.FilterParams) -> None:
        self.params = params
        self._model = params.model
        self._bounds = params.bounds

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at `time_s`; the covariance grows by the random walk, if any."""
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
        """The state after a measurement; see `TargetFilter.update`."""
        sensor = np.array(sensor_enu_m)
        _, z, sigma = self.params.seen(measurement, sensor_enu_m)
        rows = np.flatnonzero(~np.isnan(z)).tolist()
        late_s = max(state.time_s - measurement.measured_at_s, 0.0)
        noise = self._variances(state, sensor, sigma, late_s)
        effective = noise * np.array(inflation)
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
        mean = robust_update.settled(ekf.x, covariance, self._bounds)
        is_sane = bool(robust_update.is_positive_definite(mean, covariance))
        after = FilterState.of(state.time_s, mean, covariance) if is_sane else state
        ranged, borne, elevated = _reports(ekf, rows, noise, effective)
        nis = float(ekf.y @ ekf.SI @ ekf.y) if rows else 0.0
        return target_filter.UpdateReport(after, ranged, borne, elevated, nis, is_sane)

    def _filter(self, state: FilterState, rows: int) -> Any:
        """The library's filter at a state, for so many rows."""
        size = len(state.mean)
        ekf = ExtendedKalmanFilter(dim_x=size, dim_z=max(rows, 1))
        ekf.x, ekf.P = np.array(state.mean), np.array(state.covariance)
        ekf.F = np.eye(size)
        return ekf

    def _variances(
        self, state: FilterState, sensor: Vector, sigma: Vector, late_s: float
    ) -> Vector:
        """Of all three rows, (3,), as the companion's filters have them without inflation."""
        mean, model = state.mean, self._model
        noise: Vector = measurement_model.variances(state.covariance, mean, sensor, sigma, model)
        late_m2 = self.params.process_noise_m_per_sqrt_s**2 * late_s
        for row, partials in enumerate(measurement_model.jacobian(mean, sensor, model)):
            noise[row] += robust_update.lateness_variance(partials, late_m2, model)
        return noise


def _residual(rows: list[int], z: Vector, expected: Vector) -> Vector:
    y = z - expected
    if BEARING in rows:
        index = rows.index(BEARING)
        y[index] = robust_update.wrapped(float(y[index]))
    return y


def _reports(
    ekf: Any, rows: list[int], noise: Vector, effective: Vector
) -> list[ModalityReport | None]:
    """What each modality did, beside what those before it explained, by variances (3,)."""
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


CHECKED_RUNS = 2
"""Of every cell, from the first."""
LARGEST_DIFFERENCE_M = 1e-6


@dataclass(frozen=True, slots=True)
class EkfCheck(RunSeries):
    """The first runs of an EKF cell, for filterpy to repeat."""


def largest_difference_m(check: RunSeries) -> float:
    """The largest difference of a coordinate or range offset after any step of the runs, metres.

    Between the two filters, or between the one that was compared and the one that flew.
    """
    seeds = cases.run_seeds(check.seed, check.runs)
    gaps = [gap_m for seed in seeds for gap_m in _gaps_m(check.case, check.system, seed)]
    return max(gaps) if np.isfinite(gaps).all() else math.inf


def _gaps_m(case: Case, system: System, seed: RunSeed) -> list[float]:
    belief, scene, library = belief_of(case, system), cases.scene_of(case), FilterpyEkf(case.belief)
    draws, truth, start_enu_m = cases.run_inputs(case, seed)
    mean, covariance = first_fix(0.0, 0.0, 1.0, 0.0, belief)
    mean[:2] = start_enu_m
    z, memory = np.full(3, np.nan), NO_MEMORY
    gaps: list[float] = []
    for draw, flown in zip(draws, run_trial(case, system, seed).record, strict=True):
        east_m, north_m = flown[:2].tolist()
        z[0], z[1], memory = cases.measured_in(draw, east_m, north_m, truth, scene, memory)
        if math.isnan(mean[0]):  # the first fix is no update
            mean, covariance = first_fix(east_m, north_m, z[0], z[1], belief)
            theirs = mean
        else:
            range_m, bearing_rad = z[:2].tolist()
            seen = RangingMeasurement(1, 0.0, range_m=range_m, bearing_enu_rad=bearing_rad)
            before = FilterState.of(0.0, mean, covariance)
            theirs = library.update(before, seen, (east_m, north_m, 0.0)).state.mean
            sensor = np.array([east_m, north_m, 0.0])
            mean, covariance = updated(mean, covariance, sensor, z, belief)
        others = (theirs[:3], flown[TARGET_EAST : RANGE_OFFSET + 1])
        gaps += [float(np.max(np.abs(mean[:3] - other))) for other in others]
    return gaps
