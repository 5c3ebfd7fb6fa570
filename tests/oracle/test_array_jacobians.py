"""Antenna arrays: partials against central differences, directions against scipy's rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.domain import Attitude, RangingMeasurement
from companion.estimation.antenna import AntennaKind, AntennaParams, antenna_axes_enu, seen_in_enu
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import (
    PLANAR,
    RangingModel,
    jacobian,
    predicted,
    variances,
)
from companion.estimation.window.map_kernels import (
    argument_columns,
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.geometry.coordinates import ned_from_enu
from companion.kernel import Matrix, Vector

STEP = 1e-5
KINDS: tuple[AntennaKind, ...] = ("planar", "line", "two_axis")


@pytest.fixture(params=[(kind, sigma_m) for kind in KINDS for sigma_m in (0.0, 5.0)])
def model(request: pytest.FixtureRequest) -> RangingModel:
    kind, height_sigma_m = request.param
    antenna = AntennaParams(kind=kind)
    return FilterParams(antenna=antenna, target_height_sigma_m=height_sigma_m).model


def _pose(rng: np.random.Generator) -> Vector:
    """A vehicle that leans anyhow, and an antenna that is mounted anyhow."""
    attitude = (*rng.uniform(-0.6, 0.6, 2).tolist(), float(rng.uniform(-3.0, 3.0)))
    mount_deg = tuple(rng.uniform(-90.0, 90.0, 3).tolist())
    _, right, down = antenna_axes_enu(attitude, mount_deg)
    position = [*rng.uniform(-80.0, 80.0, 2), rng.uniform(12.0, 60.0)]
    return np.array([*position, *right, *(-v for v in down)])


def _mean(rng: np.random.Generator, model: RangingModel) -> Vector:
    mean = [*rng.uniform(-80.0, 80.0, 2), 1.0, 0.2 * rng.normal()]
    return np.array(mean + [3.0] * (model.height_index >= 0))


def _rows(rng: np.random.Generator, model: RangingModel, mean: Vector, count: int) -> Matrix:
    rows = np.empty((count, 16))
    for index in range(count):
        pose = _pose(rng)
        z = predicted(mean, pose, model) + rng.normal(size=3) * [2.0, 0.05, 0.05]
        rows[index] = [*pose[:3], *z, 1.5, 0.05, 0.05, index, *pose[3:]]
    rows[:, 3:6][rng.random((count, 3)) < 0.2] = np.nan
    return rows


@pytest.mark.parametrize("seed", range(20))
def test_partials_are_the_slope_of_what_is_expected(seed: int, model: RangingModel) -> None:
    rng = np.random.default_rng(seed)
    mean, pose = _mean(rng, model), _pose(rng)
    columns = []
    for step in np.eye(mean.size) * STEP:
        change = predicted(mean + step, pose, model) - predicted(mean - step, pose, model)
        change[1] = math.remainder(float(change[1]), 2.0 * math.pi)
        columns.append(change / (2.0 * STEP))
    slope = np.array(columns).T
    if model.antenna == PLANAR:
        slope[2] = 0.0  # nothing is measured there
    np.testing.assert_allclose(jacobian(mean, pose, model), slope, rtol=1e-6, atol=1e-7)


def test_the_window_sees_as_the_filter_does(model: RangingModel) -> None:
    rng = np.random.default_rng(1)
    mean = _mean(rng, model)
    rows = _rows(rng, model, mean, 40)
    plain = model._replace(near_target_terms=False, own_sigma_m=0.3)
    sigmas = row_sigmas(rows, mean, plain)
    u = row_residuals(rows, mean, sigmas, plain)
    by_row = row_partials(rows, mean, sigmas, plain).reshape(3, 40, mean.size)
    measured = ~np.isnan(rows[:, 3:6])
    if model.antenna == PLANAR:
        rows[:, 5] = np.nan
        measured[:, 2] = False
        u[2] = 0.0
        by_row[2] = 0.0
    for index, row in enumerate(rows):
        pose = np.concatenate([row[:3], row[10:]])
        y = row[3:6] - predicted(mean, pose, plain)
        y[1] = math.remainder(float(y[1]), 2.0 * math.pi) if measured[index, 1] else 0.0
        y = np.where(measured[index], y, 0.0)
        np.testing.assert_allclose(u[:, index], y / sigmas[:, index], atol=1e-11)
        H = jacobian(mean, pose, plain) / sigmas[:, index, None] * measured[index][:, None]
        np.testing.assert_allclose(by_row[:, index], H, rtol=1e-10, atol=1e-13)
        R = variances(np.eye(mean.size), mean, pose, row[6:9].copy(), plain)
        last = 2 if model.antenna == PLANAR else 3
        np.testing.assert_allclose(sigmas[:last, index] ** 2, R[:last], rtol=1e-10)


@pytest.mark.parametrize("seed", range(10))
def test_axes_are_those_of_scipys_rotations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    roll, pitch, yaw = rng.uniform(-1.5, 1.5, 3).tolist()
    mount_deg = tuple(rng.uniform(-90.0, 90.0, 3).tolist())
    body = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    mount = Rotation.from_euler("ZYX", mount_deg[::-1], degrees=True)
    expected = (body * mount).as_matrix().T
    axes_ned = [ned_from_enu(axis) for axis in antenna_axes_enu((roll, pitch, yaw), mount_deg)]
    np.testing.assert_allclose(axes_ned, expected, atol=1e-14)


def _printed(u: Vector, kind: AntennaKind) -> tuple[float, float | None]:
    """Bearing and elevation as the array prints them, of a direction in its own frame."""
    if kind == "planar":
        return math.atan2(u[1], u[0]), None
    return math.asin(u[1]), math.asin(-u[2]) if kind == "two_axis" else None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(10))
def test_what_is_printed_is_what_is_expected_of_the_true_place(
    seed: int, kind: AntennaKind
) -> None:
    """From the definition of field directions, by scipy's rotations, to the filter's prediction."""
    rng = np.random.default_rng(seed)
    attitude = (0.3 * rng.normal(), 0.3 * rng.normal(), rng.uniform(-3.0, 3.0))
    mount_deg = (10.0, -90.0, 20.0) if kind == "two_axis" else (3.0, -5.0, 40.0)
    antenna = AntennaParams(kind=kind, mount_deg=mount_deg)
    sensor, target = np.array([4.0, -3.0, 20.0]), np.array([*rng.uniform(-30.0, 30.0, 2), 0.0])
    away_ned = np.array(ned_from_enu(tuple((target - sensor).tolist())))
    turn = Rotation.from_euler("ZYX", attitude[::-1]) * Rotation.from_euler(
        "ZYX", mount_deg[::-1], degrees=True
    )
    u = turn.inv().apply(away_ned / np.linalg.norm(away_ned))
    bearing_rad, elevation_rad = _printed(u, kind)
    printed = RangingMeasurement(
        emitter_id=1,
        measured_at_s=0.0,
        bearing_body_rad=bearing_rad,
        elevation_rad=elevation_rad,
    )
    seen = seen_in_enu(printed, Attitude(attitude[2], attitude[:2]), antenna)
    params = FilterParams(antenna=antenna)
    row = params.kernel_row(seen, (4.0, -3.0, 20.0))
    pose, z, _ = [row[columns] for columns in argument_columns(params.model)]
    expected = predicted(np.array([target[0], target[1], 0.0, 0.0]), pose, params.model)
    measured = ~np.isnan(z)
    np.testing.assert_allclose(z[measured], expected[measured], atol=1e-12)
    assert measured.tolist() == [False, True, kind == "two_axis"]


def test_a_compass_that_is_off_turns_every_direction_alike() -> None:
    """With the heading 10 degrees too large the bearing offset that explains it is -10 degrees."""
    antenna = AntennaParams(kind="planar")
    params = FilterParams(antenna=antenna)
    true_yaw, target = 0.7, (30.0, 10.0, 0.0)
    azimuth = math.atan2(30.0, 10.0) - true_yaw  # clockwise from the nose, from above the origin
    printed = RangingMeasurement(emitter_id=1, measured_at_s=0.0, bearing_body_rad=azimuth)
    seen = seen_in_enu(printed, Attitude(true_yaw + math.radians(10.0), (0.0, 0.0)), antenna)
    row = params.kernel_row(seen, (0.0, 0.0, 20.0))
    pose, z, _ = [row[columns] for columns in argument_columns(params.model)]
    mean = np.array([target[0], target[1], 0.0, math.radians(-10.0)])
    assert z[1] == pytest.approx(predicted(mean, pose, params.model)[1], abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_without_the_attitude_there_is_no_direction(kind: AntennaKind) -> None:
    printed = RangingMeasurement(
        emitter_id=1, measured_at_s=0.0, range_m=20.0, bearing_body_rad=0.1, elevation_rad=0.1
    )
    seen = seen_in_enu(printed, None, AntennaParams(kind=kind))
    assert not seen.has_direction
    assert seen.range_m == printed.range_m


def test_nothing_is_believed_outside_the_field_of_view() -> None:
    antenna = AntennaParams(kind="line", field_of_view_deg=120.0)
    for degrees, is_believed in ((59.0, True), (-61.0, False)):
        printed = RangingMeasurement(
            emitter_id=1, measured_at_s=0.0, bearing_body_rad=math.radians(degrees)
        )
        assert seen_in_enu(printed, Attitude(0.0, (0.0, 0.0)), antenna).has_direction is is_believed
