"""Learning one emitter's noise from the innovations of the filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import (
    FilterParams,
    FilterState,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.noise.adaptation import AdaptationParams
from companion.estimation.noise.innovations import RETUNE_EVERY, NoiseLearner
from companion.estimation.tracker import TargetTracker, TrackerParams

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))
BELIEVED = FilterParams(range_sigma_m=1.5, bearing_sigma_deg=2.0)


def update(range_m: float, bearing_rad: float, prior_share: float = 0.1) -> UpdateReport:
    rows = [
        ModalityReport(innovation, 1.0, 1.0, innovation, 1.0, prior_share)
        for innovation in (range_m, bearing_rad)
    ]
    return UpdateReport(STATE, rows[0], rows[1], None, 0.0, True)


def learnt(sigma_m: float, sigma_deg: float, count: int = 1500) -> NoiseLearner:
    rng = np.random.default_rng(4)
    learner = NoiseLearner.starting(BELIEVED, AdaptationParams())
    for _ in range(count):
        bias_m = float(rng.exponential(8.0)) if rng.random() < 0.5 else 0.0
        gross = 5.0 if rng.random() < 0.3 else 1.0
        bearing_rad = gross * math.radians(sigma_deg) * float(rng.normal())
        learner = learner.after(update(sigma_m * float(rng.normal()) + bias_m, bearing_rad))
    return learner


def test_sigma_and_thresholds_follow_the_radio() -> None:
    tuned = learnt(0.4, 5.0).tuned(BELIEVED)
    assert 0.3 < tuned.range_sigma_m < 0.7  # what was believed first, 1.5 m, never fades wholly
    assert tuned.bearing_sigma_deg == pytest.approx(5.0, rel=0.25)
    assert not tuned.use_reported_sigma
    assert tuned.range_k_long is not None
    assert 0.1 <= tuned.range_k_long <= 5.0


def test_a_filter_that_is_not_robust_stays_so() -> None:
    plain = FilterParams(range_k_long=None, bearing_k=None)
    tuned = learnt(0.4, 5.0).tuned(plain)
    assert (tuned.range_k_long, tuned.bearing_k) == (None, None)


def test_the_states_own_uncertainty_is_not_learnt_from() -> None:
    learner = NoiseLearner.starting(BELIEVED, AdaptationParams())
    assert learner.after(update(50.0, 1.0, prior_share=9.0)) == learner


def test_it_is_due_now_and_then() -> None:
    learner = NoiseLearner.starting(BELIEVED, AdaptationParams())
    due = []
    for index in range(2 * RETUNE_EVERY):
        learner = learner.after(update(0.1, 0.01))
        if learner.is_due:
            due.append(index + 1)
    assert due == [RETUNE_EVERY, 2 * RETUNE_EVERY]


def flown(params: TrackerParams) -> TargetTracker:
    """Around a target with a radio much better than believed."""
    rng = np.random.default_rng(2)
    tracker = TargetTracker(params)
    for step in range(300):
        phi = 0.05 * step
        place = (20.0 * math.cos(phi), 20.0 * math.sin(phi), 0.0)
        seen = RangingMeasurement(
            emitter_id=1,
            measured_at_s=0.1 * step,
            range_m=math.dist(place, (5.0, 3.0, 0.0)) + 0.1 * float(rng.normal()),
            range_sigma_m=3.0,
        )
        tracker.fuse(seen, place, 0.1 * step)
    return tracker


@pytest.mark.slow
def test_a_tracker_learns_only_if_asked() -> None:
    plain, learning = flown(TrackerParams()), flown(TrackerParams(adaptation=AdaptationParams()))
    assert plain._filter.params.range_sigma_m == 1.5
    assert learning._filter.params.range_sigma_m < 0.6
    one, other = plain.estimate(30.0), learning.estimate(30.0)
    assert one is not None
    assert other is not None
    assert other.r95_m < 0.5 * one.r95_m
    assert math.dist(other.position_enu_m, (5.0, 3.0)) < other.r95_m
