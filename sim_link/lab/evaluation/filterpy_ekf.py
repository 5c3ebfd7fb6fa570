"""filterpy's extended Kalman filter as the baseline, and the check of our EKF against it.

filterpy's extended Kalman filter behind the companion's protocol: the standard baseline.

Prediction and update are filterpy's own (Joseph form, all rows at once). The measurement model and
its variances are the companion's, per call, so that the two filters believe the same; what filterpy
has no word for, bounds and a bearing offset within half a turn, is applied to its result.

Whether the EKF of the tables is filterpy's: both on the same measurements from the same places.

The compiled EKF flies. On its way, filterpy's filter takes in each measurement from the state that
the EKF was in, and the two results are compared. It is given the state each time, because an EKF
that has lost its target, and hovers where it believes it, multiplies a difference of rounding by
ten every 40 steps: two copies of filterpy's filter on two machines would part as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.robust_update import (
    is_positive_definite,
    lateness_variance,
    settled,
    wrapped,
)
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.measurement_model import (
    BEARING,
    EAST,
    MODALITIES,
    NORTH,
    jacobian,
    predicted,
    variances,
)
from companion.kernel import Matrix, Vector, kernel
from sim_link.lab.evaluation.campaign import run_trial, start_of
from sim_link.lab.evaluation.case import (
    TRUTH,
    Case,
    RunSeed,
    RunTruth,
    Scene,
    channel_draws,
    measured_in,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)
from sim_link.lab.evaluation.systems import System, belief_of
from sim_link.lab.evaluation.walk import RANGE_OFFSET, TARGET_EAST, Belief, first_fix, updated
from sim_link.world.environment import NO_MEMORY

Rows = list[int]
"""Which modalities were measured, in their order."""


class FilterpyEkf:
    """The EKF of a library; thresholds in the params do not count."""

    def __init__(self, params: FilterParams) -> None:
        self.params = params
        self._model = params.model
        self._bounds = params.bounds

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """The state at `time_s`; the covariance grows by the random walk, if any."""
        ekf = self._filter(state, MODALITIES)
        q2_m2 = self.params.process_noise_m_per_sqrt_s**2 * max(time_s - state.time_s, 0.0)
        ekf.Q = np.zeros_like(ekf.P)
        for index in (EAST, NORTH, self._model.height_index):
            if index >= 0:
                ekf.Q[index, index] = q2_m2
        ekf.predict()
        return FilterState.of(max(time_s, state.time_s), ekf.x, ekf.P)

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        """The state after a measurement; see `TargetFilter.update`."""
        sensor = np.array(sensor_enu_m)
        z, sigma = self.params.seen(measurement)
        rows = np.flatnonzero(~np.isnan(z)).tolist()
        late_s = max(state.time_s - measurement.measured_at_s, 0.0)
        noise = self._variances(state, sensor, sigma, late_s)
        effective = noise * np.array(inflation)
        ekf = self._filter(state, len(rows))
        if rows:
            ekf.update(
                z[rows],
                HJacobian=lambda x: jacobian(x, sensor, self._model)[rows],
                Hx=lambda x: predicted(x, sensor, self._model)[rows],
                R=np.diag(effective[rows]),
                residual=_residual_of(rows),
            )
        covariance = 0.5 * (ekf.P + ekf.P.T)
        mean = settled(ekf.x, covariance, self._bounds)
        is_sane = bool(is_positive_definite(mean, covariance))
        after = FilterState.of(state.time_s, mean, covariance) if is_sane else state
        ranged, borne, elevated = _reports(ekf, rows, noise, effective)
        nis = float(ekf.y @ ekf.SI @ ekf.y) if rows else 0.0
        return UpdateReport(after, ranged, borne, elevated, nis, is_sane)

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
        noise: Vector = variances(state.covariance, state.mean, sensor, sigma, self._model)
        late_m2 = self.params.process_noise_m_per_sqrt_s**2 * late_s
        for row, partials in enumerate(jacobian(state.mean, sensor, self._model)):
            noise[row] += lateness_variance(partials, late_m2, self._model)
        return noise


def _residual_of(rows: Rows) -> Callable[[Vector, Vector], Vector]:
    """Measured minus predicted, the bearing's wrapped."""

    def residual(z: Vector, expected: Vector) -> Vector:
        """The innovation, its bearing wrapped."""
        y = z - expected
        if BEARING in rows:
            index = rows.index(BEARING)
            y[index] = wrapped(float(y[index]))
        return y

    return residual


