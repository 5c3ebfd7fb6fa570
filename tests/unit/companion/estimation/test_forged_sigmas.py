"""Readings whose standard deviation is smaller than their radio can measure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from companion.domain import EstimateState, PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from tests.unit.companion.estimation.tracker_helpers import bearing_to, leg, measured, range_to

TARGET, FORGED = (50.0, 50.0), (-20.0, -5.0)
"""89 m apart."""
HONEST_SIGMAS = (1.5, math.radians(2.0))
LOOKS = 60


def readings(
    seed: int, sigma: float, share: float
) -> Iterator[tuple[RangingMeasurement, PositionEnu]]:
    """Yield readings of a crossing at 5 Hz, a share of the forged position with that sigma."""
    rng = np.random.default_rng(seed)
    corners = [(-40.0, -40.0), (80.0, 80.0), (20.0, 90.0), (80.0, 10.0), (20.0, 50.0), (80.0, 50.0)]
    legs = [leg(a, b, int(math.dist(a, b))) for a, b in pairwise(corners)]
    for step, position in enumerate(position for each in legs for position in each):
        noise = rng.normal(0.0, HONEST_SIGMAS)
        excess_m = rng.exponential(8.0) if rng.random() < 0.3 else 0.0
        sigmas: tuple[float, float] = HONEST_SIGMAS
        target = TARGET
        if rng.random() < share:
            noise, excess_m, sigmas, target = np.zeros(2), 0.0, (sigma, sigma), FORGED
        range_m = range_to(position, target) + float(noise[0]) + excess_m
        seen = measured(0.2 * step, range_m, bearing_to(position, target) + float(noise[1]))
        yield replace(seen, range_sigma_m=sigmas[0], bearing_sigma_rad=sigmas[1]), position


def looks(seed: int, sigma: float, share: float = 0.1) -> list[tuple[EstimateState, float]]:
    """Return the state and the error, m, of the estimate at regular times of a flight."""
    tracker = TargetTracker(TrackerParams(filter=FilterParams()))
    flown = list(readings(seed, sigma, share))
    found = []
    for number, (seen, position) in enumerate(flown):
        tracker.fuse(seen, position, seen.measured_at_s)
        estimate = tracker.estimate(seen.measured_at_s)
        if number % (len(flown) // LOOKS) == 0 and estimate is not None:
            found.append((estimate.state, math.dist(estimate.position_enu_m[:2], TARGET)))
    return found


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1.0])
def test_a_tenth_of_forged_readings_with_a_tiny_sigma_localises_no_wrong_place(
    seed: int, sigma: float
) -> None:
    found = looks(seed, sigma)
    localised_m = [error_m for state, error_m in found if state is EstimateState.LOCALISED]
    assert len(localised_m) > LOOKS // 2
    assert max(localised_m) < 2.0  # localised_r95_m, and 89 m were claimed
