from __future__ import annotations

import math
from typing import Any, get_args

import msgspec
import numpy as np
import pytest

from sim_link.world.environment import ObstacleParams, ShadowParams
from tools.study.case import (
    TRUTH,
    Case,
    FirstEstimate,
    run_inputs,
    run_seeds,
    stream,
    truth_of,
)
from tools.study.systems import FilterName, PlannerName, System, system_named
from tools.study.trials import (
    TrialResult,
    flown_trial,
    run_block,
    run_trial,
)
from tools.study.walk import BEARING_OFFSET, RANGE_OFFSET

SHORT = Case(steps=40)
SEED = run_seeds(3, 1)[0]
BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))


def _flown(case: Case, system: System) -> TrialResult:
    """The same run over the classes that fly, without the compiled walk."""
    return flown_trial(case, system, SEED)


FLYING = [planner for planner in get_args(PlannerName) if planner != "fim_printed"]
"""Planners that are classes, too."""
COMPILED = [name for name in get_args(FilterName) if System(name, "fim").is_compiled]
RECURSIVE = [name for name in COMPILED if name != "map"]


@pytest.mark.parametrize("planner", FLYING)
@pytest.mark.parametrize("kind", RECURSIVE)
def test_the_compiled_walk_is_the_classes_walk(kind: str, planner: str) -> None:
    system = system_named(f"{kind}/{planner}")
    ours, theirs = run_trial(SHORT, system, SEED), _flown(SHORT, system)
    np.testing.assert_allclose(ours.record, theirs.record, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.r95_m, theirs.r95_m, rtol=1e-9)


@pytest.mark.parametrize(
    "scene",
    [
        {"obstacles": (BLOCK,)},
        {"obstacles": (BLOCK,), "shadow": ShadowParams()},
        {"nlos_draws": "separate"},
    ],
)
def test_obstacles_and_separate_draws_are_the_same_both_ways(scene: dict[str, Any]) -> None:
    case = msgspec.structs.replace(SHORT, **scene)
    system = system_named("asymmetric_huber/latched")
    ours = run_trial(case, system, SEED).record
    np.testing.assert_allclose(ours, _flown(case, system).record, rtol=1e-9, atol=1e-9)
    assert not np.array_equal(ours, run_trial(SHORT, system, SEED).record)


def test_what_has_no_class_is_not_flown_by_classes() -> None:
    for name in ("map/latched", "asymmetric_huber/fim_printed"):
        with pytest.raises(ValueError, match=r"class|flies"):
            _flown(SHORT, system_named(name))


@pytest.mark.parametrize("first", get_args(FirstEstimate))
def test_first_estimates_are_the_same_both_ways(first: FirstEstimate) -> None:
    case = msgspec.structs.replace(SHORT, first_estimate=first)
    system = system_named("asymmetric_huber/latched")
    np.testing.assert_allclose(
        run_trial(case, system, SEED).record, _flown(case, system).record, rtol=1e-9, atol=1e-9
    )


def test_the_first_estimate_is_the_first_measurement_inverted() -> None:
    trial = run_trial(msgspec.structs.replace(SHORT, steps=1), System("ekf", "passive"), SEED)
    assert trial.record[0, 6:].tolist() == [900.0, 0.0, 900.0]
    assert trial.record[0, RANGE_OFFSET] == trial.record[0, BEARING_OFFSET] == 0.0
    assert trial.track_enu_m[0].tolist() == list(SHORT.start_enu_m)


def test_a_drawn_first_estimate_is_corrected_by_the_first_measurement() -> None:
    case = msgspec.structs.replace(SHORT, first_estimate="uniform", steps=1)
    trials = run_block(case, System("ekf", "passive"), run_seeds(1, 5))
    assert all(trial.record[0, 6] < 900.0 for trial in trials)
    starts = np.array([run_inputs(case, seed)[2] for seed in run_seeds(1, 200)])
    assert starts.min() >= 0.0
    assert starts.max() <= 100.0
    assert np.ptp(starts) > 90.0


def test_a_trial_is_a_function_of_its_seed() -> None:
    system = System("asymmetric_huber", "reactive")
    one, other = run_block(SHORT, system, run_seeds(1, 2))
    assert np.array_equal(one.record, run_trial(SHORT, system, run_seeds(1, 1)[0]).record)
    assert not np.array_equal(one.record, other.record)


def test_the_tracker_states_its_own_radius() -> None:
    trial = run_trial(msgspec.structs.replace(SHORT, steps=80), System("tracker", "latched"), SEED)
    assert trial.stated_r95_m is not None
    assert trial.errors_m[-1] < 1.0
    assert np.isfinite(trial.nees).all()


def test_planners_fly_at_most_a_step() -> None:
    for planner in get_args(PlannerName):
        trial = run_trial(SHORT, System("asymmetric_huber", planner), SEED)
        assert np.hypot(*np.diff(trial.track_enu_m, axis=0).T).max() <= SHORT.step_m + 1e-9


def test_what_a_result_says() -> None:
    truth = truth_of(SHORT, stream(SEED, TRUTH))
    record = np.array([[1.0, 2.0, 53.0, 54.0, 1.4, math.pi, 4.0, 0.0, 16.0]])
    trial = TrialResult(truth, record)
    assert trial.errors_m.tolist() == [5.0]
    assert trial.nees.tolist() == [9.0 / 4.0 + 16.0 / 16.0]
    assert trial.track_enu_m.tolist() == [[1.0, 2.0]]
    assert trial.record[:, RANGE_OFFSET].tolist() == [1.4]
    assert trial.record[:, BEARING_OFFSET].tolist() == [math.pi]
    assert 4.0 * 1.9 < trial.r95_m[0] < 4.0 * 2.5