def _reports(ekf: Any, rows: Rows, noise: Vector, effective: Vector) -> list[ModalityReport | None]:
    """What each modality did, beside what those before it explained.

    Args:
        noise: (3,) variances.
        effective: (3,) the same with the inflation.
    """
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
class EkfCheck:
    """The first runs of an EKF cell, for filterpy to repeat."""

    case: Case
    system: System
    seed: int
    runs: int


class Replay(NamedTuple):
    """What a run's filter saw and believed, one row for each step."""

    z: Matrix
    """(steps, 3)"""
    means: Matrix
    """(steps + 1, 4) before the first measurement and after each."""
    covariances: Matrix
    """(steps + 1, 4, 4) the same."""


@kernel
def replayed(
    draws: Matrix,
    track_enu_m: Matrix,
    start_enu_m: Vector,
    truth: RunTruth,
    scene: Scene,
    b: Belief,
) -> Replay:
    """A run of a recursive filter along a given track.

    Args:
        draws: (steps, 6) of the channel.
        track_enu_m: (steps, 2).
        start_enu_m: (2,) place of the first estimate; NaN: from the first measurement.
    """
    steps, memory, sensor = draws.shape[0], NO_MEMORY, np.zeros(3)
    z, means = np.full((steps, 3), np.nan), np.empty((steps + 1, 4))
    covariances = np.empty((steps + 1, 4, 4))
    means[0], covariances[0] = first_fix(0.0, 0.0, 1.0, 0.0, b)
    means[0, :2] = start_enu_m
    for step in range(steps):
        sensor[:2] = track_enu_m[step]
        z[step, 0], z[step, 1], memory = measured_in(
            draws[step], sensor[0], sensor[1], truth, scene, memory
        )
        if math.isnan(means[step, 0]):
            fixed = first_fix(sensor[0], sensor[1], z[step, 0], z[step, 1], b)
            means[step + 1], covariances[step + 1] = fixed
        else:
            moved = updated(means[step], covariances[step], sensor, z[step], b)
            means[step + 1], covariances[step + 1] = moved
    return Replay(z, means, covariances)


def largest_difference_m(check: EkfCheck) -> float:
    """The largest difference of a coordinate or range offset after any step of the runs, metres."""
    seeds = run_seeds(check.seed, check.runs)
    return max(_difference_m(check.case, check.system, seed) for seed in seeds)


def _difference_m(case: Case, system: System, seed: RunSeed) -> float:
    """Between the two filters, or between the one that was compared and the one that flew."""
    ours = run_trial(case, system, seed)
    rng = stream(seed, TRUTH)
    truth, start, track = truth_of(case, rng), start_of(case, rng), ours.track_enu_m
    draws, scene, belief = channel_draws(case, seed), scene_of(case), belief_of(case, system)
    replay = replayed(draws, np.ascontiguousarray(track), start, truth, scene, belief)
    columns = slice(TARGET_EAST, RANGE_OFFSET + 1)
    of_replay = _largest(replay.means[1:, :3] - ours.record[:, columns])
    return max(of_replay, _largest(replay.means[1:, :3] - _theirs(case, track, replay)))


def _theirs(case: Case, track_enu_m: Matrix, replay: Replay) -> Matrix:
    """Coordinates and range offset of filterpy's filter after each measurement, (steps, 3)."""
    ekf = FilterpyEkf(case.belief)
    after = replay.means[1:, :3].copy()
    for step, (east_m, north_m) in enumerate(track_enu_m.tolist()):
        if math.isnan(replay.means[step, 0]):
            continue  # the first fix is no update
        range_m, bearing_rad = replay.z[step, :2].tolist()
        seen = RangingMeasurement(1, 0.0, range_m=range_m, bearing_enu_rad=bearing_rad)
        before = FilterState.of(0.0, replay.means[step], replay.covariances[step])
        after[step] = ekf.update(before, seen, (east_m, north_m, 0.0)).state.mean[:3]
    return after


def _largest(gaps: Matrix) -> float:
    return float(np.max(np.abs(gaps))) if np.isfinite(gaps).all() else math.inf
