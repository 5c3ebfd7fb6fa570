"""The session against a scripted vehicle: who flies, when, and what leaves."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from companion.config.schema import LimitsConfig
from companion.domain import Autopilot, FlightMode, LandedState, VehicleState
from companion.guidance.commands import SendHeartbeat, SendSetpoint, SessionParams
from companion.guidance.events import OperatorCommand, OperatorCommandReceived, VehicleMoved
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import FOREIGN_MODES, silent_since

# Before control


def test_silent_until_position_and_home_are_known() -> None:
    flight = ScriptedFlight()
    flight.has_position = False
    flight.heartbeat()
    flight.fly(2.0)
    assert flight.is_in(Phase.WAITING)
    assert silent_since(flight, -1.0)
    flight.has_position = True
    flight.fly(1.0)
    assert flight.is_in(Phase.WAITING)
    flight.locate()
    flight.fly(0.1)
    assert flight.is_in(Phase.STANDBY)


def test_in_standby_px4_gets_its_own_place_twenty_times_a_second() -> None:
    flight = ScriptedFlight().ready()
    flight.position_enu_m = (3.0, 4.0, 21.0)
    since_s = flight.now_s
    flight.fly(3.0)
    sent = flight.sent(SendSetpoint, since_s)
    assert len(sent) == 60
    assert {c.setpoint.position_enu_m for c in sent} == {(3.0, 4.0, 21.0)}


def test_in_standby_ardupilot_gets_silence() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    assert silent_since(flight, -1.0)


def test_ardupilot_in_guided_is_not_taken_before_its_takeoff_is_over() -> None:
    """A position target during the climb would end it (ArduCopter 4.5, observed)."""
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    for landed in (LandedState.ON_GROUND, LandedState.TAKEOFF):
        flight.report_landed(landed)
        flight.show(FlightMode.OFFBOARD)
        flight.fly(2.0)
        assert flight.is_in(Phase.STANDBY)
        assert silent_since(flight, -1.0)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


def test_a_heartbeat_leaves_once_a_second_from_the_tick_and_stops_with_it() -> None:
    flight = ScriptedFlight().ready()
    since_s = flight.now_s
    flight.fly(5.0)
    assert len(flight.sent(SendHeartbeat, since_s)) == 5
    since_s = flight.now_s
    flight.heartbeat()
    assert flight.sent(SendHeartbeat, since_s) == []


@pytest.mark.parametrize("mode", FOREIGN_MODES)
def test_no_other_mode_gives_control(mode: FlightMode) -> None:
    flight = ScriptedFlight().ready()
    flight.show(mode)
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    assert flight.asked_modes() == []


def test_offboard_on_the_ground_gives_no_control_until_armed() -> None:
    flight = ScriptedFlight()
    flight.heartbeat()
    flight.locate()
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD, is_armed=False)
    flight.fly(1.0)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


# Hold


def test_holds_after_five_seconds_without_ranging_and_resumes() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(4.9)
    assert flight.is_in(Phase.DEGRADED)
    flight.fly(0.2)
    assert flight.is_in(Phase.HOLD)
    assert "hold: no ranging for 5 s" in flight.texts
    flight.fly(1.0)
    assert len(set(flight.setpoints[-20:])) == 1
    flight.has_ranging = True
    flight.fly(0.6)
    assert flight.is_in(Phase.NORMAL)


def test_holds_when_its_own_position_is_stale() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = False
    flight.fly(0.5)
    assert flight.is_in(Phase.NORMAL)
    flight.fly(0.05)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: vehicle position is stale"
    flight.has_position = True
    flight.fly(1.1)
    assert flight.is_in(Phase.NORMAL)


def test_holds_when_the_link_is_lost_and_goes_silent_in_the_end() -> None:
    flight = ScriptedFlight().in_control()
    flight.heartbeat()
    flight.has_link = flight.has_ranging = False
    cut_s = flight.now_s
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: autopilot link lost"
    flight.fly(15.0)
    assert [at for at, c in flight.log if isinstance(c, SendSetpoint)][-1] == pytest.approx(
        cut_s + 10.0, abs=0.051
    )


def test_frames_without_a_heartbeat_do_not_end_the_silence() -> None:
    flight = ScriptedFlight().in_control()
    flight.heartbeat()
    flight.has_link = flight.has_ranging = False
    flight.fly(30.0)
    since_s = flight.now_s
    flight.has_link = flight.has_ranging = True
    flight.fly(0.5)  # positions only: the heartbeat of this second is still to come
    assert silent_since(flight, since_s)
    flight.show(FlightMode.HOLD, is_failsafe=True)
    flight.fly(3.0)
    assert silent_since(flight, since_s)
    assert flight.is_in(Phase.YIELD)


def test_holds_when_next_to_nothing_agrees_with_the_estimate() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly(6.0)
    flight.bearing_error_rad = math.pi
    flight.fly(2.5)
    assert flight.is_in(Phase.HOLD)
    assert "hold: measurements do not agree with the estimate" in flight.texts


def test_holds_while_the_filter_recovers() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly(6.0)
    flight.bearing_error_rad = math.pi
    flight.fly(4.5)
    assert flight.session.tracker.integrity.restarts == 1
    assert flight.is_in(Phase.HOLD)
    status = flight.session.status(flight.now_s)
    assert status.detail == "the filter is recovering from a contradiction"


# Limits


@pytest.mark.slow
def test_setpoints_stay_inside_fence_and_band_wherever_the_target_is() -> None:
    limits = LimitsConfig(
        fence_enu_m=((-10.0, -10.0), (25.0, -10.0), (25.0, 20.0), (-10.0, 20.0)),
        altitude_max_m=22.0,
    )
    flight = ScriptedFlight(limits=limits).in_control()
    flight.follows = True
    flight.fly(40.0)
    assert len(flight.setpoints) > 800
    for east, north, up in flight.setpoints:
        assert -7.0 - 1e-9 <= east <= 22.0 + 1e-9
        assert -7.0 - 1e-9 <= north <= 17.0 + 1e-9
        assert 5.0 <= up <= 22.0
    assert max(p[0] for p in flight.setpoints) > 20.0


@pytest.mark.parametrize(
    "position", [(200.0, 0.0, 20.0), (0.0, -900.0, 0.0), (-300.0, 300.0, 500.0)]
)
def test_a_vehicle_outside_is_walked_in_from_where_it_is(
    position: tuple[float, float, float],
) -> None:
    flight = ScriptedFlight()
    flight.position_enu_m = position
    flight.ready()
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.setpoints
    assert flight.setpoints[0] == pytest.approx((*position[:2], min(max(position[2], 5.9), 59.1)))
    for before, (east, north, up) in pairwise(flight.setpoints):
        assert max(abs(east), abs(north)) <= max(abs(before[0]), abs(before[1])) + 1e-6
        assert math.dist(before[:2], (east, north)) <= 5.0 * 0.05 + 1e-6
        assert up == before[2]
    assert math.dist(flight.setpoints[-1][:2], position[:2]) > 4.0


@pytest.mark.slow
def test_parked_on_the_reported_target_it_learns_nothing_more() -> None:
    flight = ScriptedFlight(SessionParams(stop_confirm_s=1.0)).in_control()
    flight.follows = True
    flight.fly(60.0)
    assert flight.is_in(Phase.FINISHED)
    before, accepted = flight.session.estimate, flight.session.tracker.accepted
    flight.fly(20.0)
    assert flight.session.estimate is before
    assert flight.session.tracker.accepted == accepted


def test_a_vehicle_that_is_left_alone_is_reported_so_once() -> None:
    flight = ScriptedFlight()
    flight.mode, flight.is_armed = FlightMode.OFFBOARD, True
    flight.heartbeat()
    flight.locate()
    flight.fly(30.0)
    assert flight.is_in(Phase.WAITING)
    assert [text for text in flight.texts if text.startswith("no control")] == [
        "no control: found in offboard; leave it first"
    ]


def test_what_is_missing_is_named_after_a_while() -> None:
    flight = ScriptedFlight()
    flight.heartbeat()
    flight.fly(9.0)
    assert not any("waiting for" in text for text in flight.texts)
    flight.fly(3.0)
    assert [text for text in flight.texts if "waiting for" in text] == [
        "waiting for a home position"
    ]


def test_positions_that_are_always_late_are_distinguished_from_none() -> None:
    """Over a slow link they come, and every one is too old to be flown on."""
    flight = ScriptedFlight()
    flight.has_position = False
    flight.heartbeat()
    flight.locate()
    for _ in range(240):
        late = VehicleState(flight.now_s - 0.6, flight.position_enu_m, (0.0, 0.0, 0.0))
        flight.give(VehicleMoved(flight.now_s, late))
        flight.fly(0.05)
    assert flight.is_in(Phase.WAITING)
    assert [text for text in flight.texts if "waiting for" in text] == [
        "waiting for a local position that is not 0.5 s late (is the link slow?)"
    ]


def test_a_target_beyond_the_fence_is_announced_once() -> None:
    limits = LimitsConfig(fence_enu_m=((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)))
    flight = ScriptedFlight(limits=limits).in_control()
    flight.follows = True
    flight.fly(20.0)
    assert len([text for text in flight.texts if "outside the fence" in text]) == 1


# A vehicle that stands still


def standstills(flight: ScriptedFlight) -> int:
    return flight.texts.count("vehicle does not follow: paused? reselect the mode")


@pytest.mark.parametrize("follows", [True, False])
def test_a_vehicle_that_does_not_follow_is_announced_once(follows: bool) -> None:
    flight = ScriptedFlight()
    flight.follows = follows
    flight.in_control()
    flight.fly(4.0)
    assert standstills(flight) == 0
    flight.fly(26.0)
    assert standstills(flight) == (0 if follows else 1)


def test_a_vehicle_that_has_moved_may_stand_still_again() -> None:
    flight = ScriptedFlight().in_control()
    flight.fly(12.0)
    flight.position_enu_m = flight.setpoints[-1]
    flight.fly(5.0)
    assert standstills(flight) == 1
    flight.fly(10.0)
    assert standstills(flight) == 2


def test_a_vehicle_that_holds_is_not_said_to_stand_still() -> None:
    flight = ScriptedFlight().in_control()
    flight.fly(3.0)
    flight.give(OperatorCommandReceived(flight.now_s, OperatorCommand.HOLD))
    flight.fly(30.0)
    assert flight.is_in(Phase.HOLD)
    assert standstills(flight) == 0
