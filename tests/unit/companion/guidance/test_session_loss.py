"""The session when control is lost, and when it is given again."""

from __future__ import annotations

import math

import pytest

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import SendSetpoint
from companion.guidance.control import TICK_S
from companion.guidance.events import (
    OperatorCommand,
    OperatorCommandReceived,
)
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import FOREIGN_MODES, silent_since


@pytest.mark.slow
@pytest.mark.parametrize("mode", FOREIGN_MODES)
@pytest.mark.parametrize("is_failsafe", [False, True])
def test_any_other_mode_means_silence_from_that_very_event_on(
    mode: FlightMode, is_failsafe: bool
) -> None:
    flight = ScriptedFlight().in_control()
    lost_s = flight.now_s
    flight.show(mode, is_failsafe=is_failsafe)
    assert flight.is_in(Phase.YIELD)
    assert flight.has_withdrawn
    flight.fly(60.0 if is_failsafe else 1.95)
    assert silent_since(flight, lost_s)
    assert flight.asked_modes() == []


def test_a_failsafe_while_holding_is_a_loss_too() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(6.0)
    lost_s = flight.now_s
    flight.show(FlightMode.RETURN, is_failsafe=True)
    flight.has_ranging = True
    flight.fly(10.0)
    assert silent_since(flight, lost_s)


def test_offboard_seen_right_after_the_loss_is_our_own_echo() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.HOLD, is_failsafe=True)
    lost_s = flight.now_s
    flight.fly(1.9)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.YIELD)
    flight.show(FlightMode.HOLD)
    flight.fly(1.0)
    assert silent_since(flight, lost_s)


@pytest.mark.parametrize("autopilot", [Autopilot.PX4, Autopilot.ARDUPILOT])
def test_a_mode_that_was_chosen_is_switched_back_without_a_grant(autopilot: Autopilot) -> None:
    """PX4 needs the stream for it, which begins again and moves nothing."""
    flight = ScriptedFlight(autopilot=autopilot)
    flight.report_landed(LandedState.IN_AIR)
    flight.in_control()
    flight.show(FlightMode.POSITION)
    lost_s = flight.now_s
    flight.fly(1.95)
    assert silent_since(flight, lost_s)
    flight.fly(0.1)
    assert flight.is_in(Phase.STANDBY)
    assert flight.texts[-1] == f"ready: switch to {flight.guided_name} to hand over"
    since_s = flight.now_s
    flight.fly(1.0)
    streamed = {command.setpoint.position_enu_m for command in flight.sent(SendSetpoint, since_s)}
    assert streamed == ({flight.position_enu_m} if autopilot is Autopilot.PX4 else set())
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
    flight.fly(0.2)
    assert flight.is_in(Phase.NORMAL)
    assert flight.asked_modes() == []


def test_a_grant_makes_ready_and_the_mode_switch_engages() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.POSITION)
    flight.fly(1.0)
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    assert flight.is_in(Phase.STANDBY)
    granted_s = flight.now_s
    flight.fly(1.0)
    assert len(flight.sent(SendSetpoint, granted_s)) == 20
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
    assert flight.asked_modes() == []


def test_the_first_setpoint_after_a_loss_is_where_the_vehicle_is() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.POSITION)
    flight.position_enu_m = (-60.0, -70.0, 30.0)
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    since_s = flight.now_s
    flight.show(FlightMode.OFFBOARD)
    flight.fly(0.05)
    (first,) = flight.sent(SendSetpoint, since_s)
    assert math.dist(first.setpoint.position_enu_m, flight.position_enu_m) < 0.5


def test_disarming_ends_the_flight_and_leftover_offboard_does_not_begin_the_next() -> None:
    flight = ScriptedFlight().in_control()
    ended_s = flight.now_s
    flight.show(FlightMode.OFFBOARD, is_armed=False)
    assert flight.is_in(Phase.WAITING)
    flight.fly(2.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    assert silent_since(flight, ended_s)
    flight.show(FlightMode.HOLD)
    flight.fly(2.1)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


@pytest.mark.parametrize(
    ("mode", "is_failsafe"),
    [(FlightMode.OFFBOARD, False), (FlightMode.RETURN, True), (FlightMode.HOLD, True)],
)
def test_a_vehicle_found_in_flight_is_left_alone(mode: FlightMode, is_failsafe: bool) -> None:
    flight = ScriptedFlight()
    flight.show(mode, is_failsafe=is_failsafe)
    flight.locate()
    flight.fly(20.0)
    assert flight.is_in(Phase.WAITING)
    assert silent_since(flight, -1.0)
    assert flight.session.status(flight.now_s).detail.startswith("found in offboard")
    flight.show(FlightMode.HOLD)
    flight.fly(1.9)
    assert flight.is_in(Phase.WAITING)  # a failsafe may be reported a beat later
    flight.fly(0.2)
    assert flight.is_in(Phase.STANDBY)


def test_a_grant_is_enough_for_a_vehicle_found_in_offboard() -> None:
    flight = ScriptedFlight()
    flight.show(FlightMode.OFFBOARD)
    flight.locate()
    flight.fly(3.0)
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.GRANT))
    flight.fly(1.2)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


@pytest.mark.parametrize(("missed", "is_anew"), [(4, False), (7, True)])
def test_after_a_pause_the_stream_begins_where_the_vehicle_is(missed: int, is_anew: bool) -> None:
    """The vehicle stays behind its setpoint; then ticks are missed."""
    flight = ScriptedFlight().in_control()
    flight.fly(4.0)
    assert math.dist(flight.setpoints[-1], flight.position_enu_m) > 3.0
    flight.skip(missed)
    flight.fly(TICK_S)
    assert (math.dist(flight.setpoints[-1], flight.position_enu_m) < 0.5) is is_anew


def test_a_pause_on_a_stale_position_leaves_the_setpoint_where_it_is() -> None:
    """The position of a second ago is no better than the one that the vehicle was sent to."""
    flight = ScriptedFlight().in_control()
    flight.fly(4.0)
    flight.has_position = False
    flight.fly(1.0)
    last = flight.setpoints[-1]
    assert math.dist(last, flight.position_enu_m) > 1.0
    flight.skip(7)
    flight.fly(TICK_S)
    assert flight.setpoints[-1] == last
