"""A belief that outlives its tracker: doubted, honest, and far better than a fresh start."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import DEFAULT_ACCURACY, EstimateState, PositionAccuracy
from companion.estimation.belief import RESTORED_VARIANCE_FACTOR, Belief, StoredHypothesis
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.kernel import Matrix
from tests.unit.companion.estimation.walks import TARGET, measurement_of, params, reflected, walk

PARAMS = TrackerParams(filter=params(range_sigma_m=0.5, bearing_sigma_deg=1.7))


def flown(tracker: TargetTracker, rows: Matrix) -> TargetTracker:
    for number, row in enumerate(rows):
        measurement, sensor_enu_m = measurement_of(row, 0.1 * number)
        tracker.fuse(measurement, sensor_enu_m, 0.1 * number)
    return tracker


def belief_after(rows: Matrix) -> Belief:
    belief = flown(TargetTracker(PARAMS), rows).belief
    assert belief is not None
    return belief


def error_and_r95_m(tracker: TargetTracker) -> tuple[float, float]:
    estimate = tracker.estimate(0.0)
    assert estimate is not None
    return math.dist(estimate.position_enu_m, TARGET), estimate.r95_m


def test_before_the_first_measurement_nothing_is_believed() -> None:
    assert TargetTracker(PARAMS).belief is None


def test_a_belief_comes_back_with_doubt_that_grows_with_its_age() -> None:
    belief = belief_after(walk(np.random.default_rng(1), 150))
    before = np.array(belief.places[0].covariance)
    for age_s in (0.0, 100.0):
        tracker = TargetTracker(PARAMS)
        assert tracker.resume(belief, age_s, 7.0) is None
        state = tracker.hypotheses[0].state
        assert state.time_s == 7.0
        assert tuple(state.mean) == belief.places[0].mean
        grown = state.covariance - RESTORED_VARIANCE_FACTOR * before
        assert grown[:2, :2] == pytest.approx(np.eye(2) * 0.01 * age_s)
        assert grown[2:, 2:] == pytest.approx(0.0)
        assert tracker.emitter_id == 1
        assert tracker.last_accepted_s is None


@pytest.mark.slow
def test_a_resumed_tracker_is_far_ahead_of_a_cold_one_and_keeps_its_word() -> None:
    resumed, cold, kept = [], [], 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rows = reflected(rng, walk(rng, 190), 0.9)
        second, third = TargetTracker(PARAMS), TargetTracker(PARAMS)
        assert second.resume(belief_after(rows[:150]), 10.0, 0.0) is None
        error_m, r95_m = error_and_r95_m(flown(second, rows[150:]))
        kept += error_m <= r95_m
        resumed.append(error_m)
        cold.append(error_and_r95_m(flown(third, rows[150:]))[0])
    assert np.median(resumed) < 0.25 * np.median(cold)
    assert np.median(resumed) < 1.0
    assert kept >= 7


def test_two_mirror_images_come_back_as_two() -> None:
    rows = walk(np.random.default_rng(3), 60, bearings=False, straight=True)
    belief = belief_after(rows)
    assert len(belief.places) == 2
    tracker = TargetTracker(PARAMS)
    assert tracker.resume(belief, 5.0, 0.0) is None
    estimate = tracker.estimate(0.0)
    assert estimate is not None
    assert estimate.state is EstimateState.AMBIGUOUS


@pytest.mark.slow
def test_a_belief_that_was_wrong_is_given_up() -> None:
    rows = walk(np.random.default_rng(4), 400)
    belief = belief_after(rows[:150])
    first = belief.places[0]
    elsewhere = replace(first, mean=(first.mean[0] + 60.0, first.mean[1], *first.mean[2:]))
    tracker = TargetTracker(PARAMS)
    assert tracker.resume(replace(belief, places=(elsewhere,)), 1.0, 0.0) is None
    error_m, r95_m = error_and_r95_m(flown(tracker, rows))
    assert error_m <= r95_m < 5.0


GOOD = StoredHypothesis(
    0.0, (10.0, 20.0, 1.0, 0.0), tuple(tuple(row) for row in np.eye(4).tolist())
)


def with_row(row: tuple[float, ...]) -> StoredHypothesis:
    return replace(GOOD, covariance=(row, *GOOD.covariance[1:]))


@pytest.mark.parametrize(
    ("hypotheses", "problem"),
    [
        ((), "0 hypotheses"),
        ((GOOD,) * 33, "33 hypotheses"),
        ((replace(GOOD, mean=(1.0, 2.0)),), "another size"),
        ((replace(GOOD, covariance=GOOD.covariance[:3]),), "another size"),
        ((with_row((1.0,)),), "another size"),
        ((replace(GOOD, mean=(math.nan, 0.0, 0.0, 0.0)),), "not a number"),
        ((replace(GOOD, log_weight=math.inf),), "not a number"),
        ((with_row((math.inf, 0.0, 0.0, 0.0)),), "not a number"),
        ((replace(GOOD, mean=(0.0, -2e5, 0.0, 0.0)),), "horizon"),
        ((with_row((1.0, 0.5, 0.0, 0.0)),), "symmetric"),
        ((with_row((1e11, 0.0, 0.0, 0.0)),), "variance"),
        ((with_row((-1.0, 0.0, 0.0, 0.0)),), "variance"),
        ((with_row((0.0, 0.0, 0.0, 0.0)),), "variance"),
        (
            (
                replace(
                    GOOD,
                    covariance=((1.0, 2.0, 0.0, 0.0), (2.0, 1.0, 0.0, 0.0), *GOOD.covariance[2:]),
                ),
            ),
            "not positive",
        ),
        ((GOOD, replace(GOOD, mean=(math.nan, 0.0, 0.0, 0.0))), "not a number"),
    ],
)
def test_nothing_begins_from_an_impossible_belief(
    hypotheses: tuple[StoredHypothesis, ...], problem: str
) -> None:
    tracker = TargetTracker(PARAMS)
    refusal = tracker.resume(Belief(1, 10, hypotheses), 1.0, 0.0)
    assert refusal is not None
    assert problem in refusal
    assert tracker.belief is None


def test_a_belief_about_another_emitter_is_refused() -> None:
    tracker = TargetTracker(PARAMS, emitter_id=2)
    assert tracker.resume(Belief(1, 10, (GOOD,)), 1.0, 0.0) == "another emitter"
    assert tracker.resume(Belief(2, -1, (GOOD,)), 1.0, 0.0) is not None
    assert tracker.resume(Belief(2, 10, (GOOD,)), 1.0, 0.0) is None


RTK, CITY = (
    PositionAccuracy(0.02, 0.03, is_reported=True),
    PositionAccuracy(6.0, 9.0, is_reported=True),
)


def own_after(*accuracies: PositionAccuracy | None) -> TargetTracker:
    tracker = TargetTracker(PARAMS)
    for number, row in enumerate(walk(np.random.default_rng(4), len(accuracies))):
        measurement, sensor_enu_m = measurement_of(row, 0.1 * number)
        tracker.fuse(measurement, sensor_enu_m, 0.1 * number, accuracies[number])
    return tracker


def test_the_own_place_counts_as_it_was_at_the_worst_while_measuring() -> None:
    for accuracies in ((RTK, CITY, RTK, None), (None, CITY, None, RTK)):
        estimate = own_after(*accuracies).estimate(1.0)
        assert estimate is not None
        assert estimate.own == CITY
    estimate = own_after(RTK, DEFAULT_ACCURACY, RTK).estimate(1.0)
    assert estimate is not None
    assert estimate.own == DEFAULT_ACCURACY


def test_what_was_not_measured_from_does_not_count() -> None:
    tracker = own_after(RTK)
    measurement, _ = measurement_of(walk(np.random.default_rng(4), 1)[0], 0.1)
    assert tracker.fuse(measurement, None, 0.1, CITY).reject_reason is not None
    assert tracker.own == RTK
    tracker.restart()
    assert tracker.own is None


def test_a_belief_keeps_how_well_the_own_place_was_known() -> None:
    belief = own_after(*[CITY] * 5).belief
    assert belief is not None
    for kept, expected in ((belief, CITY), (replace(belief, own=None), DEFAULT_ACCURACY)):
        tracker = TargetTracker(PARAMS)
        assert tracker.resume(kept, 1.0, 7.0) is None
        assert tracker.own == expected


@pytest.mark.parametrize("sigma_m", [-1.0, math.nan, math.inf])
def test_an_impossible_accuracy_is_no_belief(sigma_m: float) -> None:
    belief = belief_after(walk(np.random.default_rng(1), 5))
    for own in (PositionAccuracy(sigma_m, 1.0), PositionAccuracy(1.0, sigma_m)):
        assert replace(belief, own=own).problem(len(belief.places[0].mean)) is not None


@pytest.mark.parametrize("jumped_m", [math.nan, math.inf, -1e9])
def test_an_impossible_jump_is_no_belief(jumped_m: float) -> None:
    belief = belief_after(walk(np.random.default_rng(1), 5))
    for jumped_en_m in ((jumped_m, 0.0), (0.0, jumped_m)):
        own = PositionAccuracy(1.0, 2.0, jumped_en_m=jumped_en_m)
        problem = replace(belief, own=own).problem(len(belief.places[0].mean))
        assert problem == "an impossible jump of the position"
