"""HOLD, RESUME, RETURN and GRANT, besides the mode switch; each press is answered."""

import pytest

from companion.domain import FlightMode
from companion.guidance.commands import Announce, SendSetpoint, SessionParams
from companion.guidance.events import OperatorCommand, OperatorCommandReceived, StopRequested
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight


def flying() -> ScriptedFlight:
    flight = ScriptedFlight().in_control()
    flight.fly(5.0)
    assert flight.is_in(Phase.NORMAL)
    return flight


def ask(flight: ScriptedFlight, command: OperatorCommand) -> None:
    flight.give(OperatorCommandReceived(flight.now_s, command))


def test_hold_holds_at_the_next_tick_until_resume() -> None:
    flight = flying()
    ask(flight, OperatorCommand.HOLD)
    flight.fly(0.1)
    assert flight.is_in(Phase.HOLD)
    since_s = flight.now_s
    flight.fly(10.0)
    assert flight.is_in(Phase.HOLD)
    positions = {c.setpoint.position_enu_m for c in flight.sent(SendSetpoint, since_s + 2.0)}
    assert len(positions) == 1
    ask(flight, OperatorCommand.RESUME)
    flight.fly(0.1)
    assert flight.is_in(Phase.NORMAL)


def test_return_asks_for_the_mode_once_and_gives_the_vehicle_up() -> None:
    flight = flying()
    since_s = flight.now_s
    ask(flight, OperatorCommand.RETURN)
    flight.fly(0.1)
    assert flight.is_in(Phase.HANDBACK)
    assert flight.asked_modes(since_s) == [FlightMode.RETURN]
    flight.show(FlightMode.RETURN)
    flight.fly(5.0)
    assert flight.is_in(Phase.YIELD)
    assert flight.asked_modes(since_s) == [FlightMode.RETURN]


def test_without_control_a_command_means_nothing() -> None:
    flight = ScriptedFlight().ready()
    for command in OperatorCommand:
        objection = flight.session.objection_to(command)
        assert objection is not None
        ask(flight, command)
        assert flight.texts[-1] == f"{command.name} refused: {objection}"
        flight.fly(1.0)
        assert flight.is_in(Phase.STANDBY)
    assert flight.asked_modes() == []


def in_phase(phase: Phase) -> ScriptedFlight:
    """A flight that has come to a phase by its own means."""
    match phase:
        case Phase.WAITING:
            return ScriptedFlight()
        case Phase.STANDBY:
            return ScriptedFlight().ready()
        case Phase.LAUNCHING:
            return ScriptedFlight(SessionParams(engage="auto")).asking_for_offboard()
        case Phase.YIELD:
            flight = flying()
            flight.show(FlightMode.HOLD, is_failsafe=True)
            return flight
        case Phase.HANDBACK:
            flight = flying()
            ask(flight, OperatorCommand.RETURN)
            flight.fly(0.1)
            return flight
        case Phase.FINISHED:
            flight = ScriptedFlight(SessionParams(stop_confirm_s=1.0, stop_radius_m=2.0))
            flight.follows = True
            flight.in_control()
            flight.fly_until_reported()
            return flight
        case Phase.HOLD:
            flight = flying()
            ask(flight, OperatorCommand.HOLD)
            flight.fly(0.1)
            return flight
        case Phase.STOPPED:
            flight = ScriptedFlight().ready()
            flight.give(StopRequested(flight.now_s))
            return flight
    return flying()


DOES_SOMETHING = {
    Phase.NORMAL: {"HOLD", "RETURN"},
    Phase.HOLD: {"RESUME", "RETURN"},
    Phase.YIELD: {"GRANT"},
    Phase.FINISHED: {"GRANT"},
}


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.DEGRADED])
@pytest.mark.parametrize("command", OperatorCommand)
def test_every_command_is_obeyed_or_refused_with_a_reason(
    phase: Phase, command: OperatorCommand
) -> None:
    flight = in_phase(phase)
    assert flight.is_in(phase)
    objection = flight.session.objection_to(command)
    assert (objection is None) is (command.name in DOES_SOMETHING.get(phase, set()))
    before = len(flight.log)
    ask(flight, command)
    answers = [each for _, each in flight.log[before:] if isinstance(each, Announce)]
    assert len(answers) == 1
    assert answers[0].must_pass
    assert answers[0].text.startswith(f"{command.name} {'refused' if objection else 'accepted'}")
    assert (objection or "") in answers[0].text
    if objection is not None:
        assert flight.is_in(phase)
        assert len(flight.log) == before + 1


def test_a_grant_that_waits_for_nothing_is_refused_and_one_for_a_found_vehicle_is_not() -> None:
    flight = ScriptedFlight()
    flight.show(FlightMode.OFFBOARD)
    flight.locate()
    flight.fly(1.0)
    assert flight.session.objection_to(OperatorCommand.GRANT) is None
    ask(flight, OperatorCommand.GRANT)
    assert flight.texts[-1] == "GRANT accepted: control begins"
    flight.fly(1.2)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


def test_a_grant_in_another_mode_names_the_mode_to_choose() -> None:
    flight = in_phase(Phase.YIELD)
    flight.session.authority.require_grant("failsafe")
    flight.show(FlightMode.RETURN)
    ask(flight, OperatorCommand.GRANT)
    assert flight.texts[-1] == "GRANT accepted: switch to offboard mode"


def test_a_hold_ends_with_the_control_it_was_made_under() -> None:
    flight = flying()
    ask(flight, OperatorCommand.HOLD)
    flight.fly(0.5)
    flight.show(FlightMode.POSITION)
    flight.fly(5.0)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.is_in(Phase.NORMAL)
