"""Paths whose geometry leaves directions unobservable: an estimate is finite, or there is none."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.geometry.polygons import Point

COUNT = 40
ASIDE_M = 2.64
"""Coordinate of the paths across; of zero itself, products have no rounding error."""
Path = Callable[[float], Point]

PATHS: dict[str, Path] = {
    "straight": lambda along_m: (along_m, 0.0),
    "hover": lambda _: (0.0, 0.0),
    "there and back": lambda along_m: (abs(math.remainder(along_m, 20.0)), 0.0),
    "two positions": lambda along_m: (30.0 * (int(4.0 * along_m) % 2), 0.0),
    "right angle": lambda along_m: (min(along_m, 5.0), max(along_m - 5.0, 0.0)),
    "circle": lambda along_m: (10.0 * math.cos(along_m / 2.0), 10.0 * math.sin(along_m / 2.0)),
}
"""Position after a distance flown, m."""
TARGETS: dict[str, Point] = {"ahead": (20.0, 0.0), "behind": (-17.0, 0.0)}


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("has_power", [False, True])
@pytest.mark.parametrize("path", PATHS)
def test_an_unobservable_direction_gives_no_infinite_or_negative_variance(
    path: str, has_power: bool, target: str
) -> None:
    tracker = TargetTracker(TrackerParams())
    for step in range(COUNT):
        time_s, position = 0.5 * step, PATHS[path](0.25 * step)
        slant_m = max(math.dist(position, TARGETS[target]), 0.01)
        power_dbm = -40.0 - 27.0 * math.log10(slant_m) if has_power else None
        measurement = RangingMeasurement(
            7, time_s, range_m=slant_m, power_dbm=power_dbm, stamp_us=step
        )
        east_m, north_m = position
        tracker.fuse(measurement, (east_m, north_m + ASIDE_M, 0.0), time_s)
    estimate = tracker.estimate(time_s)
    if estimate is not None:
        assert np.isfinite([estimate.r95_m, *estimate.position_enu_m]).all()
        assert (np.linalg.eigvalsh(estimate.covariance_m2) >= 0.0).all()
