"""Readiness is a conjunction: each input that is missing is named, and nothing is ready without."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.authority.state_machine import Phase
from companion.guidance.events import AutopilotFenceChanged
from companion.guidance.flight.requirements import REQUIREMENTS, missing_inputs
from tests.unit.companion.guidance.scripted import ScriptedFlight


def without_home(flight: ScriptedFlight) -> None:
    flight.session.vehicle.home_enu_m = None


def without_position(flight: ScriptedFlight) -> None:
    flight.has_position = False


def without_landed_state(flight: ScriptedFlight) -> None:
    flight.report_landed(LandedState.UNKNOWN)


def without_fence(flight: ScriptedFlight) -> None:
    flight.give(AutopilotFenceChanged(flight.now_s))


def without_link(flight: ScriptedFlight) -> None:
    flight.has_link = False


TAKEN: dict[str, Callable[[ScriptedFlight], None]] = {
    "the autopilot": without_link,
    "a local position": without_position,
    "a home position": without_home,
    "the landed state": without_landed_state,
    "the autopilot's fence": without_fence,
}


def missing(flight: ScriptedFlight) -> list[str]:
    session = flight.session
    return missing_inputs(session.vehicle, session.fencing, flight.now_s)


def test_the_page_has_every_row() -> None:
    page = (Path(__file__).parents[4] / "docs/flying.md").read_text(encoding="utf-8")
    assert all(f"| {row.text} | `{row.message}` |" in page for row in REQUIREMENTS)


def test_every_row_is_tried() -> None:
    assert {row.text for row in REQUIREMENTS} == {*TAKEN, "the origin"}


@pytest.mark.parametrize("text", TAKEN)
def test_without_one_it_is_missing_and_named(text: str) -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    assert missing(flight) == []
    TAKEN[text](flight)
    flight.fly(2.0)
    assert any(part.startswith(text) for part in missing(flight))


def test_an_ardupilot_that_reports_no_landed_state_is_not_ready_and_says_so() -> None:
    """ "ready: switch to GUIDED", and then nothing happened, and nothing was said."""
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT)
    flight.reports_landed = False
    flight.ready()
    flight.fly(12.0)
    assert flight.is_in(Phase.WAITING)
    assert "waiting for the landed state" in flight.texts
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(1.0)
    assert flight.is_in(Phase.STANDBY)
    assert "ready: switch to GUIDED to give control" in flight.texts


def test_a_mode_that_is_chosen_without_one_is_answered_by_its_name() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT)
    flight.reports_landed = False
    flight.ready()
    flight.show(FlightMode.OFFBOARD)
    flight.fly(3.0)
    said = [text for text in flight.texts if "without control" in text]
    assert said == ["GUIDED without control: waiting for the landed state"]


def test_a_px4_needs_none() -> None:
    flight = ScriptedFlight().ready()
    assert flight.session.vehicle.landed is LandedState.UNKNOWN
    assert flight.is_in(Phase.STANDBY)
