"""HOLD, RESUME and RETURN, beside the mode switch."""

from companion.domain import FlightMode
from companion.guidance.authority.state_machine import Phase
from companion.guidance.commands import SendSetpoint
from companion.guidance.events import OperatorAsked, OperatorCommand
from tests.unit.companion.guidance.scripted import ScriptedFlight


def flying() -> ScriptedFlight:
    flight = ScriptedFlight().in_control()
    flight.fly(5.0)
    assert flight.is_in(Phase.NORMAL)
    return flight


def ask(flight: ScriptedFlight, command: OperatorCommand) -> None:
    flight.give(OperatorAsked(flight.now_s, command))


def test_hold_holds_at_the_next_tick_until_resume() -> None:
    flight = flying()
    ask(flight, OperatorCommand.HOLD)
    flight.fly(0.1)
    assert flight.is_in(Phase.HOLD)
    since_s = flight.now_s
    flight.fly(10.0)
    assert flight.is_in(Phase.HOLD)
    places = {c.setpoint.position_enu_m for c in flight.sent(SendSetpoint, since_s + 2.0)}
    assert len(places) == 1
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
        ask(flight, command)
        flight.fly(1.0)
        assert flight.is_in(Phase.STANDBY)
    assert flight.asked_modes() == []


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
