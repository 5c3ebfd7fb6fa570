"""Failsafes of the simulated PX4: links, fence, battery, satellites."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.estimator import GpsParams
from sim_link.autopilot.incidents import EkfJump, GpsLoss, RcLoss
from sim_link.autopilot.scenario import (
    AutopilotParams,
    BatteryParams,
    FenceParams,
    RcParams,
    Scenario,
)
from tests.protocol.sim_helpers import (
    ACCEPTED,
    ARM,
    DENIED,
    NAN,
    TEMPORARILY_REJECTED,
    GroundStation,
    local_setpoint,
)

CRITICAL = mavlink.MAV_STATE_CRITICAL
HOLD_BEFORE_S = 5.0
"""COM_FAIL_ACT_T."""
SQUARE = ((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0))


def texts(station: GroundStation) -> list[str]:
    """Return the autopilot's texts."""
    return [str(m.text) for m in station.all(mavlink.MAVLink_statustext_message)]


def flying(parameters: dict[str, float] | None = None, **scenario: object) -> GroundStation:
    """Ten metres up, in HOLD."""
    autopilot = AutopilotParams(parameters=parameters or {})
    station = GroundStation(Scenario(autopilot=autopilot, **scenario))  # type: ignore[arg-type]
    station.take_off()
    return station


def mode_of(station: GroundStation) -> FlightMode:
    return station.mode


def manual(x: int = 0, y: int = 0, z: int = 500, r: int = 0) -> mavlink.MAVLink_message:
    """MANUAL_CONTROL of a joystick."""
    return mavlink.MAVLink_manual_control_message(1, x, y, z, r, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "mode"), [(2, FlightMode.HOLD), (3, FlightMode.RETURN), (5, FlightMode.LAND)]
)
def test_leaving_the_fence_starts_its_action(action: int, mode: FlightMode) -> None:
    station = flying({"GF_ACTION": action}, fence=FenceParams(corners_enu_m=SQUARE))
    station.stream = lambda: local_setpoint(10.0, 60.0, -10.0)
    station.run(0.5)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    station.run_until(lambda: station.mode is not FlightMode.OFFBOARD, 15.0)
    assert station.mode is FlightMode.HOLD
    assert station.status == CRITICAL
    assert station.position[1] == pytest.approx(30.0, abs=3.0)
    waited_s = station.run_until(lambda: station.mode is mode, 6.0)
    assert waited_s == pytest.approx(0.0 if mode is FlightMode.HOLD else HOLD_BEFORE_S, abs=0.1)
    assert "Failsafe: fence breached" in texts(station)


def test_a_place_outside_the_fence_is_not_flown_to_and_not_armed_at() -> None:
    station = flying(fence=FenceParams(corners_enu_m=SQUARE))
    outside = mavlink.MAVLink_command_int_message(
        1, 1, 5, 192, 0, 0, -1.0, 1.0, 0.0, NAN, 473977420, 85559000, 498.0
    )
    assert station.result_of(outside) == DENIED
    assert "Reposition is outside geofence" in texts(station)
    away = GroundStation(Scenario(fence=FenceParams(corners_enu_m=SQUARE, is_inclusion=False)))
    away.run(3.0)
    assert away.command(ARM, 1.0) == TEMPORARILY_REJECTED
    assert "Arming denied: outside the geofence" in texts(away)


@pytest.mark.slow
def test_an_empty_battery_returns_and_lands() -> None:
    station = flying(battery=BatteryParams(endurance_s=400.0, start_share=0.11))
    station.run_until(lambda: station.mode is FlightMode.RETURN, 60.0)
    assert station.status == CRITICAL
    assert "Low battery level" in texts(station)
    assert "Failsafe: battery critical" in texts(station)
    station.run_until(lambda: not station.is_armed, 60.0)
    assert station.command(ARM, 1.0) == TEMPORARILY_REJECTED
    assert "Arming denied: battery too low" in texts(station)


