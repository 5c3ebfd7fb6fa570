"""Partials of range, bearing and elevation against central differences, one by one and in rows."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import (
    NEAREST2_M2,
    RangingModel,
    jacobian,
    predicted,
    variances,
)
from companion.estimation.window.map_kernels import (
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector

STEP = 1e-5

PLANE = FilterParams(target_height_m=3.0)
LAYOUTS = {
    "plane": PLANE,
    "scale": msgspec.structs.replace(PLANE, range_scale_sigma=0.05),
    "height": msgspec.structs.replace(PLANE, target_height_sigma_m=5.0),
    "scale and height": msgspec.structs.replace(
        PLANE, range_scale_sigma=0.05, target_height_sigma_m=5.0
    ),
}


@pytest.fixture(params=LAYOUTS)
def model(request: pytest.FixtureRequest) -> RangingModel:
    return LAYOUTS[request.param].model


def _size(model: RangingModel) -> int:
    return 4 + (model.scale_index >= 0) + (model.height_index >= 0)


def _scene(rng: np.random.Generator, model: RangingModel) -> tuple[Vector, Vector]:
    """A state and where it is looked at from."""
    mean = np.zeros(_size(model))
    mean[:4] = [*rng.uniform(-80.0, 80.0, 2), 3.0 * rng.normal(), 0.1 * rng.normal()]
    if model.scale_index >= 0:
        mean[model.scale_index] = 0.1 * rng.normal()
    if model.height_index >= 0:
        mean[model.height_index] = rng.uniform(-10.0, 10.0)
    return mean, np.array([*rng.uniform(-80.0, 80.0, 2), rng.uniform(12.0, 60.0)])


def _differences(mean: Vector, sensor: Vector, model: RangingModel) -> Matrix:
    """Central differences of the prediction, (3, n), the bearing's wrapped."""
    columns = []
    for step in np.eye(mean.size) * STEP:
        change = predicted(mean + step, sensor, model) - predicted(mean - step, sensor, model)
        change[1] = math.remainder(float(change[1]), 2.0 * math.pi)
        columns.append(change / (2.0 * STEP))
    return np.array(columns).T


