"""The mode is unconfirmed after a stall or a long silence: a pilot may be flying."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, BatteryLevel, FlightMode, VehicleState
from companion.guidance.commands import SendSetpoint
from companion.guidance.control import TICK_S
from companion.guidance.events import (
    BatteryReported,
    ControlStalled,
    HeartbeatReceived,
    StopRequested,
    VehicleMoved,
    YawMeasured,
)
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since


def in_doubt(flight: ScriptedFlight) -> ScriptedFlight:
    """The control tick stood still for three seconds, and no HEARTBEAT has come since."""
    flight.has_heartbeat = False
    flight.skip(60)
    flight.fly(TICK_S)
    flight.give(ControlStalled(flight.now_s, 3.0))
    flight.fly(0.2)
    assert not flight.session.vehicle.mode_watch.is_known(flight.now_s)
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


def shown(flight: ScriptedFlight, order: int) -> bool:
    """Return True if the mode is known after a HEARTBEAT of this number in sending order."""
    flight.give(
        HeartbeatReceived(
            flight.now_s,
            Autopilot.PX4,
            FlightMode.OFFBOARD,
            is_armed=True,
            is_ready=True,
            is_failsafe=False,
            order=order,
        )
    )
    return flight.session.vehicle.mode_watch.is_known(flight.now_s)


def position(flight: ScriptedFlight, order: int, behind_s: float = 0.0) -> VehicleMoved:
    state = VehicleState(flight.now_s - behind_s, flight.position_enu_m, (0.0, 0.0, 0.0))
    return VehicleMoved(flight.now_s, state, order=order)


@pytest.mark.parametrize(("ahead", "ends"), [(-10, False), (10, True)])
def test_a_mode_that_was_shown_before_the_position_was_measured_ends_no_doubt(
    ahead: int, *, ends: bool
) -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position = False
    flight.fly(1.5)
    flight.give(position(flight, 1000))
    assert shown(flight, 1000 + ahead) is ends


def test_one_that_was_overtaken_on_the_way_is_dated_by_what_was_sent_before_it() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position = False
    flight.fly(1.5)
    flight.give(position(flight, 1000))
    flight.give(position(flight, 1020))
    assert shown(flight, 1010)


def test_nor_does_one_behind_a_position_that_came_late() -> None:
    """Over two ways, one of which is late."""
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position = False
    flight.fly(1.5)
    flight.give(position(flight, 1000))
    flight.give(position(flight, 900, behind_s=2.0))
    assert not shown(flight, 910)


def test_without_a_position_an_attitude_tells_what_is_of_the_present() -> None:
    """Autopilots send no local position while their estimator has none."""
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position = False
    flight.fly(2.0)
    assert not shown(flight, 2000)
    flight.give(YawMeasured(flight.now_s, flight.now_s, 0.0, order=2001))
    assert shown(flight, 2002)


@pytest.mark.parametrize("wish", ["battery", "stop"])
def test_who_shows_for_seconds_that_he_obeys_may_be_asked_though_nothing_is_stamped(
    wish: str,
) -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position, flight.has_heartbeat = False, True
    flight.fly(3.0)
    if wish == "battery":
        for _ in range(80):
            flight.give(BatteryReported(flight.now_s, 5.0, BatteryLevel.CRITICAL))
            flight.fly(TICK_S)
        assert flight.asked_modes() == [FlightMode.RETURN]
    else:
        flight.fly(3.0)
        flight.give(StopRequested(flight.now_s))
        assert flight.asked_modes() == [FlightMode.HOLD]


@pytest.mark.parametrize(
    ("level", "charge_pct"), [(BatteryLevel.CRITICAL, 5.0), (BatteryLevel.LOW, 15.0)]
)
def test_a_low_battery_does_not_take_the_vehicle_from_the_pilot(
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
    assert flight.texts[-1] == "stopping: reacquiring state before requesting hold"
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


def test_a_stop_ends_in_time_without_any_report_of_the_mode() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    stopped_s = flight.now_s
    flight.give(StopRequested(flight.now_s))
    flight.fly(1.5)
    assert flight.is_in(Phase.STOPPED)
    assert silent_since(flight, stopped_s)


def test_a_stop_that_learns_late_who_flies_has_time_for_more_than_one_request() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.give(StopRequested(flight.now_s))
    flight.fly(1.3)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(0.5)
    assert flight.asked_modes() == [FlightMode.HOLD]
    assert flight.is_in(Phase.HANDBACK)
    flight.fly(0.15)
    assert flight.is_in(Phase.STOPPED)


def test_after_a_stall_nothing_is_sent_for_a_place_of_the_past() -> None:
    flight = in_doubt(ScriptedFlight().in_control())
    flight.has_position = False
    doubt_s = flight.now_s
    flight.fly(0.6)
    flight.move(measured_at_s=flight.now_s - 0.7)
    flight.show(FlightMode.OFFBOARD)
    assert flight.session.vehicle.mode_watch.is_known(flight.now_s)
    flight.fly(1.0)
    assert silent_since(flight, doubt_s)
    flight.has_position = True
    flight.fly(TICK_S)
    assert not silent_since(flight, doubt_s)


def test_an_outdated_offboard_gives_no_control() -> None:
    flight = in_doubt(ScriptedFlight().ready())
    flight.has_position = False
    flight.fly(1.5)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.STANDBY)
    flight.has_position = True
    flight.fly(0.1)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
