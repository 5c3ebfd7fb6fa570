"""Arming, modes and flight of the simulated PX4, over MAVLink bytes."""

from __future__ import annotations

import math

import pytest

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.world.point_mass import WindParams
from tests.protocol.sim_helpers import (
    ACCEPTED,
    ARM,
    DENIED,
    LAND,
    NAN,
    SET_MODE,
    TAKEOFF,
    TEMPORARILY_REJECTED,
    GroundStation,
    local_setpoint,
)

STANDBY, ACTIVE = mavlink.MAV_STATE_STANDBY, mavlink.MAV_STATE_ACTIVE
UNINIT = mavlink.MAV_STATE_UNINIT


@pytest.fixture
def station() -> GroundStation:
    station = GroundStation()
    station.run(2.5)
    return station


def test_is_not_armable_until_it_has_booted() -> None:
    station = GroundStation()
    station.run(1.9)
    assert station.command(ARM, 1.0) == TEMPORARILY_REJECTED
    assert station.command(ARM, 1.0, 21196.0) == TEMPORARILY_REJECTED
    assert station.status == UNINIT
    station.run(0.2)
    assert station.status == STANDBY
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.status == ACTIVE


def test_prearm_health_bit_tells_when_arming_would_be_accepted() -> None:
    station = GroundStation()
    station.run(1.5)
    prearm = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    report = station.last(mavlink.MAVLink_sys_status_message)
    assert report.onboard_control_sensors_present & prearm
    assert not report.onboard_control_sensors_health & prearm
    station.run(1.5)
    report = station.last(mavlink.MAVLink_sys_status_message)
    assert report.onboard_control_sensors_health & prearm


@pytest.mark.parametrize(
    "mode", [FlightMode.LAND, FlightMode.RETURN, FlightMode.POSITION, FlightMode.MISSION]
)
def test_cannot_be_armed_in_a_mode_that_does_not_allow_it(
    station: GroundStation, mode: FlightMode
) -> None:
    assert station.set_mode(mode) == ACCEPTED
    assert station.mode is mode
    assert station.command(ARM, 1.0) == TEMPORARILY_REJECTED
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED


def test_arm_and_disarm_are_idempotent(station: GroundStation) -> None:
    assert station.command(ARM, 0.0) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.is_armed
    assert station.command(ARM, 0.0) == ACCEPTED
    assert not station.is_armed


@pytest.mark.parametrize("wanted", [0.4, 2.0, -1.0, math.inf])
def test_nonsense_in_the_arm_parameter_is_not_answered(
    station: GroundStation, wanted: float
) -> None:
    with pytest.raises(AssertionError, match="0 answers"):
        station.command(ARM, wanted)
    assert not station.is_armed


def test_disarming_in_the_air_is_refused_unless_forced() -> None:
    station = GroundStation()
    station.take_off()
    assert station.command(ARM, 0.0) == TEMPORARILY_REJECTED
    assert station.command(ARM, 0.0, 1.0) == DENIED
    assert station.is_armed
    assert station.command(ARM, 0.0, 21196.0) == ACCEPTED
    assert not station.is_armed
    station.run(3.0)
    assert station.position[2] == pytest.approx(0.0, abs=1e-6)


def test_takes_off_to_an_altitude_above_sea_level_and_holds(station: GroundStation) -> None:
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, 500.0) == ACCEPTED
    assert station.mode is FlightMode.TAKEOFF
    station.run(1.0)
    state = station.last(mavlink.MAVLink_extended_sys_state_message)
    assert state.landed_state == mavlink.MAV_LANDED_STATE_TAKEOFF
    station.run_until(lambda: station.mode is FlightMode.HOLD, 30.0)
    station.run(5.0)
    assert station.position == pytest.approx((10.0, 10.0, -12.0), abs=0.1)
    state = station.last(mavlink.MAVLink_extended_sys_state_message)
    assert state.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR


def test_takeoff_without_an_altitude_uses_the_default(station: GroundStation) -> None:
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(TAKEOFF) == ACCEPTED
    station.run(10.0)
    assert station.position[2] == pytest.approx(-2.5, abs=0.1)


