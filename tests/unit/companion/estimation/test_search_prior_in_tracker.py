"""The area searched in vain, in the weights of a tracker's hypotheses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import EstimateState, RangingMeasurement
from companion.estimation.filters.target_filter import FilterState
from companion.estimation.hypotheses import Hypothesis, probabilities, ranked
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import SearchPrior, SearchState

SQUARE = ((-200.0, -200.0), (200.0, -200.0), (200.0, 200.0), (-200.0, 200.0))


def searched(side: float) -> SearchPrior:
    """Half of the square, north or south of the equator, was searched to 95 %."""
    grid = grid_over([WeightedArea(SQUARE)], 20.0)
    return SearchPrior.of(SearchState(grid, np.where(side * grid.centres_enu_m[:, 1] > 0, 0.95, 0)))


def ranged(prior: SearchPrior | None, north_m: float, seed: int) -> TargetTracker:
    """Along a lane on the equator, from ranges alone, to an emitter beside it."""
    rng, tracker = np.random.default_rng(seed), TargetTracker(TrackerParams())
    tracker.prior = prior
    for second in range(30):
        position = (-75.0 + 5.0 * second, 0.0, 20.0)
        range_m = math.dist(position, (0.0, north_m, 0.0)) + rng.normal(0.0, 1.0)
        tracker.fuse(RangingMeasurement(1, float(second), range_m=range_m), position, float(second))
    return tracker


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_side_that_was_not_searched_comes_first_but_the_other_one_stays(
    side: float, seed: int
) -> None:
    tracker = ranged(searched(-side), 60.0 * side, seed)
    estimate = tracker.estimate(30.0)
    assert estimate is not None
    assert estimate.state is EstimateState.AMBIGUOUS
    assert math.dist(estimate.position_enu_m, (0.0, 60.0 * side)) < 15.0
    weights = probabilities(tracker.hypotheses)
    assert 5.0 < weights[0] / weights[1] < 15.0


def test_without_a_search_both_sides_count_alike() -> None:
    tracker = ranged(None, 60.0, 1)
    weights = probabilities(tracker.hypotheses)
    assert weights[0] / weights[1] < 1.5


def test_a_decision_of_the_measurements_is_left_alone() -> None:
    def at(north_m: float, probability: float) -> Hypothesis:
        state = FilterState.of(0.0, np.array([0.0, north_m, 0.0, 0.0]), np.eye(4))
        return Hypothesis(math.log(probability), state)

    prior = searched(1.0)
    decided = ranked((at(60.0, 0.96), at(-60.0, 0.04)), prior)
    assert decided[0].position_enu_m == (0.0, 60.0)
    assert probabilities(decided)[0] == pytest.approx(0.96)
    turned = ranked((at(60.0, 0.9), at(-60.0, 0.1)), prior)
    assert turned[0].position_enu_m == (0.0, -60.0)
    assert turned[0].log_weight == math.log(0.1)  # of measurements alone


def test_the_prior_moves_with_the_frame_and_goes_with_it() -> None:
    tracker = ranged(searched(-1.0), 60.0, 1)
    before = [h.position_enu_m for h in tracker.hypotheses]
    tracker.move((500.0, 300.0, 0.0), 0.0)
    tracker.optimize()
    after = [(e - 500.0, n - 300.0) for e, n in (h.position_enu_m for h in tracker.hypotheses)]
    assert math.dist(before[0], after[0]) < 5.0
    assert probabilities(tracker.hypotheses)[0] > 0.8
    tracker.restart()
    assert tracker.prior is None
