"""I9 on invented estimates: what is reported as a covariance must be one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.domain import EstimateState, TargetEstimate
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.monitor.message_invariants import HonestCovariance
from tests.loop.loop_helpers import AUTO
from tools.campaign.flights import monitored_flight

GOOD = TargetEstimate(
    time_s=1.0,
    state=EstimateState.LOCALISED,
    position_enu_m=(50.0, 40.0),
    covariance_m2=((4.0, -1.0), (-1.0, 2.0)),
    r95_m=4.5,
    range_offset_m=1.0,
    bearing_offset_rad=0.0,
    measurements=100,
)
BAD = {
    "a covariance that is not symmetric": replace(GOOD, covariance_m2=((4.0, -1.0), (-0.9, 2.0))),
    "a covariance that is not positive": replace(GOOD, covariance_m2=((4.0, 3.0), (3.0, 2.0))),
    "a covariance without bounds": replace(GOOD, covariance_m2=((1e9, 0.0), (0.0, 2.0))),
    "a negative radius": replace(GOOD, r95_m=-0.1),
    "an estimate that is not a number": replace(GOOD, covariance_m2=((math.nan, 0.0), (0.0, 2.0))),
}


def found(*estimates: TargetEstimate | None) -> list[str]:
    """Return the violations, tick by tick, of these estimates."""
    around, shown = monitored_flight(AUTO, Scenario(), 1), list(estimates)
    invariant = HonestCovariance(around.monitor.scene, lambda: shown[0])
    while shown:
        invariant.ticked()
        shown.pop(0)
    return [violation.what for violation in around.monitor.violations]


@pytest.mark.parametrize("what", BAD)
def test_what_is_no_covariance_is_reported_once(what: str) -> None:
    bad = BAD[what]
    assert found(GOOD, bad, bad, GOOD) == [what]


def test_no_estimate_and_a_certain_one_are_no_offence() -> None:
    certain = replace(GOOD, covariance_m2=((0.0, 0.0), (0.0, 0.0)), r95_m=0.0)
    assert found(None, GOOD, certain, None) == []