def test_takeoff_before_arming_flies_once_armed(station: GroundStation) -> None:
    assert station.command(TAKEOFF) == ACCEPTED
    station.run(1.0)
    assert station.position[2] == 0.0
    assert station.command(ARM, 1.0) == ACCEPTED
    station.run(10.0)
    assert station.position[2] == pytest.approx(-2.5, abs=0.1)


@pytest.mark.parametrize("altitude_m", [0.0, 488.0, 480.0, math.inf, 1e9])
def test_takeoff_to_nowhere_is_denied(station: GroundStation, altitude_m: float) -> None:
    assert station.command(TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, altitude_m) == DENIED
    assert station.mode is FlightMode.HOLD


def test_takeoff_as_command_int_reads_its_frame(station: GroundStation) -> None:
    assert station.command(ARM, 1.0) == ACCEPTED
    relative, terrain = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, 11
    assert station.command_int(TAKEOFF, terrain, z=6.0) == 9
    assert station.command_int(TAKEOFF, relative, z=6.0) == ACCEPTED
    station.run(10.0)
    assert station.position[2] == pytest.approx(-6.0, abs=0.1)


@pytest.mark.parametrize("is_command", [True, False])
def test_lands_and_disarms_after_two_seconds_and_can_fly_again(is_command: bool) -> None:
    station = GroundStation()
    station.take_off(5.0)
    result = station.command(LAND) if is_command else station.set_mode(FlightMode.LAND)
    assert result == ACCEPTED
    station.run(1.0)
    state = station.last(mavlink.MAVLink_extended_sys_state_message)
    assert state.landed_state == mavlink.MAV_LANDED_STATE_LANDING
    station.run_until(lambda: station.position[2] == 0.0, 30.0)
    grounded_s = station.run_until(lambda: not station.is_armed, 5.0)
    assert grounded_s == pytest.approx(2.0, abs=0.1)
    assert station.mode is FlightMode.HOLD
    assert station.command(ARM, 1.0) == ACCEPTED


def test_a_vehicle_that_is_armed_and_does_not_take_off_disarms_after_ten_seconds(
    station: GroundStation,
) -> None:
    assert station.command(ARM, 1.0) == ACCEPTED
    station.run(9.5)
    assert station.is_armed
    station.run(1.0)
    assert not station.is_armed
    assert station.position == (10.0, 10.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("is_command", [True, False])
def test_return_climbs_flies_home_lands_and_disarms(is_command: bool) -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(return_altitude_m=15.0)))
    station.take_off(5.0)
    station.stream = lambda: local_setpoint(60.0, 40.0, -5.0)
    station.run(0.5)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    station.run(15.0)
    assert station.position == pytest.approx((60.0, 40.0, -5.0), abs=0.2)
    number = mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH
    result = station.command(number) if is_command else station.set_mode(FlightMode.RETURN)
    assert result == ACCEPTED
    station.run_until(lambda: not station.is_armed, 90.0)
    assert station.position == pytest.approx((10.0, 10.0, 0.0), abs=0.5)
    heights = [-m.z for m in station.all(mavlink.MAVLink_local_position_ned_message)]
    assert max(heights) == pytest.approx(15.0, abs=1.0)


@pytest.mark.slow
def test_return_lands_in_a_strong_wind_too() -> None:
    wind = WindParams(east_mps=12.0, north_mps=9.0)
    autopilot = AutopilotParams(return_altitude_m=12.0)
    station = GroundStation(Scenario(wind=wind, autopilot=autopilot))
    station.fly_offboard()
    station.stream = lambda: local_setpoint(40.0, 40.0, -10.0)
    station.run(10.0)
    assert station.set_mode(FlightMode.RETURN) == ACCEPTED
    station.run_until(lambda: not station.is_armed, 120.0)
    assert station.position == pytest.approx((10.0, 10.0, 0.0), abs=5.0)


