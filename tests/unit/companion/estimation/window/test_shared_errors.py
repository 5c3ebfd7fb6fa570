"""The effect on the position of errors that all measurements of a window share."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import GNSS_ACCURACY_FACTOR, PositionAccuracy, RangingMeasurement
from companion.estimation.antenna import AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.map_kernels import COLUMNS
from companion.estimation.window.shared_errors import (
    NO_ERRORS,
    TIME_CONSTANT_S,
    ReceptionPath,
    SharedErrors,
    SharedSigmas,
    shared_errors,
    shared_sigmas,
)
from companion.estimation.window.window_map import MAX_POSITION_SIGMA_M, WindowMap
from companion.kernel import Matrix, Vector

TARGET = (10.0, 30.0)
HEIGHT_M = 20.0


def _passes(courses: tuple[float, ...], count: int = 60) -> tuple[Matrix, Vector]:
    """Rows of ranges and azimuths without noise, along straight passes of 50 m over the target."""
    along = np.linspace(-25.0, 25.0, count)
    positions = np.concatenate(
        [np.array(TARGET) + along[:, None] * (math.cos(c), math.sin(c)) for c in courses]
    )
    n = len(positions)
    rows = np.full((n, COLUMNS), np.nan)
    rows[:, :2], rows[:, 2] = positions, HEIGHT_M
    east, north = (np.array(TARGET) - positions).T
    rows[:, 3] = np.sqrt(east**2 + north**2 + HEIGHT_M**2)
    rows[:, 4] = np.arctan2(north, east)
    rows[:, 6:9] = 0.5, 0.1, 0.1
    rows[:, 9] = np.arange(n)
    return rows, np.arange(0.0, 0.2 * n - 0.1, 0.2)


def _shared(rows: Matrix, times_s: Vector, sigmas: SharedSigmas) -> SharedErrors:
    params = FilterParams()
    window_map, mean = WindowMap(params), np.array([*TARGET, 0.0, 0.0])
    scores = window_map.scores(rows, mean)
    return shared_errors(rows, times_s, mean, scores, window_map.prior[0], params.model, sigmas)


def _solved(rows: Matrix, height_m: float = 0.0) -> Vector:
    params = FilterParams(target_height_m=height_m)
    solution = WindowMap(params).solve(rows, np.array([*TARGET, 0.0, 0.0]))
    assert solution is not None
    return solution[0][:2]


def test_an_own_place_that_drifts_by_the_mean_of_the_search_is_counted_as_a_random_walk() -> None:
    rows, times_s = _passes((0.3, 1.7, 2.5))
    sigma_m, span_s = 1.5, float(times_s[-1])
    wander = _shared(rows, times_s, SharedSigmas(own_m=sigma_m)).wander
    walked_m2 = 2.0 * sigma_m**2 * span_s / (3.0 * TIME_CONSTANT_S)
    assert np.diag(wander) == pytest.approx([walked_m2] * 2, rel=0.5)
    assert np.linalg.eigvalsh(wander)[0] > 0.0


def test_an_own_place_that_has_long_forgotten_counts_its_whole_error() -> None:
    rows, _ = _passes((0.3, 1.7))
    times_s = np.full(len(rows), 0.0)
    times_s[-1] = 40.0 * TIME_CONSTANT_S  # all but the last one were measured an age ago
    wander = _shared(rows, times_s, SharedSigmas(own_m=1.0)).wander
    assert np.diag(wander) == pytest.approx([2.0, 2.0], rel=0.1)


def test_a_height_that_is_wrong_moves_the_place_by_what_is_counted() -> None:
    rows, times_s = _passes((0.3,))
    rows[:, :2] += 12.0  # aside of it, where a range depends on height as on position
    east, north = (np.array(TARGET) - rows[:, :2]).T
    rows[:, 3] = np.sqrt(east**2 + north**2 + HEIGHT_M**2)
    rows[:, 4] = np.nan
    step_m = 0.2
    moved = _solved(rows, height_m=step_m) - _solved(rows)
    counted = _shared(rows, times_s, SharedSigmas(height_m=step_m)).lasting
    assert counted == pytest.approx(np.outer(moved, moved), rel=0.2, abs=1e-5)


def test_a_late_stamp_cancels_out_on_a_pass_back() -> None:
    rows, times_s = _passes((0.3,))
    once = _shared(rows, times_s, SharedSigmas(lag_s=0.3)).lasting
    both, both_s = _passes((0.3, 0.3 + math.pi))
    assert np.trace(once) > 0.1
    assert np.trace(_shared(both, both_s, SharedSigmas(lag_s=0.3)).lasting) < 0.1 * np.trace(once)


def test_nothing_shared_is_no_error() -> None:
    rows, times_s = _passes((0.3, 1.7))
    shared = _shared(rows, times_s, SharedSigmas())
    assert not shared.lasting.any()
    assert not shared.wander.any()


def test_a_fix_that_was_another_one_counts_its_whole_error_however_short_the_search() -> None:
    rows, times_s = _passes((0.3, 1.7))
    wander = _shared(rows, times_s, SharedSigmas(jump_m=0.3)).wander
    assert np.diag(wander) == pytest.approx([0.09, 0.09])


def _drawn(seed: int, height_m: float, sigma_m: float) -> tuple[float, float]:
    """Return squared error and stated variance of the position, by ranges on one side of it."""
    rng = np.random.default_rng(seed)
    rows, times_s = _passes((0.3, 1.7))
    rows[:, :2] += (8.0, 5.0)
    east, north = (np.array(TARGET) - rows[:, :2]).T
    rows[:, 3] = np.sqrt(east**2 + north**2 + (HEIGHT_M - height_m) ** 2)
    rows[:, 3] += sigma_m * rng.standard_normal(len(rows))
    rows[:, 4], rows[:, 6] = np.nan, sigma_m
    params = FilterParams()
    window_map = WindowMap(params)
    solution = window_map.solve(rows, np.array([*TARGET, 0.0, 0.0]))
    assert solution is not None
    mean = solution[0]
    scores, prior = window_map.scores(rows, mean), window_map.prior[0]
    sigmas = SharedSigmas(height_m=3.0)
    counted = shared_errors(rows, times_s, mean, scores, prior, params.model, sigmas).lasting
    return math.dist(mean[:2], TARGET) ** 2, float(np.trace(counted))


@pytest.mark.parametrize("height_m", [1.0, 2.0])
def test_a_height_that_residuals_tell_counts_by_what_it_is(height_m: float) -> None:
    """Not by what it may be: level ground needs no doubt of 3 m once ranges have shown it."""
    error_m2, counted_m2 = np.mean([_drawn(seed, height_m, 0.1) for seed in range(8)], axis=0)
    assert counted_m2 == pytest.approx(error_m2, rel=0.5)


def test_a_height_that_noise_hides_counts_by_what_it_may_be() -> None:
    shown, hidden = (
        np.mean([_drawn(seed, 0.0, sigma_m)[1] for seed in range(8)]) for sigma_m in (0.1, 4.0)
    )
    assert hidden > 50.0 * shown


@pytest.mark.parametrize("variance_m2", [1.0, 1e4, 1e9, 1e16, 1e39, math.inf])
def test_no_direction_is_wider_than_where_the_radio_was_heard_says(variance_m2: float) -> None:
    errors = NO_ERRORS._replace(reception=ReceptionPath((0.0, 0.0), 20.0))
    turn = math.pi / 5.0
    axis = np.array([math.cos(turn), math.sin(turn)])
    across = np.array([-axis[1], axis[0]])
    wide = variance_m2 * np.outer(axis, axis) + 0.25 * np.outer(across, across)
    position = (30.0 * axis[0], 30.0 * axis[1])
    narrower = errors.within_reach(wide, position)
    assert axis @ narrower @ axis <= min(variance_m2, 1300.0) * (1.0 + 1e-6)  # 20^2 + 30^2
    assert np.linalg.eigvalsh(narrower)[0] > 0.2
    if variance_m2 < 1e10:
        assert axis @ narrower @ axis == pytest.approx(min(variance_m2, 1300.0))
        assert across @ narrower @ across == pytest.approx(0.25, rel=1e-3)
    np.testing.assert_allclose(narrower, narrower.T)


def test_ranges_along_a_line_state_no_radius_beyond_what_a_place_may_be() -> None:
    """A straight pass leaves the direction across open, and shared errors are levers of that."""
    tracker = TargetTracker(TrackerParams(), 1)
    rng, target = np.random.default_rng(1), (-12.0, 31.0, 0.0)
    radii_m = []
    for step in range(60):
        position = (0.05 * step, 0.0, 20.0)
        range_m = math.dist(position, target) + rng.normal(0.0, 0.15)
        now_s = 0.1 * step
        tracker.fuse(RangingMeasurement(1, now_s, range_m), position, now_s, PositionAccuracy())
        estimate = tracker.estimate(now_s)
        radii_m += [] if estimate is None else [estimate.absolute_r95_m]
    assert len(radii_m) == 60
    assert max(radii_m) <= 3.0 * MAX_POSITION_SIGMA_M


@pytest.mark.parametrize(
    ("walk_m", "own", "drift_m"),
    [
        (0.0, PositionAccuracy(1.5, 2.5, is_reported=True), 1.5 * GNSS_ACCURACY_FACTOR),
        (0.05, PositionAccuracy(1.5, 2.5, is_reported=True), 1.5),
        (0.2, PositionAccuracy(1.5, 2.5, is_reported=True), 0.2 * math.sqrt(TIME_CONSTANT_S / 2.0)),
        (0.2, PositionAccuracy(0.02, 0.04, is_reported=True), 0.02),
        (0.2, None, 0.2 * math.sqrt(TIME_CONSTANT_S / 2.0)),
        (0.0, None, 3.0),
    ],
)
def test_a_configured_walk_of_the_position_replaces_assumptions_about_its_drift(
    walk_m: float, own: PositionAccuracy | None, drift_m: float
) -> None:
    params = FilterParams(process_noise_m_per_sqrt_s=walk_m, antenna=AntennaParams(kind="two_axis"))
    assert shared_sigmas(params, own, math.inf, is_auto=False).own_m == pytest.approx(drift_m)
