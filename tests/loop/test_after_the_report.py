"""The mode after the last report is requested until the autopilot shows it."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from sim_link.autopilot.incidents import AutopilotStall, PilotMode
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import AUTO, Loop, flown_once

pytestmark = pytest.mark.slow


@flown_once
def reported(flavour: FlavourName = "ardupilot", config: CompanionConfig = AUTO) -> Loop:
    """Return a flight at the tick of the report."""
    loop = Loop(config, Scenario(autopilot=AutopilotParams(flavour=flavour)))
    loop.run_until(lambda: bool(loop.notes.results), 180.0)
    return loop


def test_a_request_that_a_dead_link_swallowed_is_made_again() -> None:
    loop = reported()
    loop.is_link_up = False
    loop.run(8.0)
    left_in = loop.mode
    loop.is_link_up = True
    loop.run(12.0)
    assert (left_in, loop.mode) == (FlightMode.OFFBOARD, FlightMode.HOLD)
    assert loop.phase is Phase.FINISHED


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_an_autopilot_that_stood_still_gets_the_request_afterwards(flavour: FlavourName) -> None:
    loop = reported(flavour)
    loop.sim.apply_incident(AutopilotStall(duration_s=4.0), loop.now_s)
    loop.run(16.0)
    assert loop.mode is FlightMode.HOLD
    assert not loop.said("control lost")


def test_a_pilot_who_took_over_is_not_asked_again() -> None:
    loop = reported()
    loop.is_link_up = False
    loop.run(8.0)
    loop.sim.apply_incident(PilotMode(mode=FlightMode.POSITION), loop.now_s)
    loop.is_link_up = True
    asked = len(loop.commands)
    loop.run(20.0)
    assert loop.mode is FlightMode.POSITION
    assert 176 not in [number for _, number in loop.commands[asked:]]


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize("action", ["land", "return"])
def test_landing_as_asked_is_no_loss_of_control(flavour: FlavourName, action: str) -> None:
    mission = SessionParams(engage="auto", on_localised=action)  # type: ignore[arg-type]
    loop = reported(flavour, CompanionConfig(mission=mission))
    loop.run_until(lambda: loop.said("flight over"), 180.0)
    assert loop.said("as requested: autopilot is landing") or loop.said(
        "as requested: on the ground"
    )
    assert not loop.said("control lost")


def test_the_result_has_the_budget_of_its_radius() -> None:
    _, result = reported().notes.results[-1]
    radii_m = list(result.budget_m.values())
    assert next(iter(result.budget_m)) == "thermal noise"
    assert radii_m[-2] == pytest.approx(result.estimate.r95_m, rel=0.05)
    assert radii_m[-1] == pytest.approx(result.estimate.absolute_r95_m, rel=0.05)
