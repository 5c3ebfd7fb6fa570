"""The filters without their robustness against filterpy's extended Kalman filter.

The measurement model is written down a second time here, in the plane and in space.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import AsymmetricHuberEkf, Ekf
from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.kernel import Matrix, Vector

RANGE_SIGMA_M = 1.5
BEARING_SIGMA_RAD = math.radians(2.0)
ELEVATION_SIGMA_RAD = math.radians(5.0)
SIGMAS = np.array([RANGE_SIGMA_M, BEARING_SIGMA_RAD, ELEVATION_SIGMA_RAD])
TARGET_HEIGHT_M = 1.2

PLANE = FilterParams(
    range_k_long=None,
    range_k_short=None,
    bearing_k=None,
    own_position_sigma_m=0.0,
    near_target_terms=False,
    target_height_m=TARGET_HEIGHT_M,
)
SPACE = msgspec.structs.replace(PLANE, range_scale_sigma=0.05, target_height_sigma_m=3.0)

Model = Callable[[Vector, PositionEnu], tuple[Vector, Matrix]]


def _plane(mean: Vector, sensor_enu_m: PositionEnu) -> tuple[Vector, Matrix]:
    """Range and bearing of a target of known height, with their partials."""
    east, north = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    slant = math.sqrt(east**2 + north**2 + (TARGET_HEIGHT_M - sensor_enu_m[2]) ** 2)
    ground2 = east**2 + north**2
    expected = np.array([slant + mean[2], math.atan2(north, east) + mean[3]])
    partials = np.array(
        [
            [east / slant, north / slant, 1.0, 0.0],
            [-north / ground2, east / ground2, 0.0, 1.0],
        ]
    )
    return expected, partials


def _space(mean: Vector, sensor_enu_m: PositionEnu) -> tuple[Vector, Matrix]:
    """Scaled range, azimuth and elevation, with their partials."""
    east, north = mean[0] - sensor_enu_m[0], mean[1] - sensor_enu_m[1]
    factor, up = 1.0 + mean[4], mean[5] - sensor_enu_m[2]
    ground = math.hypot(east, north)
    slant = math.hypot(ground, up)
    expected = np.array(
        [
            factor * slant + mean[2],
            math.atan2(north, east) + mean[3],
            math.asin(up / slant),
        ]
    )
    cosine, sine = ground / slant, up / slant
    partials = np.array(
        [
            [factor * east / slant, factor * north / slant, 1.0, 0.0, slant, factor * sine],
            [-north / ground**2, east / ground**2, 0.0, 1.0, 0.0, 0.0],
            [
                -east / ground * sine / slant,
                -north / ground * sine / slant,
                0,
                0,
                0,
                cosine / slant,
            ],
        ]
    )
    return expected, partials


@dataclass(frozen=True)
class Case:
    """A model and which of its rows are measured."""

    params: FilterParams
    model: Model
    rows: list[int]


CASES = {
    "range and bearing": Case(PLANE, _plane, [0, 1]),
    "range": Case(PLANE, _plane, [0]),
    "bearing": Case(PLANE, _plane, [1]),
    "range, bearing and elevation": Case(SPACE, _space, [0, 1, 2]),
    "range and elevation": Case(SPACE, _space, [0, 2]),
    "elevation": Case(SPACE, _space, [2]),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def _wrapped_residual(rows: list[int]) -> Any:
    def residual(z: Vector, expected: Vector) -> Vector:
        y: Vector = z - expected
        for index, row in enumerate(rows):
            if row == 1:
                y[index] = (y[index] + math.pi) % (2.0 * math.pi) - math.pi
        return y

    return residual


def _oracle(state: FilterState, case: Case) -> Any:
    ekf = ExtendedKalmanFilter(dim_x=state.mean.size, dim_z=len(case.rows))
    ekf.x = np.array(state.mean)
    ekf.P = np.array(state.covariance)
    ekf.F = np.eye(state.mean.size)
    return ekf


def _oracle_step(ekf: Any, z: Vector, case: Case, position: PositionEnu, q2dt: float) -> None:
    is_position = np.array([1, 1, 0, 0, 0, 1])[: ekf.x.size]
    ekf.Q = q2dt * np.diag(is_position)
    ekf.predict()
    ekf.update(
        z[case.rows],
        HJacobian=lambda x: case.model(x, position)[1][case.rows],
        Hx=lambda x: case.model(x, position)[0][case.rows],
        R=np.diag(SIGMAS[case.rows] ** 2),
        residual=_wrapped_residual(case.rows),
    )


def _first(case: Case, rng: np.random.Generator) -> FilterState:
    """A target near the origin, its components correlated."""
    sigmas = np.array([5.0, 5.0, 1.0, 0.05, 0.02, 2.0])[: case.params.prior[0].size]
    root = 0.8 * rng.normal(size=(sigmas.size, sigmas.size)) * sigmas[:, None]
    covariance = root @ root.T + 1e-3 * np.diag(sigmas**2)
    return FilterState.of(
        0.0, rng.normal(size=sigmas.size) * sigmas, 0.5 * (covariance + covariance.T)
    )


def _walk(rng: np.random.Generator, case: Case) -> Iterator[tuple[float, PositionEnu, Vector]]:
    """Yield times, positions and noisy measurements (wrapped) about a target at the origin."""
    time_s, angle = 0.0, rng.uniform(-math.pi, math.pi)
    truth = np.array(case.params.prior[0])
    while True:
        time_s += rng.uniform(0.05, 2.0)
        angle += rng.uniform(-0.5, 0.8)
        ground_m = rng.uniform(15.0, 80.0)
        position = (ground_m * math.cos(angle), ground_m * math.sin(angle), rng.uniform(5.0, 30.0))
        z, _ = case.model(truth, position)
        z += rng.normal(size=z.size) * SIGMAS[: z.size]
        z[1] = math.remainder(z[1], 2.0 * math.pi)
        yield time_s, position, z


def _measurement(time_s: float, z: Vector, rows: list[int]) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=float(z[0]) if 0 in rows else None,
        bearing_enu_rad=float(z[1]) if 1 in rows else None,
        elevation_rad=float(z[2]) if 2 in rows else None,
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Ekf, AsymmetricHuberEkf])
@pytest.mark.parametrize("process_noise", [0.0, 0.3])
def test_without_thresholds_the_filter_is_filterpys(
    case: Case, process_noise: float, kind: type[Ekf | AsymmetricHuberEkf]
) -> None:
    ours = kind(msgspec.structs.replace(case.params, process_noise_m_per_sqrt_s=process_noise))
    for seed in range(10):
        rng = np.random.default_rng(seed)
        state = _first(case, rng)
        ekf = _oracle(state, case)
        walk = _walk(rng, case)
        for _ in range(40):
            time_s, position, z = next(walk)
            q2dt = process_noise**2 * (time_s - state.time_s)
            _oracle_step(ekf, z, case, position, q2dt)
            seen = _measurement(time_s, z, case.rows)
            report = ours.update(ours.predict(state, time_s), seen, position)
            assert report.is_positive_definite
            state = report.state
            expected = np.array(ekf.x)
            expected[3] = math.remainder(expected[3], 2.0 * math.pi)
            np.testing.assert_allclose(state.mean, expected, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(state.covariance, ekf.P, rtol=1e-9, atol=1e-9)


def test_the_nis_is_the_square_of_filterpys_mahalanobis_distance(case: Case) -> None:
    ours = Ekf(case.params)
    rng = np.random.default_rng(5)
    state = _first(case, rng)
    ekf = _oracle(state, case)
    walk = _walk(rng, case)
    for _ in range(30):
        time_s, position, z = next(walk)
        _oracle_step(ekf, z, case, position, 0.0)
        report = ours.update(state, _measurement(time_s, z, case.rows), position)
        assert report.nis == pytest.approx(float(ekf.mahalanobis) ** 2, rel=1e-9)
        state = report.state
