"""Space has no east and no origin: filters and window turn and shift along with the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams, FilterState, UpdateReport
from companion.estimation.measurement_model import jacobian
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tools.study.admm_ekf import RECURSIVE

PARAMS = {
    "plane": FilterParams(),
    "space": FilterParams(range_scale_sigma=0.05, target_height_sigma_m=4.0, range_k_short=3.0),
}
SHIFTS = st.tuples(*[st.floats(-500.0, 500.0)] * 2)
TURNS = st.floats(-math.pi, math.pi)
SEEDS = st.integers(0, 10_000)


def _turned(turn_rad: float, size: int) -> Matrix:
    """East and north turned counter-clockwise, the rest left alone."""
    matrix = np.eye(size)
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    matrix[:2, :2] = [[c, -s], [s, c]]
    return matrix


def _scene(seed: int, params: FilterParams) -> tuple[FilterState, RangingMeasurement, PositionEnu]:
    """Return any state, a whole measurement within a few sigma, and a position well off it."""
    rng = np.random.default_rng(seed)
    mean, sigmas = params.prior
    sigmas[:2] = 5.0
    root = (np.eye(mean.size) + 0.3 * rng.normal(size=(mean.size, mean.size))) * sigmas[:, None]
    direction_rad, ground_m = rng.uniform(-math.pi, math.pi), rng.uniform(20.0, 80.0)
    mean[:2] = ground_m * math.cos(direction_rad), ground_m * math.sin(direction_rad)
    up_m = float(rng.uniform(5.0, 40.0))
    seen = RangingMeasurement(
        emitter_id=1,
        measured_at_s=0.0,
        range_m=math.hypot(ground_m, up_m) + float(rng.normal(0.0, 9.0)),
        bearing_enu_rad=direction_rad + float(rng.normal(0.0, 0.2)),
        elevation_rad=math.atan2(-up_m, ground_m) + float(rng.normal(0.0, 0.2)),
    )
    return FilterState.of(0.0, mean, root @ root.T), seen, (0.0, 0.0, up_m)


def _updated(kind: str, name: str, seed: int, turn_rad: float, shift: Vector) -> Vector:
    """Mean and covariance after one update of the scene turned and shifted, turned back."""
    params = PARAMS[name]
    state, seen, position = _scene(seed, params)
    T = _turned(turn_rad, state.mean.size)
    moved = T @ state.mean
    moved[:2] += shift
    sensor = np.array(position)
    sensor[:2] += shift
    assert seen.bearing_enu_rad is not None
    turned = RangingMeasurement(
        emitter_id=1,
        measured_at_s=0.0,
        range_m=seen.range_m,
        bearing_enu_rad=math.remainder(seen.bearing_enu_rad + turn_rad, 2.0 * math.pi),
        elevation_rad=seen.elevation_rad,
    )
    report = RECURSIVE[kind](params).update(
        FilterState.of(0.0, moved, T @ state.covariance @ T.T),
        turned,
        (float(sensor[0]), float(sensor[1]), float(sensor[2])),
    )
    assert report.is_positive_definite
    mean = np.array(report.state.mean)
    mean[:2] -= shift
    P = T.T @ report.state.covariance @ T
    return np.concatenate([T.T @ mean, P.reshape(-1)])


@pytest.mark.parametrize("kind", RECURSIVE)
@pytest.mark.parametrize("name", PARAMS)
@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, turn_rad=TURNS, shift=SHIFTS)
def test_an_update_turns_and_shifts_with_the_scene(
    kind: str, name: str, seed: int, turn_rad: float, shift: tuple[float, float]
) -> None:
    here = _updated(kind, name, seed, 0.0, np.zeros(2))
    there = _updated(kind, name, seed, turn_rad, np.array(shift))
    np.testing.assert_allclose(there, here, rtol=1e-7, atol=1e-7)


def _parts(report: UpdateReport) -> tuple[list[int], Matrix, Vector]:
    measured = [row for row, m in enumerate(report.modalities) if m is not None]
    parts = [m for m in report.modalities if m is not None]
    R = np.diag([m.noise_sigma**2 / m.weight for m in parts])
    return measured, R, np.array([m.innovation for m in parts])


@pytest.mark.parametrize("kind", ["asymmetric_huber", "huber", "ekf"])
@pytest.mark.parametrize("name", PARAMS)
@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_row_by_row_is_the_joint_update(kind: str, name: str, seed: int) -> None:
    """With the weights of the innovations: K = P H' (H P H' + R)^-1 and (I - K H) P."""
    params = PARAMS[name]
    state, seen, position = _scene(seed, params)
    report = RECURSIVE[kind](params).update(state, seen, position)
    rows, R, y = _parts(report)
    H = jacobian(state.mean, np.array(position), params.model)[rows]
    P = state.covariance
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    expected = state.mean + K @ y
    expected[3] = math.remainder(float(expected[3]), 2.0 * math.pi)
    bounded = np.clip(expected, *params.bounds)
    if (bounded == expected).all():
        np.testing.assert_allclose(report.state.mean, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(report.state.covariance, P - K @ H @ P, rtol=1e-6, atol=1e-8)


def _rows(seed: int, target: Vector) -> Matrix:
    """A bent walk past a target, with reflections."""
    rng = np.random.default_rng(seed)
    rows = np.full((60, 10), np.nan)
    s = np.linspace(0.0, 1.0, 60)
    rows[:, 0], rows[:, 1], rows[:, 2] = 60.0 * s, 25.0 * np.sin(4.0 * s), 10.0
    away = target - rows[:, :2]
    rows[:, 3] = np.sqrt((away**2).sum(axis=1) + 100.0) + rng.normal(size=60)
    rows[:, 3] += np.where(rng.random(60) < 0.3, rng.exponential(8.0, 60), 0.0)
    rows[:, 4] = np.arctan2(away[:, 1], away[:, 0]) + 0.03 * rng.normal(size=60)
    rows[:, 6:9], rows[:, 9] = (1.0, 0.03, 0.1), np.arange(60)
    return rows


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, turn_rad=TURNS, shift=SHIFTS)
def test_the_window_turns_and_shifts_with_the_scene(
    seed: int, turn_rad: float, shift: tuple[float, float]
) -> None:
    solver, target = WindowMap(FilterParams()), np.array([35.0, 30.0])
    rows, start = _rows(seed, target), np.array([30.0, 35.0, 0.0, 0.0])
    T = _turned(turn_rad, 4)
    moved, begin = np.array(rows), T @ start
    moved[:, :2] = rows[:, :2] @ T[:2, :2].T + shift
    moved[:, 4] += turn_rad
    begin[:2] += shift
    (here,), (there,) = solver.optima(rows, [start]), solver.optima(moved, [begin])
    expected = T @ here.mean
    expected[:2] += shift
    np.testing.assert_allclose(there.mean, expected, rtol=0.0, atol=2e-3)
    turned = T @ here.covariance @ T.T
    np.testing.assert_allclose(there.covariance[:2, :2], turned[:2, :2], rtol=0.02, atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS)
def test_the_order_of_the_window_does_not_move_its_optimum(seed: int) -> None:
    solver, rows = WindowMap(FilterParams()), _rows(seed, np.array([35.0, 30.0]))
    shuffled = np.random.default_rng(seed).permutation(rows)
    start = np.array([30.0, 35.0, 0.0, 0.0])
    one, other = solver.solve(rows, start), solver.solve(shuffled, start)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other[0], one[0], rtol=0.0, atol=1e-6)
    assert other[1] == pytest.approx(one[1], rel=1e-9)
