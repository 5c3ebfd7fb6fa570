"""Both radii hold where an autopilot does not report how accurate its position is."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.domain import TargetEstimate
from sim_link.autopilot.estimator import NavigationParams
from sim_link.autopilot.scenario import Scenario
from tests.loop.loop_helpers import AUTO, Loop

WANDERING = NavigationParams(
    fix="3d", sigma_m=1.5, time_constant_s=100.0, height_sigma_m=2.5, reports_accuracy=False
)
LONGEST_S = 90.0


def flown(navigation: NavigationParams, seed: int) -> tuple[TargetEstimate, float, float]:
    """The estimate that is reported, its error relative to the vehicle, and on the Earth."""
    scenario = msgspec.structs.replace(Scenario(), navigation=navigation)
    loop = Loop(AUTO, scenario, seed=seed)
    while loop.companion.session.result is None and loop.now_s < LONGEST_S:
        loop.run(1.0)
    result = loop.companion.session.result
    assert result is not None
    (east, north), position = scenario.emitter.position_enu_m, result.estimate.position_enu_m
    e, n, _ = loop.sim.vehicle.estimator.bias_enu_m
    relative_m = math.dist(position, (east + e, north + n))
    return result.estimate, relative_m, math.dist(position, (east, north))


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4))])
def test_a_position_that_wanders_unreported_is_within_both_radii(seed: int) -> None:
    estimate, relative_m, absolute_m = flown(WANDERING, seed)
    assert not estimate.own.is_reported
    assert relative_m <= estimate.r95_m
    assert absolute_m <= estimate.absolute_r95_m
    # what the search waits for is what measuring improves
    assert estimate.settled_r95_m < 0.5 < estimate.r95_m < estimate.absolute_r95_m


def test_a_receiver_without_error_reports_that_and_both_radii_are_nearly_the_same() -> None:
    estimate, relative_m, absolute_m = flown(NavigationParams(), 0)
    assert estimate.own.is_reported
    assert max(relative_m, absolute_m) <= estimate.r95_m <= estimate.absolute_r95_m
    assert estimate.absolute_r95_m - estimate.r95_m < 0.05
