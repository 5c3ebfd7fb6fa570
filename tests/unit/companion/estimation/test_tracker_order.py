"""The tracker and the order of measurements: duplicates, delays, and what is too old."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from tests.unit.companion.estimation.tracker_helpers import (
    HEIGHT_M,
    bearing_to,
    corner_walk,
    estimate_of,
    known_by,
    measured,
    range_to,
    walk_about,
)


@pytest.mark.parametrize("has_stamp", [True, False])
def test_a_duplicate_changes_nothing_however_often_it_comes(has_stamp: bool) -> None:
    once, often = TargetTracker(TrackerParams()), TargetTracker(TrackerParams())
    rng = np.random.default_rng(1)
    for step, position in enumerate(corner_walk()[:60]):
        seen = replace(
            measured(float(step), range_to(position, (30.0, 40.0)) + float(rng.normal())),
            stamp_us=10_000 + step if has_stamp else None,
        )
        once.fuse(seen, position, float(step))
        assert often.fuse(seen, position, float(step)).reject_reason is None
        for again_s in (0.0, 0.2, 0.9):
            copy = replace(seen, measured_at_s=seen.measured_at_s + 0.01) if has_stamp else seen
            report = often.fuse(copy, position, float(step) + again_s)
            assert report.reject_reason is RejectReason.DUPLICATE
            assert report.update is None
    assert known_by(often) == known_by(once)
    assert often.accepted == once.accepted == 60
    assert often.rejected[RejectReason.DUPLICATE] == 180


def test_the_same_reading_at_another_time_is_no_duplicate() -> None:
    tracker = TargetTracker(TrackerParams())
    for step in range(5):
        assert (
            tracker.fuse(measured(0.1 * step, 40.0), (0.0, 0.0, HEIGHT_M), 1.0).reject_reason
            is None
        )


def _delayed(delays_s: list[float], params: TrackerParams) -> TargetTracker:
    """Noisy measurements along a walk, fused as they arrive, each where it was taken."""
    rng, tracker, target = np.random.default_rng(2), TargetTracker(params), (30.0, 40.0)
    arrivals = []
    for step, position in enumerate(corner_walk()):
        seen = measured(
            0.1 * step,
            range_to(position, target) + float(rng.normal(0.0, 1.5)),
            bearing_to(position, target) + float(rng.normal(0.0, 0.03)),
        )
        delay_s = delays_s[step % len(delays_s)]
        arrivals.append((seen.measured_at_s + delay_s, step, seen, position))
    for now_s, _, seen, position in sorted(arrivals):
        assert tracker.fuse(seen, position, now_s).reject_reason is None
    return tracker


def test_a_steady_delay_changes_nothing() -> None:
    assert known_by(_delayed([0.9], TrackerParams())) == known_by(_delayed([0.0], TrackerParams()))


@pytest.mark.parametrize("q", [0.0, 0.05])
def test_measurements_out_of_their_turn_are_fused_where_they_were_taken(q: float) -> None:
    """Fused where the vehicle is by then, two to ten metres on, they would point elsewhere."""
    params = TrackerParams(filter=FilterParams(process_noise_m_per_sqrt_s=q))
    in_turn, jumbled = _delayed([0.0], params), _delayed([0.95, 0.0, 0.4, 0.7, 0.05], params)
    one, other = estimate_of(in_turn), estimate_of(jumbled)
    assert math.dist(other.position_enu_m, (30.0, 40.0)) <= other.r95_m
    assert math.dist(one.position_enu_m, other.position_enu_m) < 0.25 * one.r95_m
    assert other.r95_m == pytest.approx(one.r95_m, rel=0.1)
    assert jumbled.accepted == 120


def test_what_is_older_than_a_second_is_refused() -> None:
    tracker = walk_about(corner_walk(), (30.0, 40.0), True, True)
    before = known_by(tracker)
    stale = measured(500.0, range_to((0.0, 0.0, HEIGHT_M), (30.0, 40.0)))
    assert tracker.fuse(stale, (0.0, 0.0, HEIGHT_M), 501.01).reject_reason is RejectReason.STALE
    assert known_by(tracker) == before
    assert tracker.fuse(stale, (0.0, 0.0, HEIGHT_M), 500.99).reject_reason is None
