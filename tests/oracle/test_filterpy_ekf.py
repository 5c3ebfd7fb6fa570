"""The filter without its robustness against filterpy's extended Kalman filter."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.asymmetric_huber_ekf import AsymmetricHuberEkf
from companion.estimation.base import FilterParams, FilterState
from companion.geometry.arrays import Matrix, Vector

RANGE_SIGMA_M = 1.5
BEARING_SIGMA_RAD = math.radians(2.0)
TARGET_HEIGHT_M = 1.2


def _plain_params(process_noise: float) -> FilterParams:
    return FilterParams(
        range_k_long=None,
        range_k_short=None,
        bearing_k=None,
        own_position_sigma_m=0.0,
        near_target_terms=False,
        process_noise_m_per_sqrt_s=process_noise,
        target_height_m=TARGET_HEIGHT_M,
    )


def _model(mean: Vector, sensor_enu_m: PositionEnu) -> tuple[Vector, Matrix]:
    """Range and bearing with their partials, written down a second time."""
    east, north = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    slant = math.sqrt(east**2 + north**2 + (TARGET_HEIGHT_M - sensor_enu_m[2]) ** 2)
    ground2 = east**2 + north**2
    predicted = np.array([slant + mean[2], math.atan2(north, east) + mean[3]])
    partials = np.array(
        [
            [east / slant, north / slant, 1.0, 0.0],
            [-north / ground2, east / ground2, 0.0, 1.0],
        ]
    )
    return predicted, partials


def _wrapped_residual(rows: list[int]) -> Any:
    def residual(z: Vector, predicted: Vector) -> Vector:
        y: Vector = z - predicted
        for index, row in enumerate(rows):
            if row == 1:
                y[index] = (y[index] + math.pi) % (2.0 * math.pi) - math.pi
        return y

    return residual


def _oracle(state: FilterState) -> Any:
    ekf = ExtendedKalmanFilter(dim_x=4, dim_z=2)
    ekf.x = np.array(state.mean)
    ekf.P = np.array(state.covariance)
    ekf.F = np.eye(4)
    return ekf


def _oracle_step(
    ekf: Any, z: Vector, rows: list[int], sensor_enu_m: PositionEnu, q2dt: float
) -> None:
    ekf.Q = np.diag([q2dt, q2dt, 0.0, 0.0])
    ekf.predict()
    R = np.diag([RANGE_SIGMA_M**2, BEARING_SIGMA_RAD**2])[np.ix_(rows, rows)]
    ekf.update(
        z,
        HJacobian=lambda x: _model(x, sensor_enu_m)[1][rows],
        Hx=lambda x: _model(x, sensor_enu_m)[0][rows],
        R=R,
        residual=_wrapped_residual(rows),
    )


def _walk(rng: np.random.Generator) -> Iterator[tuple[float, PositionEnu, Vector]]:
    """Times, places and noisy range and bearing (wrapped) about a target at the origin."""
    time_s, angle = 0.0, rng.uniform(-math.pi, math.pi)
    while True:
        time_s += rng.uniform(0.05, 2.0)
        angle += rng.uniform(-0.5, 0.8)
        ground_m = rng.uniform(15.0, 80.0)
        place = (ground_m * math.cos(angle), ground_m * math.sin(angle), rng.uniform(5.0, 30.0))
        predicted, _ = _model(np.zeros(4), place)
        z = predicted + rng.normal(size=2) * [RANGE_SIGMA_M, BEARING_SIGMA_RAD]
        yield time_s, place, np.array([z[0], math.remainder(z[1], 2.0 * math.pi)])


def _measurement(time_s: float, z: Vector, rows: list[int]) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=float(z[0]) if 0 in rows else None,
        bearing_enu_rad=float(z[1]) if 1 in rows else None,
    )


@pytest.mark.parametrize("rows", [[0, 1], [0], [1]], ids=["both", "range", "bearing"])
@pytest.mark.parametrize("process_noise", [0.0, 0.3])
def test_without_thresholds_the_filter_is_filterpys(rows: list[int], process_noise: float) -> None:
    params = _plain_params(process_noise)
    ours = AsymmetricHuberEkf(params)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(4, 4)) * np.array([[4.0], [4.0], [1.0], [0.05]])
        state = FilterState.of(
            0.0, rng.normal(size=4) * [5.0, 5.0, 1.0, 0.05], root @ root.T + 1e-3 * np.eye(4)
        )
        ekf = _oracle(state)
        walk = _walk(rng)
        for _ in range(40):
            time_s, place, z = next(walk)
            q2dt = process_noise**2 * (time_s - state.time_s)
            _oracle_step(ekf, z[rows], rows, place, q2dt)
            report = ours.update(ours.predict(state, time_s), _measurement(time_s, z, rows), place)
            assert report.is_positive_definite
            state = report.state
            wrapped = np.array([*ekf.x[:3], math.remainder(ekf.x[3], 2.0 * math.pi)])
            np.testing.assert_allclose(state.mean, wrapped, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(state.covariance, ekf.P, rtol=1e-9, atol=1e-9)


def test_the_nis_is_the_square_of_filterpys_mahalanobis_distance() -> None:
    ours = AsymmetricHuberEkf(_plain_params(0.0))
    state = FilterState.of(0.0, np.array([3.0, -2.0, 0.5, 0.02]), np.diag([9.0, 9.0, 4.0, 0.01]))
    ekf = _oracle(state)
    walk = _walk(np.random.default_rng(5))
    for _ in range(30):
        time_s, place, z = next(walk)
        _oracle_step(ekf, z, [0, 1], place, 0.0)
        report = ours.update(state, _measurement(time_s, z, [0, 1]), place)
        assert report.nis == pytest.approx(float(ekf.mahalanobis) ** 2, rel=1e-9)
        state = report.state
