"""A track that its measurements contradict begins again; one that they fit keeps its terms."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from companion.domain import (
    PositionEnu,
)
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screen import Objection, RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from companion.geometry.polygons import Point
from tests.unit.companion.estimation.tracker_helpers import (
    HEIGHT_M,
    bearing_to,
    corner_walk,
    estimate_of,
    fly_around,
    known_by,
    leg,
    measured,
    range_to,
)


def _far_away(tracker: TargetTracker, positions: Iterable[PositionEnu], emitter: Point) -> int:
    """Fuse noisy measurements of another position than the estimated one; count the restarts."""
    rng, restarts = np.random.default_rng(9), 0
    for step, position in enumerate(positions):
        seen = measured(
            1000.0 + step,
            range_to(position, emitter) + float(rng.normal(0.0, 1.5)),
            bearing_to(position, emitter) + float(rng.normal(0.0, 0.03)),
        )
        restarts += tracker.fuse(seen, position, 1000.0 + step).restarted
    return restarts


@pytest.mark.parametrize("has_window", [pytest.param(True, marks=pytest.mark.slow), False])
def test_an_emitter_that_was_carried_away_is_found_where_it_is_now(has_window: bool) -> None:
    """The window forgets what it saw before the contradictions began."""
    tracker = TargetTracker(TrackerParams(window=WindowParams(enabled=has_window)))
    fly_around(tracker, (0.0, 0.0), range(300))
    assert math.dist(estimate_of(tracker).position_enu_m, (0.0, 0.0)) < 1.0
    emitter = (120.0, 140.0)
    out, back = (-60.0, -60.0), (-60.0, 60.0)
    assert _far_away(tracker, leg(out, back, 60), emitter) == 1
    square = leg(back, (60.0, 60.0), 100) + leg((60.0, 60.0), (60.0, -60.0), 100)
    _far_away(tracker, square + leg((60.0, -60.0), out, 100), emitter)
    estimate = estimate_of(tracker)
    assert math.dist(estimate.position_enu_m, emitter) <= estimate.r95_m


def test_what_it_cannot_explain_from_any_side_is_given_up_too() -> None:
    """Seen from all around in turn, no side is contradicted often enough in a row."""
    tracker = TargetTracker(TrackerParams())
    fly_around(tracker, (0.0, 0.0), range(300))
    assert tracker.health.nis is not None
    assert tracker.health.nis < 1.2
    assert not tracker.health.is_overconfident
    turns = 0.25 * np.arange(60)
    circle = [(25.0 * math.cos(a), 25.0 * math.sin(a), HEIGHT_M) for a in turns]
    assert _far_away(tracker, circle, (120.0, -60.0)) == 1


def test_ranges_that_no_place_and_no_offset_explains_in_metres_are_not_used() -> None:
    """Shorter than the vehicle is high, and the offset is bounded."""
    bounded = FilterParams(range_offset_min_m=-1.0, range_offset_max_m=1.0, range_k_short=1.0)
    tracker = TargetTracker(TrackerParams(filter=bounded, window=WindowParams(enabled=False)))
    fly_around(tracker, (0.0, 0.0), range(120))
    for step in range(120, 240):
        angle = 0.25 * step
        position = (25.0 * math.cos(angle), 25.0 * math.sin(angle), HEIGHT_M)
        short = measured(float(step), 8.0 + 0.1 * (step % 7))
        tracker.fuse(short, position, float(step))
    assert tracker.objection(240.0) is Objection.RANGE_UNIT
    assert tracker.rejected[RejectReason.WRONG_UNIT] > 100


def test_the_terms_of_r95_are_known_after_every_measurement() -> None:
    """Also between two solutions, when the window has rows that the latest one did not see."""
    tracker = TargetTracker(TrackerParams(filter=FilterParams(place_range_sigma_m=1.5)))
    target, rng = (30.0, 20.0), np.random.default_rng(6)
    known = 0
    for step, position in enumerate(corner_walk()):
        before = known_by(tracker)
        seen = measured(float(step), range_to(position, target) + float(rng.normal(0.0, 1.5)))
        tracker.fuse(seen, position, float(step))
        after = known_by(tracker)
        budget = tracker.budget(float(step))
        known += len(budget) > 5
        assert known_by(tracker) == after != before
    assert known > 50