def test_the_operator_may_take_over_from_a_battery_failsafe_until_it_gets_worse() -> None:
    station = flying(battery=BatteryParams(endurance_s=400.0, start_share=0.11))
    station.run_until(lambda: station.mode is FlightMode.RETURN, 60.0)
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    station.run(1.0)
    assert station.mode is FlightMode.HOLD
    station.run_until(lambda: station.mode is FlightMode.LAND, 20.0)
    assert "Failsafe: battery emergency" in texts(station)


@pytest.mark.slow
def test_a_silent_ground_station_is_a_failsafe_only_if_asked_for() -> None:
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    for action, mode in ((0, FlightMode.HOLD), (2, FlightMode.RETURN)):
        station = flying({"NAV_DLL_ACT": action, "COM_DL_LOSS_T": 5})
        station.send(beat)
        station.run(4.8)
        assert station.mode is FlightMode.HOLD
        station.run(0.5)
        assert station.mode is FlightMode.HOLD
        assert (station.status == CRITICAL) == (action != 0)
        station.send(beat)
        station.run(HOLD_BEFORE_S)
        assert station.mode is mode


def test_a_transmitter_that_is_lost_returns_and_shows_in_the_health() -> None:
    station = flying(
        rc=RcParams(is_present=True), incidents=(RcLoss(start_s=20.0, duration_s=4.0),)
    )
    report = station.last(mavlink.MAVLink_sys_status_message)
    assert report.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    station.run(21.2 - station.now_s)
    assert (station.mode, station.status) == (FlightMode.HOLD, CRITICAL)
    assert "Failsafe activated, entering Hold for 5 seconds\t" in texts(station)
    report = station.last(mavlink.MAVLink_sys_status_message)
    assert not report.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    station.run(25.2 - station.now_s)
    assert station.mode is FlightMode.RETURN
    station.run(5.0)
    assert station.mode is FlightMode.RETURN, "regained, it goes on until a mode is selected"
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    assert station.status == mavlink.MAV_STATE_ACTIVE


def test_a_failsafe_that_waits_in_hold_hears_no_sticks_but_a_mode() -> None:
    station = flying(rc=RcParams(is_present=True), incidents=(RcLoss(start_s=20.0),))
    station.run(21.0 - station.now_s)
    station.send(manual(x=900))
    station.run(1.0)
    assert mode_of(station) is FlightMode.HOLD
    assert station.set_mode(FlightMode.LAND) == ACCEPTED
    station.run(6.0)
    assert mode_of(station) is FlightMode.LAND


def test_a_cause_that_comes_and_goes_is_held_for_less_and_less() -> None:
    station = flying({"NAV_DLL_ACT": 3, "COM_DL_LOSS_T": 5})
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    for waited_s in (5.0, 2.3):
        station.send(beat)
        station.run(5.1)
        assert station.status == CRITICAL
        station.run(4.0)
        assert (station.mode is FlightMode.LAND) == (waited_s < 4.0)
        station.set_mode(FlightMode.HOLD)
        station.run(0.1)


def test_sticks_take_over_from_automatic_modes_and_fly() -> None:
    station = flying(rc=RcParams(is_present=True))
    assert station.set_mode(FlightMode.POSITION) == ACCEPTED
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    before = station.position
    for _ in range(20):
        station.send(manual(x=800))
        station.run(0.1)
    assert station.mode is FlightMode.POSITION
    assert station.position[0] - before[0] > 5.0
    station.run(5.0)
    rest = station.position
    station.run(2.0)
    assert station.position == pytest.approx(rest, abs=0.05)


@pytest.mark.parametrize(("deflection", "speed_mps"), [(50, 0.0), (150, 1.5), (300, 3.0)])
def test_a_small_deflection_flies_slowly_once_it_leaves_the_dead_zone(
    deflection: int, speed_mps: float
) -> None:
    station = flying(rc=RcParams(is_present=True))
    assert station.set_mode(FlightMode.POSITION) == ACCEPTED
    for _ in range(50):
        station.send(manual(x=deflection))
        station.run(0.1)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert report.vx == pytest.approx(speed_mps, abs=0.1)


