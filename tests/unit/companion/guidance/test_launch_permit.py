"""Only a vehicle that was found disarmed on the ground is launched by itself."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import Arm, SessionParams, SetMode, TakeOff
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight

AUTO = SessionParams(engage="auto")
AUTOPILOTS = [Autopilot.PX4, Autopilot.ARDUPILOT]


def asked(flight: ScriptedFlight) -> bool:
    """Return True if anything that takes the vehicle was requested."""
    return bool(flight.sent(Arm) or flight.sent(TakeOff) or flight.sent(SetMode))


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_disarmed_on_the_ground_it_is_launched(autopilot: Autopilot) -> None:
    flight = ScriptedFlight(AUTO, autopilot).on_the_ground()
    assert flight.is_in(Phase.LAUNCHING)
    assert "ready: automatic takeoff begins" in flight.texts
    assert asked(flight)


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("landed", [LandedState.IN_AIR, LandedState.UNKNOWN])
def test_found_armed_in_hold_it_is_left_to_the_operator(
    autopilot: Autopilot, landed: LandedState
) -> None:
    flight = ScriptedFlight(AUTO, autopilot)
    flight.report_landed(landed)
    flight.ready().fly(30.0)
    assert flight.is_in(Phase.STANDBY)
    assert not asked(flight)
    assert any("no automatic takeoff: vehicle was found armed" in t for t in flight.texts)
    assert any(text.startswith("ready: switch to") for text in flight.texts)
    assert "ready: automatic takeoff begins" not in flight.texts


def test_found_in_the_air_it_is_left_alone_even_if_it_seems_disarmed() -> None:
    flight = ScriptedFlight(AUTO)
    flight.report_landed(LandedState.IN_AIR)
    flight.heartbeat()
    flight.locate()
    flight.fly(5.0)
    assert not asked(flight)
    assert any("vehicle was found in the air" in text for text in flight.texts)


def test_who_landed_it_and_disarmed_it_does_not_see_it_take_off_by_itself() -> None:
    flight = ScriptedFlight(AUTO).ready()
    flight.show(FlightMode.HOLD, is_armed=False)
    flight.report_landed(LandedState.ON_GROUND)
    flight.fly(30.0)
    assert not asked(flight)


def test_armed_by_a_pilot_before_anything_is_known_it_is_the_pilots() -> None:
    flight = ScriptedFlight(AUTO)
    flight.has_position = False
    flight.on_the_ground()
    flight.show(FlightMode.POSITION)
    flight.fly(0.1)
    flight.show(FlightMode.POSITION, is_armed=False)
    flight.has_position = True
    flight.fly(5.0)
    assert not asked(flight)


def test_an_autopilot_that_does_not_tell_where_it_is_is_waited_for_and_said() -> None:
    flight = ScriptedFlight(AUTO)
    flight.position_enu_m = (0.0, 0.0, 0.0)
    flight.heartbeat()
    flight.locate()
    flight.fly(12.0)
    assert not asked(flight)
    texts = [text for text in flight.texts if "reports no landed state" in text]
    assert len(texts) == 1
    flight.report_landed(LandedState.ON_GROUND)
    flight.fly(0.5)
    assert flight.is_in(Phase.LAUNCHING)
