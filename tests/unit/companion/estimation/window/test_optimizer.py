"""Effect on the hypotheses of solving the window now and then."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from companion.domain import EstimateState
from companion.estimation.filters.target_filter import NO_INFLATION, FilterParams, FilterState
from companion.estimation.hypotheses import Hypothesis
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.optimizer import WindowOptimizer, start_around
from companion.estimation.window.sandwich import MIN_MEASUREMENTS
from companion.estimation.window.window_map import (
    MAX_POSITION_SIGMA_M,
    WindowMap,
    WindowParams,
)
from companion.kernel import Matrix
from tests.unit.companion.estimation.walks import (
    OFFSET_M,
    START,
    TARGET,
    TURN_RAD,
    measurement_of,
    params,
    truth,
    walk,
)

P = params()


def _hypothesis(
    east_m: float, north_m: float, sigma_m: float = 0.5, time_s: float = 3.0
) -> Hypothesis:
    covariance = np.diag([sigma_m**2, sigma_m**2, 1.0, 0.01])
    mean = np.array([east_m, north_m, 0.0, 0.0])
    return Hypothesis(0.0, FilterState.of(time_s, mean, covariance))


NEAR = _hypothesis(35.0, 20.0)
SETTLED = Hypothesis(0.0, FilterState.of(3.0, truth(), np.diag([0.01, 0.01, 0.01, 1e-6])))


def _fed(
    rows: Matrix,
    hypotheses: tuple[Hypothesis, ...] = (NEAR,),
    p: FilterParams = P,
    size: int = 512,
    *,
    is_white: bool = True,
) -> WindowOptimizer:
    optimizer = WindowOptimizer(p, WindowParams(size=size))
    for row in rows:
        mean = hypotheses[0].state.mean
        dropped = optimizer.window.add(row, (float(mean[0]), float(mean[1])))
        if len(dropped) and len(hypotheses) == 1 and is_white:
            optimizer.keep_evidence(dropped, mean)
    return optimizer


def _optimized(
    optimizer: WindowOptimizer,
    hypotheses: tuple[Hypothesis, ...] = (NEAR,),
    fresh: int | None = 0,
    *,
    is_white: bool = True,
) -> tuple[Hypothesis, ...]:
    return optimizer.optimize(hypotheses, 1000, NO_INFLATION, is_white=is_white, fresh_starts=fresh)


# -- When ----------------------------------------------------------------------------------------


def test_it_is_solved_often_at_first_and_steadily_later() -> None:
    optimizer = WindowOptimizer(P, WindowParams(every=25))
    due = []
    for accepted in range(1, 601):
        if accepted >= optimizer.due_at:
            due.append(accepted)
            optimizer.optimize((), accepted, NO_INFLATION, is_white=True, fresh_starts=0)
    assert due[0] == MIN_MEASUREMENTS
    gaps = np.diff(due)
    assert gaps[0] == 1
    assert (np.diff(gaps) >= 0).all()
    assert gaps[-1] == 25


def test_it_can_be_switched_off() -> None:
    optimizer = WindowOptimizer(P, WindowParams(enabled=False))
    assert optimizer.due_at == math.inf


def test_before_there_is_enough_it_leaves_the_hypotheses_alone() -> None:
    rows = walk(np.random.default_rng(1))
    few, hypotheses = _fed(rows[: MIN_MEASUREMENTS - 1]), (NEAR,)
    assert _optimized(few, hypotheses) is hypotheses
    assert few.noise is None
    assert _optimized(_fed(rows), ()) == ()


# -- What becomes of a hypothesis ----------------------------------------------------------------


@pytest.mark.parametrize("away", [_hypothesis(35.0, 20.0), _hypothesis(80.0, 60.0)])
def test_a_hypothesis_becomes_the_optimum_it_leads_to(away: Hypothesis) -> None:
    rows = walk(np.random.default_rng(1))
    optimizer = _fed(rows)
    (moved,) = _optimized(optimizer, (away,))
    (best,) = WindowMap(P).optima(rows, [START], is_white=True)
    np.testing.assert_allclose(moved.state.mean, best.mean, atol=1e-3)
    np.testing.assert_allclose(moved.state.covariance, best.covariance, rtol=1e-2, atol=1e-6)
    assert moved.state.time_s == 3.0
    assert moved.log_weight == 0.0
    assert optimizer.noise is not None
    assert optimizer.noise[:2] == pytest.approx(best.noise[:2], rel=1e-2)


def test_where_residuals_repeat_each_other_the_window_has_the_last_word_on_certainty() -> None:
    optimizer = _fed(walk(np.random.default_rng(1), rho=0.8), is_white=False)
    (repeating,) = _optimized(optimizer, is_white=False)
    assert repeating.least_covariance_m2 is not None
    np.testing.assert_array_equal(repeating.least_covariance_m2, repeating.state.covariance[:2, :2])
    (white,) = _optimized(_fed(walk(np.random.default_rng(1))))
    assert white.least_covariance_m2 is None


def test_two_hypotheses_of_one_optimum_become_one() -> None:
    optimizer = _fed(walk(np.random.default_rng(1)))
    assert len(_optimized(optimizer, (NEAR, _hypothesis(45.0, 30.0)))) == 1


def test_a_place_that_explains_nothing_is_dropped() -> None:
    rows = walk(np.random.default_rng(1), bearings=False)
    hypotheses = (_hypothesis(40.0, -30.0), NEAR)
    (kept,) = _optimized(_fed(rows, hypotheses), hypotheses)
    assert kept.position_enu_m == pytest.approx(TARGET, abs=2.0)


@pytest.mark.parametrize(("reach_m", "vague_m"), [(None, MAX_POSITION_SIGMA_M), (1e3, 1e3)])
def test_where_no_place_is_found_the_hypotheses_stay_and_are_vague(
    reach_m: float | None, vague_m: float
) -> None:
    rows = walk(np.random.default_rng(1), bearings=False)
    rows[:, :2], rows[:, 3] = 0.0, 47.0
    vague = params(range_offset_sigma_m=1e4, reach_m=reach_m)
    hypotheses = (_hypothesis(40.0, 25.0), _hypothesis(-40.0, 25.0))
    kept = _optimized(_fed(rows, hypotheses, vague), hypotheses)
    for one, before in zip(kept, hypotheses, strict=True):
        assert one.state is before.state
        assert one.least_covariance_m2 is not None
        assert np.sqrt(one.least_covariance_m2[0, 0]) == vague_m


# -- Mirror images and fresh starts --------------------------------------------------------------


def test_on_a_straight_track_the_mirror_image_is_found() -> None:
    """From one hypothesis on one side, by the start that is its image."""
    rows = walk(np.random.default_rng(4), bearings=False, straight=True)
    one, other = sorted(_optimized(_fed(rows), fresh=1), key=lambda h: h.position_enu_m[1])
    assert one.position_enu_m[0] == pytest.approx(other.position_enu_m[0], abs=0.1)
    assert one.position_enu_m[1] == pytest.approx(-other.position_enu_m[1], abs=0.1)
    assert other.position_enu_m[1] == pytest.approx(25.0, abs=1.5)
    assert one.log_weight == pytest.approx(other.log_weight, abs=0.05)


def test_a_bearing_tells_the_image_from_the_target() -> None:
    rows = walk(np.random.default_rng(4), straight=True)
    (only,) = _optimized(_fed(rows), fresh=4)
    assert only.position_enu_m == pytest.approx(TARGET, abs=2.0)


def test_fresh_starts_turn_around_the_path_until_every_optimum_is_found() -> None:
    """From a hypothesis that is caught on the wrong side; the image of it is no way out."""
    rows = walk(np.random.default_rng(5), bearings=False)
    solver = WindowMap(P)
    starts = [start_around(rows, 2.0 * math.pi * i / 12, i, P) for i in range(12)]
    caught = max(solver.optima(rows, starts), key=lambda o: math.dist(o.mean[:2], TARGET))
    caught_at = _hypothesis(float(caught.mean[0]), float(caught.mean[1]))
    hypotheses: tuple[Hypothesis, ...] = (caught_at,)
    optimizer = _fed(rows, hypotheses)
    for _ in range(12):
        hypotheses = _optimized(optimizer, hypotheses, fresh=1)
    assert hypotheses[0].position_enu_m == pytest.approx(TARGET, abs=2.0)


def _tracked(rows: Matrix, tracker_params: TrackerParams) -> TargetTracker:
    tracker = TargetTracker(tracker_params)
    for index, row in enumerate(rows):
        seen, position = measurement_of(row, 0.1 * index)
        assert tracker.fuse(seen, position, 0.1 * index).reject_reason is None
    return tracker


@pytest.mark.parametrize("is_thorough", [False, True])
def test_mirror_image_is_kept_as_the_alternative(is_thorough: bool) -> None:
    rows = walk(np.random.default_rng(8), bearings=False, straight=True)
    tracker = _tracked(rows, TrackerParams())
    if is_thorough:
        tracker.optimize(tracker.params.window.starts)
    else:
        tracker.optimize()
    estimate = tracker.estimate(20.0)
    assert estimate is not None
    assert estimate.state is EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is not None
    norths = sorted([estimate.position_enu_m[1], estimate.alternative_enu_m[1]])
    assert norths == pytest.approx([-25.0, 25.0], abs=1.0)
    assert estimate.alternative_enu_m[0] == pytest.approx(estimate.position_enu_m[0], abs=0.5)
    assert estimate.r95_m > 40.0


# -- Older evidence ------------------------------------------------------------------------------


def _sigma_m(hypothesis: Hypothesis) -> float:
    return math.sqrt(float(np.trace(hypothesis.state.covariance[:2, :2])))


def test_what_no_longer_fits_still_counts_where_it_is_news() -> None:
    rows = walk(np.random.default_rng(6), 1000)
    at = (SETTLED,)
    (white,) = _optimized(_fed(rows, at, size=128), at)
    (repeating,) = _optimized(_fed(rows, at, size=128, is_white=False), at)
    torn = (*at, _hypothesis(0.0, 90.0))
    (undecided,) = _optimized(_fed(rows, torn, size=128), at)
    assert _sigma_m(white) < 0.6 * _sigma_m(repeating)
    assert _sigma_m(undecided) == pytest.approx(_sigma_m(repeating))
    (everything,) = _optimized(_fed(rows, at, size=2048), at)
    assert _sigma_m(white) == pytest.approx(_sigma_m(everything), rel=0.25)


def test_what_was_expanded_about_a_wrong_place_is_forgotten() -> None:
    """The filter was sure of the wrong position while the window overflowed, unlike the window."""
    rows = walk(np.random.default_rng(6), 400)
    wrong = (_hypothesis(70.0, 60.0),)
    misled, distrusted = (_fed(rows, wrong, size=128) for _ in range(2))
    kept = distrusted.window.rows.tolist()
    distrusted.latest = deque(map(np.array, kept))
    distrusted.begin_with_latest()
    (best,) = _optimized(misled, wrong)
    (alone,) = _optimized(distrusted, wrong)
    assert best.position_enu_m == pytest.approx(TARGET, abs=1.0)
    np.testing.assert_allclose(best.state.mean, alone.state.mean, atol=2e-3)
    np.testing.assert_allclose(_sigma_m(best), _sigma_m(alone), rtol=0.05)
    (again,) = _optimized(misled, (best,))
    np.testing.assert_allclose(again.state.mean, alone.state.mean, atol=2e-3)


def test_what_was_expanded_about_the_right_place_is_kept() -> None:
    rows = walk(np.random.default_rng(6), 1000)
    at = (SETTLED,)
    optimizer = _fed(rows, at, size=128)
    (once,) = _optimized(optimizer, at)
    (twice,) = _optimized(optimizer, (once,))
    assert _sigma_m(twice) == pytest.approx(_sigma_m(once), rel=0.05)


def test_a_window_that_names_no_place_by_itself_contradicts_nothing() -> None:
    """Hovering for long with a range radio: only what is remembered knows the direction."""
    p = params(range_offset_sigma_m=0.1)
    at = (_hypothesis(*TARGET, sigma_m=0.1),)
    rows = np.tile(walk(np.random.default_rng(1), 1, noise=0.0), (1500, 1))
    rows[:, 3] += np.random.default_rng(2).normal(0.0, 0.5, 1500) - OFFSET_M
    is_borne = (np.arange(1500) > 0) & (np.arange(1500) < 20)
    rows[:, 4] = np.where(is_borne, rows[:, 4] - TURN_RAD, np.nan)
    optimizer = _fed(rows, at, p, size=32)
    assert not optimizer.window.has_bearings
    (only,) = _optimized(optimizer, at)
    assert only.position_enu_m == pytest.approx(TARGET, abs=2.5)
    assert only.least_covariance_m2 is None  # a position was found
    assert 0.5 < _sigma_m(only) < 10.0


# -- The rest ------------------------------------------------------------------------------------


def test_what_was_measured_can_be_forgotten() -> None:
    optimizer = _fed(walk(np.random.default_rng(1)))
    _optimized(optimizer)
    assert optimizer.window.has_bearings
    assert optimizer.observability(START) is not None
    optimizer.clear()
    assert not optimizer.window.has_bearings
    assert optimizer.noise is None
    assert optimizer.observability(START) is None
    assert optimizer.due_at <= MIN_MEASUREMENTS
    hypotheses = (NEAR,)
    assert _optimized(optimizer, hypotheses) is hypotheses


def test_it_tells_what_the_track_can_tell() -> None:
    straight = _fed(walk(np.random.default_rng(1), straight=True)).observability(START)
    bent = _fed(walk(np.random.default_rng(1))).observability(START)
    assert straight is not None
    assert bent is not None
    assert straight.is_collinear
    assert not bent.is_collinear