def test_an_axis_that_a_joystick_does_not_have_is_centred() -> None:
    station = flying(rc=RcParams(is_present=True))
    assert station.set_mode(FlightMode.POSITION) == ACCEPTED
    before = station.position
    for _ in range(20):
        station.send(manual(x=32767, y=32767, z=32767, r=32767))
        station.run(0.1)
    assert station.position == pytest.approx(before, abs=0.3)


def test_offboard_is_not_overridden_by_sticks_unless_its_bit_is_set() -> None:
    for bits, mode in ((1, FlightMode.OFFBOARD), (3, FlightMode.POSITION)):
        station = flying({"COM_RC_OVERRIDE": bits})
        station.stream = local_setpoint
        station.run(0.5)
        assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
        station.send(manual(x=900))
        station.run(0.1)
        assert station.mode is mode


def test_without_satellites_it_drifts_then_lands_and_cannot_be_armed() -> None:
    station = flying(gps=GpsParams(drift_mps=0.5), incidents=(GpsLoss(start_s=20.0),))
    station.run(21.0 - station.now_s)
    fix = station.last(mavlink.MAVLink_gps_raw_int_message)
    assert (fix.fix_type, fix.satellites_visible) == (mavlink.GPS_FIX_TYPE_NO_FIX, 0)
    station.run(25.5 - station.now_s)
    assert station.mode is FlightMode.LAND
    station.run(1.0)
    flags = station.last(mavlink.MAVLink_estimator_status_message).flags
    assert not flags & mavlink.ESTIMATOR_POS_HORIZ_ABS
    station.run_until(lambda: not station.is_armed, 60.0)
    assert station.command(ARM, 1.0) == TEMPORARILY_REJECTED
    assert "Arming denied: no position estimate" in texts(station)


@pytest.mark.slow
def test_an_estimate_that_jumps_moves_what_is_reported_and_what_is_flown() -> None:
    station = flying(incidents=(EkfJump(start_s=30.0, east_m=8.0),))
    held = station.sim.vehicle.body.position_enu_m
    station.run(31.0 - station.now_s)
    assert station.position[1] == pytest.approx(18.0, abs=0.1)
    assert station.sim.vehicle.body.position_enu_m == pytest.approx(held, abs=0.1)
    station.stream = lambda: local_setpoint(10.0, 10.0, -10.0)
    station.run(0.5)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    station.run(10.0)
    assert station.position == pytest.approx((10.0, 10.0, -10.0), abs=0.1)
    assert station.sim.vehicle.body.position_enu_m[0] == pytest.approx(2.0, abs=0.1)


def test_origin_and_home_move_apart_and_are_reported() -> None:
    station = flying()
    before = station.sim.vehicle.body.position_enu_m
    origin = mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85460000, 480000)
    station.inbox.clear()
    station.send(origin)
    reported = station.last(mavlink.MAVLink_gps_global_origin_message)
    assert (reported.latitude, reported.longitude, reported.altitude) == (
        473977420,
        85460000,
        480000,
    )
    home = mavlink.MAVLink_command_int_message(
        1, 1, 5, mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0.0, NAN, NAN, NAN, 473980000, 85456000, 490.0
    )
    assert station.result_of(home) == ACCEPTED
    report = station.last(mavlink.MAVLink_home_position_message)
    assert (report.latitude, report.altitude) == (473980000, 490000)
    assert report.z == pytest.approx(-10.0, abs=0.01)
    station.run(2.0)
    assert station.sim.vehicle.body.position_enu_m == pytest.approx(before, abs=0.1)
    assert station.position[2] == pytest.approx(-18.0, abs=0.1)
    position = station.last(mavlink.MAVLink_global_position_int_message)
    assert position.relative_alt == pytest.approx(8000, abs=100)