def test_offboard_on_the_ground_is_accepted_without_a_stream_but_cannot_be_armed(
    station: GroundStation,
) -> None:
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    assert station.mode is FlightMode.OFFBOARD
    assert station.heartbeat.base_mode == 1
    assert station.status == UNINIT
    assert station.command(ARM, 1.0) == TEMPORARILY_REJECTED
    station.stream = local_setpoint
    station.run(1.0)
    assert station.status == STANDBY
    assert station.heartbeat.base_mode == 17
    assert station.command(ARM, 1.0) == ACCEPTED
    station.run(10.0)
    assert station.heartbeat.base_mode == 145
    assert station.position == pytest.approx((10.0, 10.0, -10.0), abs=0.2)


def test_offboard_in_the_air_without_a_stream_is_refused() -> None:
    station = GroundStation()
    station.take_off()
    assert station.set_mode(FlightMode.OFFBOARD) == TEMPORARILY_REJECTED
    assert station.mode is FlightMode.HOLD


@pytest.mark.parametrize("mode", [FlightMode.POSITION, FlightMode.ALTITUDE, FlightMode.MISSION])
def test_modes_that_need_sticks_or_a_mission_are_refused_in_flight(mode: FlightMode) -> None:
    station = GroundStation()
    station.take_off()
    assert station.set_mode(mode) == TEMPORARILY_REJECTED
    assert station.mode is FlightMode.HOLD


@pytest.mark.parametrize(
    ("base", "main", "sub"),
    [
        (1.0, 99.0, 0.0),
        (1.0, NAN, 0.0),
        (1.0, 6.5, 0.0),
        (NAN, 6.0, 0.0),
        (0.0, 6.0, 0.0),
    ],
)
def test_main_modes_that_px4_does_not_have_are_accepted_without_effect(
    station: GroundStation, base: float, main: float, sub: float
) -> None:
    assert station.command(SET_MODE, base, main, sub) == ACCEPTED
    assert station.mode is FlightMode.HOLD


@pytest.mark.parametrize("sub", [77.0, 0.0, 1.0, math.inf])
def test_sub_modes_that_px4_does_not_have_are_rejected(station: GroundStation, sub: float) -> None:
    assert station.command(SET_MODE, 1.0, 4.0, sub) == TEMPORARILY_REJECTED
    assert station.mode is FlightMode.HOLD


def test_the_set_mode_message_is_answered_like_the_command(station: GroundStation) -> None:
    land = mavlink.MAVLink_set_mode_message(1, 1, 4 << 16 | 6 << 24)
    assert station.result_of(land) == ACCEPTED
    ack = station.last(mavlink.MAVLink_command_ack_message)
    assert ack.command == SET_MODE
    assert station.mode is FlightMode.LAND
    assert station.result_of(mavlink.MAVLink_set_mode_message(1, 1, 99 << 16)) == ACCEPTED
    assert station.mode is FlightMode.LAND


def test_hold_stops_the_vehicle_where_it_can_brake() -> None:
    station = GroundStation()
    station.fly_offboard()
    station.stream = lambda: local_setpoint(500.0, 10.0, -10.0)
    station.run(5.0)
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    north = station.position[0]
    station.run(10.0)
    rest = station.position
    assert north < rest[0] < north + 20.0
    station.run(5.0)
    assert station.position == pytest.approx(rest, abs=0.05)


@pytest.mark.parametrize(
    ("mode", "disarmed", "armed"),
    [(FlightMode.HOLD, 29, 157), (FlightMode.TAKEOFF, 29, 157)],
)
def test_base_mode_flags_are_those_of_px4(
    station: GroundStation, mode: FlightMode, disarmed: int, armed: int
) -> None:
    assert station.set_mode(mode) == ACCEPTED
    station.refresh()
    assert station.heartbeat.base_mode == disarmed
    assert station.command(ARM, 1.0) == ACCEPTED
    station.refresh()
    assert station.heartbeat.base_mode == armed
    assert station.heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4
    assert station.heartbeat.type == mavlink.MAV_TYPE_QUADROTOR
