"""The bounded-window MAP and what it does to the hypotheses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import EstimateState, RangingMeasurement
from companion.estimation.base import FilterParams, FilterState
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.measurement_window import SEQUENCE, MeasurementWindow, thinned
from companion.estimation.polish import polished, weighted
from companion.estimation.tracker import TargetTracker, TrackerParams
from companion.estimation.window_map import (
    Optimum,
    WindowMap,
)

TARGET = (40.0, 25.0)
OFFSET_M = 2.0
TURN_RAD = -0.05


def walk(
    rng: np.random.Generator,
    count: int = 200,
    *,
    ranges: bool = True,
    bearings: bool = True,
    straight: bool = False,
    noise: float = 1.0,
) -> np.ndarray:
    """Rows of a walk at 10 m height, with well-specified noise times `noise`."""
    s = np.linspace(0.0, 1.0, count)
    east = 60.0 * s
    north = np.zeros(count) if straight else 30.0 * np.sin(2.0 * math.pi * s)
    away = np.array(TARGET)[:, None] - np.stack([east, north])
    slant = np.sqrt((away**2).sum(axis=0) + 100.0)
    z = slant + OFFSET_M + noise * rng.normal(0.0, 0.5, count)
    b = np.arctan2(away[1], away[0]) + TURN_RAD + noise * rng.normal(0.0, 0.03, count)
    nan = np.full(count, np.nan)
    return np.stack(
        [
            east,
            north,
            np.full(count, 10.0),
            z if ranges else nan,
            b if bearings else nan,
            np.full(count, 0.5),
            np.full(count, 0.03),
        ],
        axis=1,
    )


def params(**changes: float | None) -> FilterParams:
    return FilterParams(own_position_sigma_m=0.0, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(("ranges", "bearings"), [(True, True), (True, False), (False, True)])
def test_noiseless_walk_is_solved_exactly(ranges: bool, bearings: bool) -> None:
    rows = walk(np.random.default_rng(1), ranges=ranges, bearings=bearings, noise=0.0)
    weak_priors = params(range_offset_sigma_m=1e4, bearing_offset_sigma_deg=1e4)
    solution = WindowMap(weak_priors).solve(rows, np.array([20.0, 10.0, 0.0, 0.0]))
    assert solution is not None
    assert solution[0][:2] == pytest.approx(TARGET, abs=1e-3)
    if ranges:
        assert solution[0][2] == pytest.approx(OFFSET_M, abs=1e-3)
    if bearings:
        assert solution[0][3] == pytest.approx(TURN_RAD, abs=1e-4)


def test_solution_is_a_minimum_of_the_objective() -> None:
    rng = np.random.default_rng(2)
    solver, rows = WindowMap(params()), walk(rng)
    rows[::3, 3] += rng.exponential(8.0, len(rows[::3]))
    mean, cost = solver.solve(rows, np.array([30.0, 10.0, 0.0, 0.0])) or (np.zeros(4), math.inf)
    sigmas = solver._sigmas(rows, mean)
    assert cost == pytest.approx(solver._cost(rows, mean, sigmas))
    for direction in np.concatenate([np.eye(4), -np.eye(4)]):
        assert solver._cost(rows, mean + 0.01 * direction, sigmas) > cost


def test_one_sided_loss_beats_the_quadratic_one_under_reflections() -> None:
    errors: dict[str, list[float]] = {"one-sided": [], "quadratic": []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows = walk(rng, bearings=False)
        reflected = rng.random(len(rows)) < 0.5
        rows[reflected, 3] += rng.exponential(8.0, int(reflected.sum()))
        for name, k in (("one-sided", 1.0), ("quadratic", None)):
            solution = WindowMap(params(range_k_long=k)).solve(rows, np.array([35, 20, 0, 0.0]))
            assert solution is not None
            errors[name].append(math.dist(solution[0][:2], TARGET))
    assert np.mean(errors["one-sided"]) < 0.5 * np.mean(errors["quadratic"])


def test_offset_stays_inside_its_bounds() -> None:
    rows = walk(np.random.default_rng(3))
    bounded = WindowMap(params(range_offset_min_m=0.0, range_offset_max_m=1.0))
    solution = bounded.solve(rows, np.array([30.0, 10.0, 5.0, 0.0]))
    assert solution is not None
    assert solution[0][2] == 1.0


def test_straight_walk_with_ranges_only_has_two_mirror_optima() -> None:
    rows = walk(np.random.default_rng(4), bearings=False, straight=True)
    solver = WindowMap(params())
    starts = [solver.start_around(rows, 2.0 * math.pi * i / 12, i) for i in range(12)]
    optima = solver.optima(rows, starts)
    assert len(weighted(optima)) == 2
    norths = sorted(float(o.mean[1]) for o in optima[:2])
    assert norths[1] == pytest.approx(-norths[0], abs=0.05)
    assert optima[0].cost == pytest.approx(optima[1].cost, abs=1e-3)


def test_covariance_covers_well_specified_noise() -> None:
    inside = 0
    for seed in range(200):
        rng = np.random.default_rng(1000 + seed)
        solver, rows = WindowMap(params(range_k_long=None, bearing_k=None)), walk(rng)
        (optimum,) = solver.optima(rows, [np.array([35.0, 20.0, 0.0, 0.0])])
        error = optimum.mean[:2] - np.array(TARGET)
        nees = float(error @ np.linalg.solve(optimum.covariance[:2, :2], error))
        inside += nees < 5.991
    assert inside >= 0.93 * 200


def test_covariance_grows_when_neighbouring_residuals_repeat() -> None:
    rng = np.random.default_rng(5)
    solver = WindowMap(params())
    white, repeated = walk(rng, noise=0.0), walk(rng, noise=0.0)
    white[:, 3] += rng.normal(0.0, 0.5, 200)
    repeated[:, 3] += np.repeat(rng.normal(0.0, 0.5, 10), 20)
    start = np.array([35.0, 20.0, 0.0, 0.0])
    (a,), (b,) = solver.optima(white, [start]), solver.optima(repeated, [start])
    assert np.trace(b.covariance[:2, :2]) > 3.0 * np.trace(a.covariance[:2, :2])


def test_measurements_from_one_place_name_no_place() -> None:
    rows = walk(np.random.default_rng(6), bearings=False)
    rows[:, :2] = 0.0
    rows[:, 3] = 47.0
    solver = WindowMap(params(range_offset_sigma_m=1e3))
    assert solver.optima(rows, [np.array([40.0, 25.0, 0.0, 0.0])]) == []


def test_window_is_bounded_and_keeps_the_rare_views() -> None:
    window = MeasurementWindow(64)
    for index in range(40):
        phi = 2.0 * math.pi * index / 40
        place = (5.0 * math.cos(phi), 5.0 * math.sin(phi), 10.0)
        window.add(place, 50.0, None, 1.0, 0.1, (0.0, 0.0))
    assert window.is_complete
    for index in range(5000):
        window.add((5.0, 0.1, 10.0), 50.0 + index, None, 1.0, 0.1, (0.0, 0.0))
    assert len(window) <= 64
    assert not window.is_complete
    rows = window.rows
    sectors = np.unique(np.floor(np.arctan2(rows[:, 1], rows[:, 0]) / (math.pi / 8.0)))
    assert len(sectors) >= 15
    hovering = rows[rows[:, 3] > 50.0, 3] - 50.0
    assert np.all(np.diff(hovering) > 0.0)
    old = hovering[hovering < 4900.0]
    assert len(old) >= 5
    assert np.diff(old).max() < 4.0 * np.diff(old).min()
    assert window.kept_share == pytest.approx(len(window) / 5040)
    window.clear()
    assert len(window) == 0
    assert window.kept_share == 1.0
    assert window.is_complete


@pytest.mark.parametrize("target", [1, 10, 24, 31])
def test_thinning_never_keeps_more_than_asked(target: int) -> None:
    rng = np.random.default_rng(7)
    rows = rng.uniform(0.0, 100.0, (32, 8))
    rows[:, SEQUENCE] = np.arange(32)
    assert len(thinned(rows, target, (50.0, 50.0))) <= target


def optimum(east_m: float, cost: float, sigma_m: float = 0.5, inflation: float = 1.0) -> Optimum:
    covariance = np.diag([sigma_m**2, sigma_m**2, 1.0, 0.01])
    return Optimum(np.array([east_m, 0.0, 1.0, 0.0]), cost, covariance, inflation)


def hypothesis(east_m: float, sigma_m: float = 0.5) -> Hypothesis:
    covariance = np.diag([sigma_m**2, sigma_m**2, 1.0, 0.01])
    return Hypothesis(0.0, FilterState.of(3.0, np.array([east_m, 0.0, 1.0, 0.0]), covariance))


def test_confirmed_hypothesis_stays_if_it_may() -> None:
    own = hypothesis(10.0)
    (kept,) = polished((own,), [optimum(10.2, 5.0)], 4.0, keep_confirmed=True)
    assert kept.state is own.state
    (moved,) = polished((own,), [optimum(10.2, 5.0)], 4.0, keep_confirmed=False)
    assert moved.state.mean[0] == 10.2
    assert moved.state.time_s == 4.0


def test_contradicted_hypothesis_is_replaced_by_the_optimum() -> None:
    (moved,) = polished((hypothesis(30.0),), [optimum(10.0, 5.0)], 4.0, keep_confirmed=True)
    assert moved.state.mean[0] == 10.0


def test_inflation_keeps_a_rival_alive_that_white_noise_would_rule_out() -> None:
    def rivals(inflation: float) -> list[Optimum]:
        return [optimum(0.0, 100.0, inflation=inflation), optimum(9.0, 120.0, inflation=inflation)]

    assert len(weighted(rivals(1.0))) == 1
    assert len(weighted(rivals(10.0))) == 2


def test_a_wrong_place_does_not_excuse_itself_by_its_own_systematic_residuals() -> None:
    place = optimum(0.0, 1880.0, inflation=4.0)
    far = optimum(80.0, 2160.0, sigma_m=28.0, inflation=45.0)
    assert [o for _, o in weighted([far, place])] == [place]


def test_no_optimum_leaves_the_hypotheses_as_they_are() -> None:
    hypotheses = (hypothesis(1.0), hypothesis(30.0))
    assert polished(hypotheses, [], 4.0, keep_confirmed=True) is hypotheses


def fused(params: TrackerParams, rows: np.ndarray) -> TargetTracker:
    tracker = TargetTracker(params)
    for index, row in enumerate(rows):
        measurement = RangingMeasurement(
            1,
            0.1 * index,
            range_m=None if math.isnan(row[3]) else float(row[3]),
            range_sigma_m=float(row[5]),
            bearing_enu_rad=None if math.isnan(row[4]) else float(row[4]),
            bearing_sigma_rad=float(row[6]),
        )
        tracker.fuse(measurement, (float(row[0]), float(row[1]), float(row[2])), 0.1 * index)
    return tracker


def test_mirror_image_is_kept_as_the_alternative() -> None:
    rows = walk(np.random.default_rng(8), bearings=False, straight=True)
    tracker = fused(TrackerParams(), rows)
    tracker.polish()
    estimate = tracker.estimate(20.0)
    assert estimate is not None
    assert estimate.state is EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is not None
    norths = sorted([estimate.position_enu_m[1], estimate.alternative_enu_m[1]])
    assert norths == pytest.approx([-25.0, 25.0], abs=1.0)
    assert estimate.r95_m > 40.0
