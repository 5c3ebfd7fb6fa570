"""The bounded-window MAP: its optima, their covariances, and where they come from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.hypotheses import RAY_DISTANCES_M
from companion.estimation.target_estimate import r95_of_covariance_m
from companion.estimation.window.map_kernels import (
    MAX_ITERATIONS,
    OlderEvidence,
    map_cost,
    map_descent,
    measured_innovations,
    row_sigmas,
)
from companion.estimation.window.optimizer import start_around
from companion.estimation.window.rivals import mirrored, weigh_optima
from companion.estimation.window.sandwich import shares_of
from companion.estimation.window.window_map import (
    MAX_POSITION_SIGMA_M,
    SAME_OPTIMUM_M,
    STEP_ITERATIONS,
    WindowMap,
)
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import (
    OFFSET_M,
    START,
    TARGET,
    TURN_RAD,
    params,
    reflected,
    repeating,
    walk,
)


def _solved(p: FilterParams, rows: Matrix, start: Vector = START) -> Vector:
    solution = WindowMap(p).solve(rows, start)
    assert solution is not None
    return solution[0]


@pytest.mark.parametrize(("ranges", "bearings"), [(True, True), (True, False), (False, True)])
def test_noiseless_walk_is_solved_exactly(ranges: bool, bearings: bool) -> None:
    rows = walk(np.random.default_rng(1), ranges=ranges, bearings=bearings, noise=0.0)
    weak_priors = params(range_offset_sigma_m=1e4, bearing_offset_sigma_deg=1e4)
    mean = _solved(weak_priors, rows, np.array([20.0, 10.0, 0.0, 0.0]))
    assert mean[:2] == pytest.approx(TARGET, abs=1e-3)
    if ranges:
        assert mean[2] == pytest.approx(OFFSET_M, abs=1e-3)
    if bearings:
        assert mean[3] == pytest.approx(TURN_RAD, abs=1e-4)


def test_solution_is_a_minimum_of_the_objective() -> None:
    """The paper's: robust losses, Gaussian priors of the offsets, none of the position."""
    rng, p = np.random.default_rng(2), params()
    rows = walk(rng)
    rows[::3, 3] += rng.exponential(8.0, len(rows[::3]))
    solution = WindowMap(p).solve(rows, np.array([30.0, 10.0, 0.0, 0.0]))
    assert solution is not None
    mean, cost = solution
    priors = np.diag([0.0, 0.0, 1.0 / 5.0**2, 1.0 / math.radians(5.0) ** 2])

    def objective(x: Vector) -> float:
        sigmas, offs = row_sigmas(rows, x, p.model), measured_innovations(rows, x, p.model)
        return float(map_cost(rows, offs, x, sigmas, p.thresholds, priors, np.zeros(4), p.model))

    assert cost == pytest.approx(objective(mean))
    for direction in np.concatenate([np.eye(4), -np.eye(4)]):
        assert objective(mean + 0.01 * direction) > cost


