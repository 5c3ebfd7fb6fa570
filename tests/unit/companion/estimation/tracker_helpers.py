"""Positions, walks and measurements that the tests of the tracker share."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement, TargetEstimate
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.polygons import Point

HEIGHT_M = 20.0


def measured(
    time_s: float, range_m: float | None = None, bearing_rad: float | None = None
) -> RangingMeasurement:
    bearing = None if bearing_rad is None else math.remainder(bearing_rad, 2.0 * math.pi)
    return RangingMeasurement(
        emitter_id=1, measured_at_s=time_s, range_m=range_m, bearing_enu_rad=bearing
    )


def range_to(position: PositionEnu, target: Point) -> float:
    return math.dist(position, (*target, 0.0))


def bearing_to(position: PositionEnu, target: Point) -> float:
    return math.atan2(target[1] - position[1], target[0] - position[0])


def leg(start: Point, end: Point, steps: int) -> list[PositionEnu]:
    return [
        (float(e), float(n), HEIGHT_M)
        for e, n in zip(
            np.linspace(start[0], end[0], steps), np.linspace(start[1], end[1], steps), strict=True
        )
    ]


def corner_walk() -> list[PositionEnu]:
    """A walk with a turn: 60 m east, then 60 m north."""
    return leg((0.0, 0.0), (60.0, 0.0), 60) + leg((60.0, 1.0), (60.0, 60.0), 60)


def estimate_of(tracker: TargetTracker) -> TargetEstimate:
    estimate = tracker.estimate(0.0)
    assert estimate is not None
    return estimate


def walk_about(
    positions: Iterable[PositionEnu], target: Point, has_range: bool, has_bearing: bool
) -> TargetTracker:
    """Noiseless measurements of an emitter without offsets along a walk."""
    tracker = TargetTracker(TrackerParams())
    for step, position in enumerate(positions):
        seen = measured(
            float(step),
            range_to(position, target) if has_range else None,
            bearing_to(position, target) if has_bearing else None,
        )
        assert tracker.fuse(seen, position, float(step)).reject_reason is None
    return tracker


def fly_around(tracker: TargetTracker, target: Point, steps: range, turned_rad: float = 0.0) -> int:
    """Noisy measurements on a circle about the target; returns how often the tracker restarted."""
    rng = np.random.default_rng(steps.start + 17)
    restarts = 0
    for step in steps:
        angle = 0.25 * step
        position = (
            target[0] + 25.0 * math.cos(angle),
            target[1] + 25.0 * math.sin(angle),
            HEIGHT_M,
        )
        seen = measured(
            float(step),
            range_to(position, target) + float(rng.normal(0.0, 1.5)),
            bearing_to(position, target) + turned_rad + float(rng.normal(0.0, 0.03)),
        )
        restarts += tracker.fuse(seen, position, float(step)).restarted
    return restarts


def known_by(tracker: TargetTracker) -> list[object]:
    """The hypotheses bit by bit."""
    return [
        (h.log_weight, h.state.mean.tobytes(), h.state.covariance.tobytes())
        for h in tracker.hypotheses
    ]
