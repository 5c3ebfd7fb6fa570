from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.window_map import WindowMap
from sim_link.evaluation.case import PAPER_BELIEF, Case
from sim_link.evaluation.noise import run_seeds
from sim_link.evaluation.systems import System, window_of_system
from sim_link.evaluation.trial import run_block, run_trial
from sim_link.evaluation.window import (
    EARLY_COUNT,
    FIRST_COUNT,
    empty_rows,
    fresh_start,
    next_solution,
    remember,
    solved,
)

TARGET_ENU_M = np.array([50.0, 50.0])
WINDOW = window_of_system(Case(), System("map", "latched"))
SIGMA = np.array([1.5, math.radians(2.0), math.nan])


def _circle(count: int, excess_m: float = 0.0) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Views from all around, exact but for every third range."""
    rows = empty_rows(count)
    for step in range(count):
        turn = 2.0 * math.pi * step / count
        place = np.array([50.0 + 20.0 * math.cos(turn), 50.0 + 20.0 * math.sin(turn), 0.0])
        de, dn = TARGET_ENU_M - place[:2]
        range_m = math.hypot(de, dn) + (excess_m if step % 3 == 0 else 0.0)
        remember(rows, step, place, np.array([range_m, math.atan2(dn, de), math.nan]), SIGMA)
    return rows


def test_it_finds_the_target_from_a_start_that_is_carried_away() -> None:
    away = np.array([-90.0, 120.0, 0.0, 0.0])
    mean, covariance = solved(_circle(30), away, 1, WINDOW)
    assert mean[:2] == pytest.approx(TARGET_ENU_M, abs=1e-3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_its_minimum_is_that_of_the_companions_window() -> None:
    rows = _circle(60, excess_m=9.0)
    start = np.array([55.0, 41.0, 0.0, 0.0])
    mean, _ = solved(rows, start, 1, WINDOW)
    theirs = WindowMap(PAPER_BELIEF).solve(rows, start)
    assert theirs is not None
    assert mean == pytest.approx(theirs[0], abs=1e-3)


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
