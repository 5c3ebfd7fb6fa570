from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.map_kernels import COLUMNS as ROW_COLUMNS
from companion.estimation.window.map_kernels import normal_equations, row_sigmas
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix
from sim_link.lab.evaluation.campaign import run_block, run_trial
from sim_link.lab.evaluation.case import PAPER_BELIEF, Case, run_seeds
from sim_link.lab.evaluation.map_estimator import (
    EARLY_COUNT,
    FIRST_COUNT,
    cost_of,
    damped_step,
    fresh_start,
    minimum,
    next_solution,
    solved,
    system_at,
)
from sim_link.lab.evaluation.systems import System, window_of_system

TARGET_ENU_M = np.array([50.0, 50.0])
BELIEFS = {
    "the paper's": PAPER_BELIEF,
    "own place unsure, short ranges robust, offset bounded": msgspec.structs.replace(
        PAPER_BELIEF, own_position_sigma_m=0.4, range_k_short=3.0, range_offset_max_m=0.5
    ),
}
WINDOW = window_of_system(Case(), System("map", "latched"))


def _circle(count: int, excess_m: float = 0.0) -> Matrix:
    """Views from all around, exact but for every third range."""
    turn = 2.0 * math.pi * np.arange(count) / count
    place = 50.0 + 20.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    de, dn = (TARGET_ENU_M - place).T
    ranges_m = np.hypot(de, dn) + excess_m * (np.arange(count) % 3 == 0)
    return np.column_stack([place, ranges_m, np.arctan2(dn, de)])


def _companions_rows(rows: Matrix, belief: FilterParams) -> Matrix:
    """The same history as the companion's window holds it."""
    theirs = np.full((len(rows), ROW_COLUMNS), np.nan)
    theirs[:, :2], theirs[:, 2], theirs[:, 3:5] = rows[:, :2], 0.0, rows[:, 2:]
    theirs[:, 6:8] = belief.range_sigma_m, math.radians(belief.bearing_sigma_deg)
    return theirs


@pytest.mark.parametrize("name", BELIEFS)
def test_cost_and_system_are_those_of_the_companions_window(name: str) -> None:
    belief = BELIEFS[name]
    window = window_of_system(Case(belief=belief), System("map", "latched"))
    rng = np.random.default_rng(3)
    for _ in range(20):
        rows = _circle(30)
        rows[:, 2:] += rng.normal(0.0, [6.0, 0.3], (30, 2))
        mean = np.array([*rng.normal(TARGET_ENU_M, 25.0), *rng.normal(0.0, [2.0, 0.2])])
        theirs = _companions_rows(rows, belief)
        args = (belief.thresholds, window.information, window.pull, belief.model)
        sigmas = row_sigmas(theirs, mean, belief.model)
        expected, expected_descent, expected_cost = normal_equations(theirs, mean, sigmas, *args)
        curvature, descent = system_at(rows, mean, window)
        np.testing.assert_allclose(curvature, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(descent, expected_descent, rtol=1e-9, atol=1e-9)
        assert cost_of(rows, mean, window) == pytest.approx(expected_cost, rel=1e-9)


def test_it_finds_the_target_from_a_start_that_is_carried_away() -> None:
    away = np.array([-90.0, 120.0, 0.0, 0.0])
    mean, covariance = solved(_circle(30), away, 1, WINDOW)
    assert mean[:2] == pytest.approx(TARGET_ENU_M, abs=1e-3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


@pytest.mark.parametrize("name", BELIEFS)
def test_its_minimum_is_that_of_the_companions_window(name: str) -> None:
    belief = BELIEFS[name]
    window = window_of_system(Case(belief=belief), System("map", "latched"))
    rows = _circle(60, excess_m=9.0)
    start = np.array([55.0, 41.0, 0.0, 0.0])
    mean, _ = minimum(rows, start, window)
    theirs = WindowMap(belief).solve(_companions_rows(rows, belief), start)
    assert theirs is not None
    assert mean == pytest.approx(theirs[0], abs=1e-3)


def test_a_damped_step_solves_the_damped_system() -> None:
    rng = np.random.default_rng(5)
    for damping in (0.0, 1e-3, 10.0):
        half = rng.normal(size=(4, 4))
        curvature, descent = half @ half.T + 0.1 * np.eye(4), rng.normal(size=4)
        damped = curvature + damping * np.diag(np.diag(curvature))
        step = damped_step(curvature, descent, damping)
        np.testing.assert_allclose(step, np.linalg.solve(damped, descent), rtol=1e-6)


def test_a_fresh_start_lies_as_far_as_the_ranges_say() -> None:
    starts = np.array([fresh_start(_circle(30), turn, WINDOW.prior_mean) for turn in range(12)])
    distances_m = np.hypot(*(starts[:, :2] - TARGET_ENU_M).T)
    assert distances_m == pytest.approx(20.0, abs=1e-9)
    assert len({round(float(e), 3) for e in starts[:, 0]}) == 12


def test_it_is_solved_often_at_first_and_seldom_later() -> None:
    due, dues = FIRST_COUNT, []
    while due <= 500:
        dues.append(due)
        due = next_solution(due)
    assert dues[:6] == [4, 5, 6, 7, 8, 9]
    assert len([count for count in dues if count > EARLY_COUNT]) < 8


def test_it_brings_back_runs_that_carry_the_filter_away() -> None:
    case = Case(channel=Case().channel, belief=PAPER_BELIEF, steps=120, first_estimate="uniform")
    worst = {}
    for name in ("ekf", "map"):
        system = System("map" if name == "map" else "ekf", "latched")
        worst[name] = max(t.errors_m[-1] for t in run_block(case, system, run_seeds(1, 12)))
    assert worst["map"] < 0.5 < worst["ekf"]


def test_the_filter_alone_is_left_alone() -> None:
    seed = run_seeds(2, 1)[0]
    case = Case(steps=FIRST_COUNT + 1)
    alone, corrected = (
        run_trial(case, System(name, "passive"), seed).estimates_enu_m
        for name in ("asymmetric_huber", "map")
    )
    before = FIRST_COUNT - 1
    assert np.array_equal(alone[:before], corrected[:before])
    assert not np.array_equal(alone[before:], corrected[before:])
