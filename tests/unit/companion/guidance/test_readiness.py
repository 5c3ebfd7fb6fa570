"""Readiness is a conjunction: each input that is missing is named, and nothing is ready without."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.events import AutopilotFenceChanged
from companion.guidance.phases import IN_CONTROL, Phase
from companion.guidance.readiness import ANNOUNCE_MISSING_S, REQUIREMENTS, missing_inputs
from companion.link.interface import VehicleParams
from tests.unit.companion.guidance.scripted import ScriptedFlight


def without_home(flight: ScriptedFlight) -> None:
    flight.session.vehicle.home_enu_m = None


def without_position(flight: ScriptedFlight) -> None:
    flight.has_position = False


def without_landed_state(flight: ScriptedFlight) -> None:
    flight.reports_landed = False


def without_mode(flight: ScriptedFlight) -> None:
    flight.has_heartbeat = False


def without_origin(flight: ScriptedFlight) -> None:
    flight.session.vehicle.origin = None


def without_fence(flight: ScriptedFlight) -> None:
    flight.give(AutopilotFenceChanged(flight.now_s))


def without_link(flight: ScriptedFlight) -> None:
    flight.has_link = False


TAKEN: dict[str, Callable[[ScriptedFlight], None]] = {
    "the autopilot": without_link,
    "the flight mode": without_mode,
    "a local position": without_position,
    "a home position": without_home,
    "the origin": without_origin,
    "the landed state": without_landed_state,
    "the autopilot's fence": without_fence,
}


def missing(flight: ScriptedFlight) -> list[str]:
    session = flight.session
    return missing_inputs(session.vehicle, session.fencing, flight.now_s)


ROWS = {row.text: row for row in REQUIREMENTS}
GLOBAL = VehicleParams(setpoint="global_int")
"""Only global setpoints, and fences in degrees, need the origin."""
SPARE_S = 1.0
"""Beyond a timeout, until it is noticed and announced."""


def new_flight(text: str, autopilot: Autopilot) -> ScriptedFlight:
    return ScriptedFlight(autopilot=autopilot, vehicle=GLOBAL if text == "the origin" else None)


def cases() -> list[tuple[str, Autopilot]]:
    """Every row with every autopilot that it is needed of."""
    autopilots = (Autopilot.PX4, Autopilot.ARDUPILOT)
    return [(row.text, one) for row in REQUIREMENTS for one in autopilots if row.is_needed(one)]


def timeout_s(text: str) -> float:
    row = ROWS[text]
    return (row.timeout_s if math.isfinite(row.timeout_s) else 0.0) + SPARE_S


def test_the_page_has_every_row_with_its_timeout() -> None:
    page = (Path(__file__).parents[4] / "docs/flying.md").read_text(encoding="utf-8")
    for row in REQUIREMENTS:
        timeout = f"{row.timeout_s:g} s" if math.isfinite(row.timeout_s) else "none"
        assert f"| {row.text} | `{row.message}` | {timeout} |" in page


def test_every_row_is_tried() -> None:
    assert set(ROWS) == set(TAKEN)


@pytest.mark.parametrize(("text", "autopilot"), cases())
def test_one_that_is_taken_before_ready_is_waited_for_by_its_name(
    text: str, autopilot: Autopilot
) -> None:
    flight = new_flight(text, autopilot)
    flight.fly(0.5)
    flight.is_armed = True
    flight.heartbeat()
    if flight.reports_landed:
        flight.report_landed(LandedState.IN_AIR)
    flight.locate()
    TAKEN[text](flight)
    flight.fly(timeout_s(text) - 0.5)
    assert any(part.startswith(text) for part in missing(flight))
    flight.fly(ANNOUNCE_MISSING_S + 0.5)
    texts = [said for said in flight.texts if said.startswith(("waiting for", "not ready"))]
    assert texts  # "not ready" where it was ready within the timeout
    flight.mode = FlightMode.OFFBOARD
    flight.fly(2.0)
    assert flight.phase not in IN_CONTROL


@pytest.mark.parametrize(("text", "autopilot"), cases())
def test_one_that_is_taken_at_ready_is_named_and_no_control_begins(
    text: str, autopilot: Autopilot
) -> None:
    flight = new_flight(text, autopilot).ready()
    assert missing(flight) == []
    assert flight.is_in(Phase.STANDBY)
    said = len(flight.texts)
    TAKEN[text](flight)
    flight.fly(timeout_s(text))
    assert any(part.startswith(text) for part in missing(flight))
    new = " | ".join(flight.texts[said:])
    assert "not ready" in new or "reading it again" in new
    flight.mode = FlightMode.OFFBOARD
    flight.fly(2.0)
    assert flight.phase not in IN_CONTROL


@pytest.mark.parametrize(("text", "autopilot"), cases())
def test_one_that_is_taken_in_control_is_held_on_and_named(text: str, autopilot: Autopilot) -> None:
    """But the landed state, which is only asked for again: the vehicle flies by our setpoints."""
    flight = new_flight(text, autopilot).in_control()
    assert flight.is_in(Phase.NORMAL), flight.texts
    TAKEN[text](flight)
    flight.fly(timeout_s(text))
    if text == "the landed state":
        assert flight.phase in IN_CONTROL
        return
    assert flight.is_in(Phase.HOLD)
    assert any(said.startswith("hold: ") for said in flight.texts)
    held = flight.setpoints[-1]
    flight.fly(1.0)
    assert flight.setpoints[-1] == pytest.approx(held, abs=0.5)


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
    assert "ready: switch to GUIDED to hand over" in flight.texts


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
