from __future__ import annotations

import math

import numpy as np
import pytest

from companion.kernel import Matrix
from tools.study.case import PAPER_BELIEF, Case, run_seeds
from tools.study.systems import System, belief_of
from tools.study.trials import run_block, run_trial
from tools.study.walk import (
    EARLY_COUNT,
    FIRST_COUNT,
    fresh_start,
    history_of,
    next_solution,
    solved,
)

TARGET_ENU_M = np.array([50.0, 50.0])
SYSTEM = System("map", "latched")
BELIEF = belief_of(Case(), SYSTEM)


def _circle(count: int) -> Matrix:
    """Exact views from all around, as the companion's window holds them."""
    turn = 2.0 * math.pi * np.arange(count) / count
    rows = history_of(count, BELIEF)
    rows[:, :2], rows[:, 2] = 50.0 + 20.0 * np.column_stack([np.cos(turn), np.sin(turn)]), 0.0
    de, dn = (TARGET_ENU_M - rows[:, :2]).T
    rows[:, 3], rows[:, 4] = np.hypot(de, dn), np.arctan2(dn, de)
    return rows


def test_it_finds_the_target_from_a_start_that_is_carried_away() -> None:
    away = np.array([-90.0, 120.0, 0.0, 0.0])
    mean, covariance = solved(_circle(30), away, 1, BELIEF)
    assert mean[:2] == pytest.approx(TARGET_ENU_M, abs=1e-3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_a_fresh_start_lies_as_far_as_the_ranges_say() -> None:
    starts = np.array([fresh_start(_circle(30), turn, BELIEF.prior_mean) for turn in range(12)])
    distances_m = np.hypot(*(starts[:, :2] - TARGET_ENU_M).T)
    assert distances_m == pytest.approx(20.0, abs=1e-9)
    assert len({round(float(e), 3) for e in starts[:, 0]}) == 12


def test_no_information_at_all_is_no_error() -> None:
    rows = _circle(4)
    rows[:] = rows[0]
    mean, covariance = solved(rows, BELIEF.prior_mean, 1, BELIEF)
    assert np.isfinite(mean).all()
    assert np.isfinite(covariance).all()


def test_it_is_solved_often_at_first_and_seldom_later() -> None:
    due, dues = FIRST_COUNT, []
    while due <= 500:
        dues.append(due)
        due = next_solution(due)
    assert dues[:6] == [4, 5, 6, 7, 8, 9]
    assert len([count for count in dues if count > EARLY_COUNT]) < 8


@pytest.mark.slow
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
