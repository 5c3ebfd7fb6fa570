"""Flights inside fences that are parameters of the autopilot."""

from __future__ import annotations

import math

import pytest

from sim_link.autopilot.incidents import Incident, StationHome
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import AUTO, Loop

pytestmark = pytest.mark.slow

CIRCLES: dict[FlavourName, dict[str, float]] = {
    "ardupilot": {"FENCE_ENABLE": 1, "FENCE_TYPE": 2, "FENCE_RADIUS": 40.0, "FENCE_MARGIN": 4.0},
    "px4": {"GF_MAX_HOR_DIST": 40.0},
}
CEILINGS: dict[FlavourName, dict[str, float]] = {
    "ardupilot": {"FENCE_ENABLE": 1, "FENCE_TYPE": 1, "FENCE_ALT_MAX": 15.0, "FENCE_MARGIN": 2.0},
    "px4": {"GF_MAX_VER_DIST": 15.0},
}


def flown(flavour: FlavourName, parameters: dict[str, float], *incidents: Incident) -> Loop:
    """Sixty seconds of the canonical search, whose emitter is 71 m from home."""
    autopilot = AutopilotParams(flavour=flavour, parameters=parameters)
    loop = Loop(AUTO, Scenario(autopilot=autopilot, incidents=incidents), 1)
    loop.run(60.0)
    return loop


def reach_from_home_m(loop: Loop) -> float:
    """Return the largest horizontal distance of the vehicle from its start."""
    home = loop.true_positions[0][:2]
    return max(math.dist(home, position[:2]) for position in loop.true_positions)


@pytest.mark.parametrize("flavour", list(CIRCLES))
def test_a_circle_of_parameters_is_kept(flavour: FlavourName) -> None:
    loop = flown(flavour, CIRCLES[flavour])
    assert loop.said("keeping to the autopilot's fence parameters: 40 m about home")
    reach_m = reach_from_home_m(loop)
    assert 25.0 < reach_m < 40.0 - CIRCLES[flavour].get("FENCE_MARGIN", 0.0)


@pytest.mark.parametrize("flavour", list(CIRCLES))
def test_a_home_that_another_station_moves_takes_the_circle_nowhere(flavour: FlavourName) -> None:
    """Towards the emitter, 71 m away; the autopilot's own circle moves with its home."""
    moved = StationHome(start_s=25.0, east_m=40.0, north_m=40.0)
    loop = flown(flavour, CIRCLES[flavour], moved)
    assert loop.said("home moved")
    assert reach_from_home_m(loop) < 40.0 - CIRCLES[flavour].get("FENCE_MARGIN", 0.0)


@pytest.mark.parametrize("flavour", list(CEILINGS))
def test_a_ceiling_of_parameters_is_kept(flavour: FlavourName) -> None:
    loop = flown(flavour, CEILINGS[flavour])
    assert loop.said("keeping to the autopilot's fence parameters: heights from 5 to 1")
    height_m = max(up for _, _, up in loop.true_positions)
    assert 10.0 < height_m < 15.0


def test_a_fence_of_parameters_that_is_off_limits_nothing() -> None:
    loop = flown("ardupilot", CIRCLES["ardupilot"] | {"FENCE_ENABLE": 0})
    assert not loop.said("fence parameters")
    assert reach_from_home_m(loop) > 45.0
