"""Nobody knows who flies: after a stall, or a long silence, perhaps it is a pilot."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, BatteryLevel, FlightMode, VehicleState
from companion.guidance.commands import SendSetpoint
from companion.guidance.events import (
    BatteryReported,
    ControlStalled,
    HeartbeatReceived,
    StopRequested,
    VehicleMoved,
)
from companion.guidance.session import TICK_S
from companion.guidance.states import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since


def in_doubt(flight: ScriptedFlight) -> ScriptedFlight:
    """The control tick stood still for three seconds, and no HEARTBEAT has come since."""
    flight.has_heartbeat = False
    flight.skip(60)
    flight.fly(TICK_S)
    flight.give(ControlStalled(flight.now_s, 3.0))
    flight.fly(0.2)
    assert not flight.session.vehicle.is_mode_known(flight.now_s)
    return flight


@pytest.mark.parametrize("behind_s", [1.5, 11.0])
def test_after_long_silence_a_mode_of_the_past_is_no_reason_to_send(behind_s: float) -> None:
    """A link that held everything back brings the oldest first."""
    flight = ScriptedFlight().in_control()
    flight.has_link = False
    flight.fly(12.0)
    back_s = flight.now_s
    flight.move(measured_at_s=back_s - behind_s)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(3.0)
    assert silent_since(flight, back_s)
    flight.move(measured_at_s=flight.now_s)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(TICK_S)
    assert not silent_since(flight, back_s)


def test_a_short_silence_leaves_the_mode_as_it_was() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_link = False
    flight.fly(9.0)
    lost_s = flight.now_s
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, lost_s)) == 10


@pytest.mark.parametrize(("ahead", "ends"), [(-10, False), (10, True)])
def test_a_mode_that_was_shown_before_the_position_was_measured_ends_no_doubt(
    ahead: int, *, ends: bool
) -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_link = False
    now_s, order = flight.now_s, 1000
    state = VehicleState(now_s, flight.place, (0.0, 0.0, 0.0))
    flight.give(VehicleMoved(now_s, state, order))
    flight.give(
        HeartbeatReceived(
            now_s,
            Autopilot.PX4,
            FlightMode.OFFBOARD,
            is_armed=True,
            is_ready=True,
            is_failsafe=False,
            order=order + ahead,
        )
    )
    assert flight.session.vehicle.is_mode_known(now_s) is ends


@pytest.mark.parametrize(
    ("level", "charge_pct"), [(BatteryLevel.CRITICAL, 5.0), (BatteryLevel.LOW, 15.0)]
)
def test_a_battery_that_is_low_takes_the_vehicle_from_nobody(
    level: BatteryLevel, charge_pct: float
) -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    doubt_s = flight.now_s

    def fly(duration_s: float) -> None:
        for _ in range(round(duration_s / TICK_S)):
            flight.give(BatteryReported(flight.now_s, charge_pct, level))
            flight.fly(TICK_S)

    fly(3.0)
    assert flight.is_in(Phase.HOLD)
    assert silent_since(flight, doubt_s)
    flight.has_heartbeat = True
    fly(3.0)
    assert flight.asked_modes() == [FlightMode.RETURN]


def test_a_stop_looks_first_who_flies_and_then_asks() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.give(StopRequested(flight.now_s))
    assert flight.texts[-1] == "stopping: looking who flies, before asking to hold"
    flight.fly(0.3)
    assert flight.asked_modes() == []
    flight.show(FlightMode.OFFBOARD)
    flight.fly(TICK_S)
    assert flight.asked_modes() == [FlightMode.HOLD]
    flight.fly(0.5)
    assert flight.asked_modes() == [FlightMode.HOLD]


def test_a_stop_asks_nothing_of_a_vehicle_that_a_pilot_has_taken() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    stopped_s = flight.now_s
    flight.give(StopRequested(flight.now_s))
    flight.fly(0.3)
    flight.show(FlightMode.POSITION)
    assert flight.is_in(Phase.STOPPED)
    assert silent_since(flight, stopped_s)


def test_a_stop_ends_in_time_where_nobody_tells_who_flies() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    stopped_s = flight.now_s
    flight.give(StopRequested(flight.now_s))
    flight.fly(1.5)
    assert flight.is_in(Phase.STOPPED)
    assert silent_since(flight, stopped_s)


def test_offboard_of_the_past_gives_nobody_control() -> None:
    flight = in_doubt(ScriptedFlight().ready())
    flight.has_position = False
    flight.fly(1.5)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.STANDBY)
    flight.has_position = True
    flight.fly(0.1)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
