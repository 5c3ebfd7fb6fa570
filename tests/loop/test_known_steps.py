"""Heights, origins and headings that step in flight: everything that is held moves along.

What was known before goes on to be known: R95 grows by what is not known of the step, and no more.
"""

from __future__ import annotations

import math
from typing import Literal

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from companion.guidance.phases import IN_CONTROL, Phase
from sim_link.autopilot.incidents import EkfJump, IncidentRecord, OriginShift
from sim_link.autopilot.scenario import AutopilotParams, PayloadParams, Scenario
from tests.loop.loop_helpers import Loop

Flavour = Literal["px4", "ardupilot"]
ENDLESS = CompanionConfig(mission=SessionParams(engage="auto", stop_radius_m=0.01, settle_s=None))
GROWN_M = 0.3
"""Beside 3 sigma of the default position noise, 0.05 m per axis, of two reports."""
STEPS: dict[str, tuple[IncidentRecord, ...]] = {
    "up": (EkfJump(east_m=0.0, up_m=4.0),),
    "down": (EkfJump(east_m=0.0, up_m=-4.0),),
    "aside and up": (EkfJump(east_m=5.0, north_m=-3.0, up_m=3.0),),
    "turned": (EkfJump(east_m=4.0, up_m=2.0, yaw_deg=35.0),),
    "origin": (OriginShift(east_m=10.0),),
    "origin up": (OriginShift(east_m=0.0, up_m=5.0),),
    "origin all": (OriginShift(east_m=12.0, north_m=9.0, up_m=-6.0),),
    "origin and jump": (OriginShift(east_m=10.0), EkfJump(east_m=0.0, north_m=5.0, up_m=3.0)),
}


def r95_m(loop: Loop) -> float:
    estimate = loop.companion.session.estimate
    return math.inf if estimate is None else estimate.r95_m


def shift_m(steps: tuple[IncidentRecord, ...]) -> tuple[float, float]:
    """Return the target's shift in the vehicle's local frame, east and north."""
    east_m = north_m = 0.0
    for step in steps:
        assert isinstance(step, EkfJump | OriginShift)
        sign = 1.0 if isinstance(step, EkfJump) else -1.0
        east_m, north_m = east_m + sign * step.east_m, north_m + sign * step.north_m
    return east_m, north_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measures", "flavour"),
    [
        ("both", "px4"),
        ("range", "ardupilot"),
        pytest.param("both", "ardupilot", marks=pytest.mark.campaign),
        pytest.param("range", "px4", marks=pytest.mark.campaign),
    ],
)
@pytest.mark.parametrize("name", STEPS)
def test_what_was_known_goes_on_to_be_known(
    flavour: Flavour, name: str, measures: Literal["both", "range"]
) -> None:
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour), payload=PayloadParams(measures=measures)
    )
    loop = Loop(ENDLESS, scenario, seed=3 + len(name))
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    known_m = 1.0 if measures == "both" else 4.0
    loop.run_until(lambda: r95_m(loop) <= known_m, 120.0)
    loop.run(5.0)
    before = loop.companion.session.estimate
    assert before is not None
    for step in STEPS[name]:
        loop.flight.apply_incident(step)
    east_m, north_m = shift_m(STEPS[name])
    target = loop.flight.scenario.emitter.position_enu_m
    for _ in range(16):
        loop.run(0.5)
        after = loop.companion.session.estimate
        assert after is not None
        off_m = math.dist(after.position_enu_m, (target[0] + east_m, target[1] + north_m))
        assert after.r95_m <= 1.3 * before.r95_m + GROWN_M
        assert off_m <= after.r95_m + GROWN_M
    assert loop.phase in IN_CONTROL
    assert loop.companion.session.tracker.integrity.restarts == 0