def test_one_sided_loss_beats_the_quadratic_one_under_reflections() -> None:
    errors: dict[str, list[float]] = {"one-sided": [], "quadratic": []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows = reflected(rng, walk(rng, bearings=False), 0.5)
        for name, k in (("one-sided", 1.0), ("quadratic", None)):
            mean = _solved(params(range_k_long=k), rows)
            errors[name].append(math.dist(mean[:2], TARGET))
    assert np.mean(errors["one-sided"]) < 0.5 * np.mean(errors["quadratic"])


def test_offset_stays_inside_its_bounds() -> None:
    rows = walk(np.random.default_rng(3))
    bounded = params(range_offset_min_m=0.0, range_offset_max_m=1.0)
    assert _solved(bounded, rows, np.array([30.0, 10.0, 5.0, 0.0]))[2] == 1.0


def test_where_the_offset_is_at_its_bound_the_place_is_still_the_best_there_is() -> None:
    """Return the position for an offset of one metre, solved with that offset known."""
    rows = walk(np.random.default_rng(3))
    bounded = params(range_offset_min_m=0.0, range_offset_max_m=1.0)
    shorter = np.array(rows)
    shorter[:, 3] -= 1.0
    known = _solved(params(range_offset_sigma_m=1e-9), shorter)
    np.testing.assert_allclose(_solved(bounded, rows)[:2], known[:2], rtol=0.0, atol=1e-2)


def test_height_and_scale_are_found_with_the_place() -> None:
    rng = np.random.default_rng(9)
    rows = walk(rng, elevations=True, height_m=4.0, scale=0.06)
    p = params(range_scale_sigma=0.05, target_height_sigma_m=5.0)
    (best,) = WindowMap(p).optima(rows, [np.append(START, [0.0, 0.0])])
    sigmas = np.sqrt(np.diag(best.covariance))
    expected = np.array([*TARGET, OFFSET_M, TURN_RAD, 0.06, 4.0])
    assert (np.abs(best.mean - expected) < 3.0 * sigmas + 1e-3).all()
    assert sigmas[5] < 1.5


# -- Several optima ------------------------------------------------------------------------------


def test_straight_walk_with_ranges_only_has_two_mirror_optima() -> None:
    rows = walk(np.random.default_rng(4), bearings=False, straight=True)
    solver = WindowMap(params())
    starts = [start_around(rows, 2.0 * math.pi * i / 12, i, params()) for i in range(12)]
    optima = solver.optima(rows, starts)
    assert len(weigh_optima(optima)) == 2
    norths = sorted(float(o.mean[1]) for o in optima[:2])
    assert norths[1] == pytest.approx(-norths[0], abs=0.05)
    assert optima[0].cost == pytest.approx(optima[1].cost, abs=1e-3)


def test_the_mirrored_optimum_is_a_start_that_finds_the_other_one() -> None:
    rows = walk(np.random.default_rng(4), bearings=False, straight=True)
    solver = WindowMap(params())
    (one,) = solver.optima(rows, [START])
    (both) = solver.optima(rows, [one.mean, mirrored(one.mean, rows[:, :2])])
    assert len(both) == 2
    np.testing.assert_allclose(both[1].mean[:2], both[0].mean[:2] * [1.0, -1.0], atol=0.05)


def test_the_same_optimum_is_reported_once_and_the_best_one_first() -> None:
    rows = walk(np.random.default_rng(5), bearings=False)
    solver = WindowMap(params())
    starts = [start_around(rows, 2.0 * math.pi * i / 12, i, params()) for i in range(12)]
    optima = solver.optima(rows, [*starts, *starts])
    costs = [optimum.cost for optimum in optima]
    assert costs == sorted(costs)
    positions = [optimum.mean[:2] for optimum in optima]
    for index, position in enumerate(positions):
        assert all(math.dist(position, other) > SAME_OPTIMUM_M for other in positions[:index])
    assert positions[0] == pytest.approx(TARGET, abs=2.0)


def test_fresh_starts_are_as_far_as_the_ranges_say() -> None:
    rows = walk(np.random.default_rng(5), bearings=False, noise=0.0)
    centre = rows[:, :2].mean(axis=0)
    expected_m = math.sqrt(float(np.median(rows[:, 3])) ** 2 - 10.0**2)
    for direction_rad in (0.0, 1.0, -2.0):
        start = start_around(rows, direction_rad, 0, params())
        away = start[:2] - centre
        assert math.hypot(*away) == pytest.approx(expected_m)
        assert math.atan2(away[1], away[0]) == pytest.approx(direction_rad)


def test_without_ranges_fresh_starts_take_turns_near_and_far() -> None:
    rows = walk(np.random.default_rng(5), ranges=False)
    centre = rows[:, :2].mean(axis=0)
    distances = [math.dist(start_around(rows, 0.3, i, params())[:2], centre) for i in range(9)]
    assert distances == pytest.approx([*RAY_DISTANCES_M, RAY_DISTANCES_M[0]])


# -- Covariances ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_covariance_covers_well_specified_noise() -> None:
    inside = 0
    solver = WindowMap(params(range_k_long=None, bearing_k=None))
    for seed in range(200):
        rows = walk(np.random.default_rng(1000 + seed))
        (optimum,) = solver.optima(rows, [START])
        error = optimum.mean[:2] - np.array(TARGET)
        nees = float(error @ np.linalg.solve(optimum.covariance[:2, :2], error))
        inside += nees < 5.991
    assert inside >= 0.93 * 200


def test_covariance_grows_when_neighbouring_residuals_repeat() -> None:
    rng = np.random.default_rng(5)
    solver = WindowMap(params())
    white, repeated = walk(rng), walk(rng, noise=0.0)
    repeated[:, 3] += np.repeat(rng.normal(0.0, 0.5, 10), 20)
    repeated[:, 4] = white[:, 4]
    (a,), (b,) = solver.optima(white, [START]), solver.optima(repeated, [START])
    assert np.trace(b.covariance[:2, :2]) > 3.0 * np.trace(a.covariance[:2, :2])
    assert b.inflation / shares_of(solver.spatial_noise)[0] > 2.0 * a.inflation


def test_noise_is_distinguished_from_its_repetition() -> None:
    """One measurement of a slow noise is as good as another; only its neighbours are not."""
    solver = WindowMap(params(range_k_long=None, bearing_k=None))
    rows = walk(np.random.default_rng(5), noise=0.0)
    slow, loud = np.array(rows), np.array(rows)
    slow[:, 3] += 0.5 * repeating(np.random.default_rng(6), 0.9, 200)[:, 0]
    loud[:, 3] += 1.5 * np.random.default_rng(6).normal(size=200)
    (a,), (b,) = solver.optima(slow, [START]), solver.optima(loud, [START])
    assert a.noise[0] < 2.0
    assert b.noise[0] == pytest.approx(9.0, rel=0.3)
    assert a.noise[1] == b.noise[1] == 1.0  # noiseless bearings promise no better than thermal


def test_reflections_count_less_than_thermal_noise_would() -> None:
    rng = np.random.default_rng(7)
    solver, rows = WindowMap(params(range_k_long=1.0)), walk(rng)
    (clear,) = solver.optima(rows, [START])
    (blocked,) = solver.optima(reflected(rng, rows, 0.8), [START])
    assert blocked.noise[0] > 1.5 * clear.noise[0]
    assert np.trace(blocked.covariance[:2, :2]) > np.trace(clear.covariance[:2, :2])


def test_known_white_noise_leaves_it_surer() -> None:
    rows = walk(np.random.default_rng(5))
    solver = WindowMap(params())
    (white,), (unknown,) = (solver.optima(rows, [START], is_white=w) for w in (True, False))
    assert white.mean.tobytes() == unknown.mean.tobytes()
    assert np.trace(white.covariance[:2, :2]) <= np.trace(unknown.covariance[:2, :2])


def test_influences_are_those_of_the_measurements() -> None:
    rows = reflected(np.random.default_rng(8), walk(np.random.default_rng(8)), 0.5)
    (best,) = WindowMap(params()).optima(rows, [START])
    assert best.scores.scored.shape == (3, 200)
    assert best.scores.scored[0].max() == 1.5
    assert best.scores.scored[1].min() >= -1.5
    assert not best.scores.scored[2].any()


# -- Where there is nothing to find --------------------------------------------------------------


def test_measurements_from_one_place_name_no_place() -> None:
    rows = walk(np.random.default_rng(6), bearings=False)
    rows[:, :2] = 0.0
    rows[:, 3] = 47.0
    solver = WindowMap(params(range_offset_sigma_m=1e3))
    assert solver.optima(rows, [np.array([40.0, 25.0, 0.0, 0.0])]) == []


def test_an_optimum_that_is_too_vague_is_none() -> None:
    rows = walk(np.random.default_rng(6), bearings=False)
    rows[:, :2] = [[0.1, 0.0]] * 100 + [[-0.1, 0.0]] * 100
    rows[:, 3] = 47.0 + 1e-4 * np.random.default_rng(6).normal(size=200)
    for optimum in WindowMap(params()).optima(rows, [START]):
        assert math.sqrt(np.trace(optimum.covariance[:2, :2])) <= MAX_POSITION_SIGMA_M


def test_from_nowhere_and_with_nothing_it_leads_nowhere() -> None:
    rows = walk(np.random.default_rng(6))
    assert WindowMap(params()).optima(rows, [np.full(4, np.nan)]) == []
    rows[:, 3:6] = np.nan
    assert WindowMap(params()).optima(rows, [START]) == []


def test_older_evidence_joins_the_prior() -> None:
    rows = walk(np.random.default_rng(6), 60)
    solver, elsewhere = WindowMap(params()), np.array([41.0, 25.0, OFFSET_M, TURN_RAD])
    L = np.diag([1e6, 1e6, 1e6, 1e9])
    older = OlderEvidence(L, L @ elsewhere, L)
    (pulled,) = solver.optima(rows, [START], older)
    np.testing.assert_allclose(pulled.mean, elsewhere, atol=1e-2)
    assert solver.size == 4


def towards(
    rng: np.random.Generator, noise: float, count: int = 30
) -> tuple[Matrix, tuple[float, float]]:
    """Straight towards a target that is 12 m off: bearings on one line, noise worse than thermal.

    Returns:
        (n, 10) rows, and the last position of the vehicle.
    """
    rows = np.full((count, 10), np.nan)
    along = np.concatenate([np.full(count // 2, 0.0), np.linspace(0.0, 2.5, count - count // 2)])
    rows[:, 0], rows[:, 1], rows[:, 2] = along, 0.0, 20.0
    slant = np.hypot(12.0 - along, 20.0)
    rows[:, 3] = slant + 1.5 + rng.exponential(8.0, count) + rng.normal(0.0, 1.5, count)
    rows[:, 4] = noise * rng.normal(0.0, 0.035, count)
    rows[:, 6:9] = 1.5, 0.035, 0.09
    rows[:, 9] = np.arange(count)
    return rows, (float(along[-1]), 0.0)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_a_place_right_before_the_vehicle_is_not_sure_of_itself(seed: int, noise: float) -> None:
    """Bearings along one line say nothing of how far the target is, however near it may be."""
    rows, (east, north) = towards(np.random.default_rng(seed), noise)
    solver = WindowMap(FilterParams())
    solver.set_bearing_inflation((10.0, noise**2, 1.0))
    starts = [np.array([east + d, north, 8.0, 0.0]) for d in (-0.5, 0.3, 1.0, 3.0, 9.0)]
    optima = solver.optima(rows, starts, is_white=True)
    for optimum in optima:
        miss_m = math.dist(optimum.mean[:2], (12.0, 0.0))
        assert miss_m <= max(2.0, r95_of_covariance_m(optimum.covariance[:2, :2]))


def test_the_own_position_excuses_less_where_bearings_are_worse_than_thermal() -> None:
    rows, _ = towards(np.random.default_rng(1), 3.0)
    near, far = np.array([2.7, 0.0, 9.0, 0.0]), np.array([12.0, 0.0, 6.5, 0.0])
    gains = []
    for inflation in (1.0, 9.0):
        solver = WindowMap(FilterParams())
        solver.set_bearing_inflation((1.0, inflation, 1.0))
        gains.append(np.abs(solver.scores(rows, near).u[1]) / np.abs(solver.scores(rows, far).u[1]))
    np.testing.assert_array_less(gains[0][-1], gains[1][-1])


def test_well_known_places_keep_their_covariance() -> None:
    """Near views count in full where the position is known much better than they are near."""
    rows = walk(np.random.default_rng(3), 400)
    solver = WindowMap(params())
    best = solver.optima(rows, [START], is_white=True)[0]
    spread_m2 = float(np.trace(best.covariance[:2, :2]))
    plain, bent = solver.scores(rows, best.mean), solver.scores(rows, best.mean, spread_m2)
    np.testing.assert_allclose(bent.H, plain.H, rtol=1e-3, atol=1e-6)


def test_a_place_so_far_off_that_nothing_points_to_it_is_no_optimum() -> None:
    rows = walk(np.random.default_rng(3), ranges=False)
    assert WindowMap(params()).optima(rows, [np.array([1e157, 4e157, 0.0, 0.0])]) == []


def test_a_long_descent_is_cut_into_pieces_that_come_to_the_same() -> None:
    rows, p = walk(np.random.default_rng(1), 120), params()
    solver, start = WindowMap(p), np.array([400.0, -300.0, 0.0, 0.0])
    begun, _, _, is_over = map_descent(
        rows, start, 1e-3, STEP_ITERATIONS, p.thresholds, p.bounds, *solver.prior, p.model
    )
    assert not is_over, "a start from which one piece is enough shows nothing"
    whole, *_ = map_descent(
        rows, start, 1e-3, MAX_ITERATIONS, p.thresholds, p.bounds, *solver.prior, p.model
    )
    pieces = list(solver.solve.steps(rows, start))
    solution = solver.solve(rows, start)
    assert len(pieces) >= 2
    assert solution is not None
    np.testing.assert_array_equal(solution[0], whole)
    assert not np.array_equal(begun, whole)