@pytest.mark.parametrize("seed", range(50))
def test_partials_are_the_slope_of_the_prediction(seed: int, model: RangingModel) -> None:
    mean, sensor = _scene(np.random.default_rng(seed), model)
    slope = _differences(mean, sensor, model)
    np.testing.assert_allclose(jacobian(mean, sensor, model), slope, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("ground_m", [0.2, 1.0])
def test_so_they_are_next_to_the_target(ground_m: float, model: RangingModel) -> None:
    for direction_rad in np.arange(0.0, 6.0, 0.7):
        mean = _scene(np.random.default_rng(1), model)[0]
        up = mean[model.height_index] if model.height_index >= 0 else model.height_m
        aside = ground_m * np.array([math.cos(direction_rad), math.sin(direction_rad)])
        for rise_m in (-0.3, 0.0, 2.0):
            sensor = np.array([*(mean[:2] + aside), up + rise_m])
            slope = _differences(mean, sensor, model)
            np.testing.assert_allclose(jacobian(mean, sensor, model), slope, rtol=1e-6, atol=1e-6)


def _rows(rng: np.random.Generator, model: RangingModel, count: int) -> tuple[Matrix, Vector]:
    """Measurements of a target from all around, a fifth of each modality missing."""
    mean, _ = _scene(rng, model)
    rows = np.empty((count, 10))
    for index in range(count):
        sensor = _scene(rng, model)[1]
        z = predicted(mean, sensor, model) + rng.normal(size=3) * [2.0, 0.3, 0.2]
        rows[index] = [*sensor, *z, 1.5, 0.03, 0.09, index]
    rows[:, 3:6][rng.random((count, 3)) < 0.2] = np.nan
    return rows, mean


@pytest.mark.parametrize("seed", range(5))
def test_the_windows_partials_are_the_filters(seed: int, model: RangingModel) -> None:
    rows, mean = _rows(np.random.default_rng(seed), model, 40)
    sigmas = row_sigmas(rows, mean, model)
    by_row = row_partials(rows, mean, sigmas, model).reshape(3, 40, mean.size)
    for index, row in enumerate(rows):
        H = jacobian(mean, row[:3], model) / sigmas[:, index, None]
        H[np.isnan(row[3:6])] = 0.0
        np.testing.assert_allclose(by_row[:, index], H, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_the_windows_partials_are_the_slope_of_its_residuals(
    seed: int, model: RangingModel
) -> None:
    """Residuals fall where predictions rise; sigmas are held, as the solver holds them."""
    rows, mean = _rows(np.random.default_rng(seed), model, 40)
    sigmas = row_sigmas(rows, mean, model)
    H = row_partials(rows, mean, sigmas, model)
    for index, step in enumerate(np.eye(mean.size) * STEP):
        above = row_residuals(rows, mean + step, sigmas, model)
        below = row_residuals(rows, mean - step, sigmas, model)
        slope = (below - above).reshape(-1) / (2.0 * STEP)
        np.testing.assert_allclose(H[:, index], slope, rtol=1e-6, atol=1e-6)


def test_the_windows_residuals_are_the_filters_innovations(model: RangingModel) -> None:
    rows, mean = _rows(np.random.default_rng(3), model, 40)
    sigmas = row_sigmas(rows, mean, model)
    u = row_residuals(rows, mean, sigmas, model)
    for index, row in enumerate(rows):
        y = row[3:6] - predicted(mean, row[:3], model)
        y[1] = math.remainder(float(y[1]), 2.0 * math.pi) if not np.isnan(y[1]) else 0.0
        np.testing.assert_allclose(u[:, index], np.nan_to_num(y) / sigmas[:, index], atol=1e-12)


def test_the_windows_sigmas_are_the_filters_without_second_order_terms(
    model: RangingModel,
) -> None:
    rows, mean = _rows(np.random.default_rng(4), model, 20)
    plain = model._replace(near_target_terms=False, own_sigma_m=0.3)
    sigmas = row_sigmas(rows, mean, plain)
    P = np.eye(mean.size)
    for index, row in enumerate(rows):
        R = variances(P, mean, row[:3], row[6:9].copy(), plain)
        np.testing.assert_allclose(sigmas[:, index] ** 2, R, rtol=1e-12)


def test_right_overhead_a_window_row_stays_finite(model: RangingModel) -> None:
    rows, mean = _rows(np.random.default_rng(6), model, 3)
    up = mean[model.height_index] if model.height_index >= 0 else model.height_m
    rows[0, :3] = [mean[0], mean[1], up]
    rows[1, :3] = [mean[0], mean[1], up + 20.0]
    rows[:, 3:6] = [5.0, 0.3, -1.0]
    sigmas = row_sigmas(rows, mean, model)
    H = row_partials(rows, mean, sigmas, model)
    assert np.isfinite(H).all()
    assert np.isfinite(row_residuals(rows, mean, sigmas, model)).all()
    assert np.abs(H[3:5, :2] * sigmas[1, :2, None]).max() <= 1.0 / math.sqrt(NEAREST2_M2)


def test_a_range_is_slant() -> None:
    target = np.array([3.0, 4.0, 0.5, 0.0])
    z = predicted(target, np.array([0.0, 0.0, 12.0]), FilterParams().model)
    assert z[0] == pytest.approx(13.5)
    assert z[1] == pytest.approx(math.atan2(4.0, 3.0))
    assert z[2] == pytest.approx(math.atan2(-12.0, 5.0))


def test_a_scale_lengthens_the_distance_and_not_the_offset() -> None:
    model = FilterParams(range_scale_sigma=0.1).model
    z = predicted(np.array([3.0, 4.0, 0.5, 0.0, 0.1]), np.array([0.0, 0.0, 12.0]), model)
    assert z[0] == pytest.approx(1.1 * 13.0 + 0.5)


def test_at_the_target_only_the_offsets_are_seen(model: RangingModel) -> None:
    mean, _ = _scene(np.random.default_rng(2), model)
    up = mean[model.height_index] if model.height_index >= 0 else model.height_m
    H = jacobian(mean, np.array([mean[0], mean[1], up]), model)
    expected = np.zeros((3, mean.size))
    expected[0, 2] = expected[1, 3] = 1.0
    assert H.tolist() == expected.tolist()


def test_right_overhead_there_is_height_and_scale_but_no_direction(model: RangingModel) -> None:
    mean, _ = _scene(np.random.default_rng(2), model)
    up = mean[model.height_index] if model.height_index >= 0 else model.height_m
    H = jacobian(mean, np.array([mean[0], mean[1], up + 20.0]), model)
    assert not H[:, :2].any()
    assert H[0, 2] == H[1, 3] == 1.0
    if model.scale_index >= 0:
        assert H[0, model.scale_index] == pytest.approx(20.0)
    if model.height_index >= 0:
        factor = 1.0 + (mean[model.scale_index] if model.scale_index >= 0 else 0.0)
        assert H[0, model.height_index] == pytest.approx(-factor)
        assert H[2, model.height_index] == 0.0


def test_with_a_known_height_in_the_state_nothing_differs_bit_for_bit() -> None:
    """The first four components do not notice whether the height is a constant or a component."""
    plane, space = LAYOUTS["plane"].model, LAYOUTS["height"].model
    rng = np.random.default_rng(9)
    for _ in range(50):
        mean, sensor = _scene(rng, plane)
        lifted = np.append(mean, plane.height_m)
        root = rng.normal(size=(4, 4))
        P = np.zeros((5, 5))
        P[:4, :4] = root @ root.T
        sigma = np.array([1.5, 0.03, 0.09])
        assert (
            predicted(lifted, sensor, space).tobytes() == predicted(mean, sensor, plane).tobytes()
        )
        H, flat = jacobian(lifted, sensor, space), jacobian(mean, sensor, plane)
        assert H[:, :4].tobytes() == flat.tobytes()
        R = variances(P, lifted, sensor, sigma, space)
        assert R.tobytes() == variances(P[:4, :4], mean, sensor, sigma, plane).tobytes()


def test_the_curvature_term_is_the_bias_of_the_linearisation() -> None:
    """A target that is uncertain across the line of sight is farther away than its mean."""
    rng = np.random.default_rng(2)
    across_m, ground_m = 1.5, 40.0
    P = np.diag([0.0, across_m**2, 0.0, 0.0])
    mean, sensor, sigma = np.array([ground_m, 0.0, 0.0, 0.0]), np.zeros(3), np.ones(3)
    drawn = rng.normal(0.0, across_m, 200_000)
    farther_m = np.hypot(ground_m, drawn) - ground_m
    near = FilterParams(own_position_sigma_m=0.0)
    added = variances(P, mean, sensor, sigma, near.model)[0] - 1.0
    assert added == pytest.approx(float(np.mean(farther_m)) ** 2, rel=0.02)
    plain = msgspec.structs.replace(near, near_target_terms=False)
    assert variances(P, mean, sensor, sigma, plain.model).tolist() == [1.0, 1.0, 1.0]


def test_variances_add_radio_own_position_and_curvature() -> None:
    P = np.diag([3.0, 1.0, 0.0, 0.0])
    mean, sensor = np.array([6.0, 8.0, 0.0, 0.0]), np.array([0.0, 0.0, 7.5])
    sigma = np.array([1.5, 0.03, 0.09])
    model = FilterParams(own_position_sigma_m=0.2).model
    assert variances(P, mean, sensor, sigma, model) == pytest.approx(
        [
            1.5**2 + 0.2**2 + (4.0 / 25.0) ** 2,
            0.03**2 + (0.2 / 10.0) ** 2 + (4.0 / 100.0) ** 2,
            0.09**2 + (0.2 / 12.5) ** 2 + (4.0 / 156.25 * (1.0 + 0.5 * 0.75)) ** 2,
        ]
    )
    plain = model._replace(own_sigma_m=0.0, near_target_terms=False)
    assert variances(P, mean, sensor, sigma, plain) == pytest.approx(sigma**2)


def test_an_uncertain_height_counts_in_range_and_elevation_only() -> None:
    P = np.diag([3.0, 1.0, 0.0, 0.0, 5.0])
    mean, sensor = np.array([6.0, 8.0, 0.0, 0.0, 0.0]), np.zeros(3)
    model = FilterParams(own_position_sigma_m=0.0, target_height_sigma_m=1.0).model
    assert variances(P, mean, sensor, np.zeros(3), model) == pytest.approx(
        [(9.0 / 20.0) ** 2, (4.0 / 100.0) ** 2, (9.0 / 100.0) ** 2]
    )
