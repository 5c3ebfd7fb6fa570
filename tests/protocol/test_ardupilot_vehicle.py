"""Arming, modes, failsafes and AUTO of the simulated ArduCopter, over MAVLink bytes."""

from __future__ import annotations

import math

import pytest

from companion.mav import dialect
from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink
from sim_link.autopilot.incidents import GpsLoss
from sim_link.autopilot.scenario import AutopilotParams, FenceParams, Scenario
from tests.protocol.sim_helpers import (
    ACCEPTED,
    ARM,
    DENIED,
    FAILED,
    SET_MODE,
    TAKEOFF,
    GroundStation,
    local_setpoint,
)

STABILIZE, AUTO, GUIDED, RTL, CIRCLE, LAND, BRAKE = 0, 3, 4, 6, 7, 9, 17
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
STREAMS = (24, 30, 32, 33, 42, 245)
VELOCITY_ONLY = 0x0DC7
SQUARE = ((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0))


def copter(parameters: dict[str, float] | None = None, **scenario: object) -> GroundStation:
    """Booted, with the streams that the tests read."""
    autopilot = AutopilotParams(flavour="ardupilot", parameters=parameters or {})
    station = GroundStation(Scenario(autopilot=autopilot, **scenario))  # type: ignore[arg-type]
    station.run(2.5)
    for number in STREAMS:
        assert station.command(SET_INTERVAL, float(number), 1e5) == ACCEPTED
    return station


def flying(parameters: dict[str, float] | None = None, **scenario: object) -> GroundStation:
    """Ten metres up, in GUIDED."""
    station = copter(parameters, **scenario)
    assert choose(station, GUIDED) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(TAKEOFF, *[0.0] * 6, 10.0) == ACCEPTED
    station.run(12.0)
    assert station.position[2] == pytest.approx(-10.0, abs=0.3)
    return station


def choose(station: GroundStation, number: int) -> int:
    return station.command(SET_MODE, 1.0, float(number))


def number_of(station: GroundStation) -> int:
    """HEARTBEAT.custom_mode now."""
    station.refresh()
    return int(station.heartbeat.custom_mode)


def texts(station: GroundStation) -> list[str]:
    return [str(m.text) for m in station.all(mavlink.MAVLink_statustext_message)]


def test_nothing_but_heartbeats_and_timesync_until_it_is_asked() -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(flavour="ardupilot")))
    station.run(30.0)
    kinds = {m.get_type() for _, m in station.inbox if m.get_srcComponent() == 1}
    assert kinds <= {"HEARTBEAT", "TIMESYNC", "GPS_GLOBAL_ORIGIN"}
    assert len(station.all(mavlink.MAVLink_heartbeat_message)) == pytest.approx(30, abs=1)


def test_boots_in_stabilize_and_says_why_it_cannot_be_armed() -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(flavour="ardupilot")))
    station.run(0.5)
    assert (number_of(station), station.heartbeat.base_mode) == (STABILIZE, 0x51)
    assert station.command(ARM, 1.0) == FAILED
    station.run(1.0)
    assert choose(station, GUIDED) == ACCEPTED
    assert station.command(ARM, 1.0) == FAILED
    station.run(1.0)
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.status == mavlink.MAV_STATE_STANDBY
    assert texts(station)[:2] == ["Arm: AHRS: waiting for home", "Arm: Need Position Estimate"]


@pytest.mark.parametrize(("number", "name"), [(AUTO, "AUTO"), (RTL, "RTL"), (LAND, "LAND")])
def test_some_modes_cannot_be_armed_in_even_by_force(number: int, name: str) -> None:
    station = copter()
    assert choose(station, number) == ACCEPTED
    assert station.command(ARM, 1.0, 21196.0) == FAILED
    assert f"Arm: {name} mode not armable" in texts(station)


def test_an_idle_vehicle_disarms_after_ten_and_a_half_seconds() -> None:
    station = copter()
    assert choose(station, GUIDED) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    took_s = station.run_until(lambda: not station.is_armed, 12.0)
    assert took_s == pytest.approx(10.5, abs=0.1)


@pytest.mark.parametrize(
    ("number", "text"),
    [(99, "No such mode 99"), (18, "Mode change to THROW failed: init failed")],
)
def test_a_mode_that_it_does_not_fly_is_refused_with_a_text(number: int, text: str) -> None:
    station = copter()
    assert choose(station, number) == FAILED
    assert number_of(station) == STABILIZE
    assert text in texts(station)


@pytest.mark.parametrize("height_m", [0.0, -5.0])
def test_a_take_off_to_nowhere_is_refused(height_m: float) -> None:
    station = copter()
    choose(station, GUIDED)
    station.command(ARM, 1.0)
    assert station.command(TAKEOFF, *[0.0] * 6, height_m) == FAILED
    station.run(3.0)
    assert station.position[2] == pytest.approx(0.0, abs=0.01)


def test_land_disarms_a_second_after_the_touchdown() -> None:
    station = flying()
    assert station.command(mavlink.MAV_CMD_NAV_LAND) == ACCEPTED
    assert (number_of(station), station.heartbeat.base_mode) == (LAND, 0x51 | 0x80)
    station.run_until(lambda: station.sim.vehicle.body.is_on_ground, 30.0)
    assert station.run_until(lambda: not station.is_armed, 3.0) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("action", "number"), [(0, GUIDED), (1, RTL), (5, LAND)])
def test_a_silent_station_of_its_own_is_a_failsafe_if_enabled(action: int, number: int) -> None:
    station = flying({"FS_GCS_ENABLE": action})
    station.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
    station.stream = local_setpoint
    station.run(5.3)
    assert number_of(station) == number
    assert ("GCS Failsafe" in texts(station)) == (action != 0)
    assert (station.status == mavlink.MAV_STATE_CRITICAL) == (action != 0)


def test_an_outward_velocity_ends_inside_the_fence() -> None:
    station = flying({"FENCE_ENABLE": 1}, fence=FenceParams(corners_enu_m=SQUARE))
    station.stream = lambda: local_setpoint(vx=4.0, mask=VELOCITY_ONLY)
    station.run(15.0)
    assert 26.0 < station.position[0] < 30.0
    assert number_of(station) == GUIDED
    station.stream = lambda: local_setpoint(vx=-4.0, mask=VELOCITY_ONLY)
    station.run(2.0)
    assert station.position[0] < 24.0


def test_a_target_outside_the_fence_is_ignored_in_silence() -> None:
    station = flying({"FENCE_ENABLE": 1}, fence=FenceParams(corners_enu_m=SQUARE))
    said, before = len(texts(station)), station.position
    station.stream = lambda: local_setpoint(90.0, 10.0, -10.0)
    station.run(5.0)
    assert station.position == pytest.approx(before, abs=0.1)
    assert len(texts(station)) == said


def test_without_satellites_it_lands_and_the_ekf_report_says_why() -> None:
    station = flying(incidents=(GpsLoss(start_s=20.0),))
    station.run(26.5 - station.now_s)
    assert number_of(station) == LAND
    assert "EKF Failsafe: changed to LAND Mode" in texts(station)
    number = float(MAVLink_ekf_status_report_message.id)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, number) == ACCEPTED
    report = station.last(MAVLink_ekf_status_report_message)
    assert not report.flags & mavlink.ESTIMATOR_POS_HORIZ_ABS


def test_a_target_under_the_ground_lands_and_disarms() -> None:
    station = flying()
    station.send(local_setpoint(10.0, 10.0, 2.0, mask=dialect.POSITION_ONLY))
    station.run_until(lambda: not station.is_armed, 40.0)
    assert station.sim.vehicle.body.is_on_ground


def test_a_second_origin_has_no_effect() -> None:
    station = copter()
    station.send(mavlink.MAVLink_set_gps_global_origin_message(1, 470000000, 85460000, 480000))
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 49.0) == ACCEPTED
    reported = station.last(mavlink.MAVLink_gps_global_origin_message)
    assert reported.latitude == 473977420


@pytest.mark.parametrize("speed_cmps", [200.0, 500.0])
def test_it_goes_to_a_place_at_the_speed_of_its_parameter(speed_cmps: float) -> None:
    station = flying({"WPNAV_SPEED": speed_cmps})
    assert top_speed_mps(station, 40.0) == pytest.approx(speed_cmps / 100.0, rel=0.05)


def test_it_goes_to_a_place_at_the_speed_that_was_commanded_until_the_mode_changes() -> None:
    station = flying({"WPNAV_SPEED": 500.0})
    assert station.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 2.0) == ACCEPTED
    assert top_speed_mps(station, 30.0) == pytest.approx(2.0, rel=0.05)
    assert choose(station, BRAKE) == ACCEPTED
    assert station.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 2.0) == FAILED
    assert choose(station, GUIDED) == ACCEPTED
    assert top_speed_mps(station, -30.0) == pytest.approx(5.0, rel=0.05)


def top_speed_mps(station: GroundStation, north_m: float) -> float:
    """The vehicle is on its way to a distant position."""
    station.send(local_setpoint(north_m, 0.0, -10.0))
    speeds = []
    for _ in range(40):
        station.run(0.1)
        report = station.last(mavlink.MAVLink_local_position_ned_message)
        speeds.append(math.hypot(report.vx, report.vy))
    return max(speeds)


def test_it_climbs_at_the_speed_of_its_parameter() -> None:
    station = flying({"WPNAV_SPEED_UP": 100.0})
    station.send(local_setpoint(10.0, 10.0, -30.0))
    station.run(5.0)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert report.vz == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize("loiter_s", [0.0, 5.0])
def test_return_waits_over_home_before_it_comes_down(loiter_s: float) -> None:
    station = flying({"RTL_LOIT_TIME": 1000.0 * loiter_s, "RTL_ALT": 1000.0})
    station.send(local_setpoint(20.0, 10.0, -10.0))
    station.run(10.0)
    assert choose(station, RTL) == ACCEPTED
    station.run_until(lambda: abs(station.position[0] - 10.0) < 0.6, 20.0)
    waited_s = station.run_until(lambda: station.position[2] > -9.0, 20.0)
    assert waited_s == pytest.approx(1.2 + loiter_s, abs=0.8)


@pytest.mark.parametrize(("is_on", "is_out"), [(0, False), (1, False), (1, True)])
def test_sys_status_tells_of_a_breach_only_where_there_is_one(is_on: int, is_out: bool) -> None:
    station = copter({"FENCE_ENABLE": is_on}, fence=FenceParams(corners_enu_m=SQUARE))
    if is_out:
        station.sim.vehicle.body.position_enu_m = (60.0, 10.0, 0.0)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 1.0) == ACCEPTED
    status = station.last(mavlink.MAVLink_sys_status_message)
    bit = mavlink.MAV_SYS_STATUS_GEOFENCE
    assert status.onboard_control_sensors_present & bit
    assert bool(status.onboard_control_sensors_enabled & bit) == bool(is_on)
    assert bool(status.onboard_control_sensors_health & bit) != is_out


@pytest.mark.parametrize(("action", "number"), [(0, GUIDED), (1, RTL), (2, LAND)])
def test_a_fence_action_is_not_critical_and_only_one_that_reacts_is_enabled(
    action: int, number: int
) -> None:
    fence = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": 30.0}
    station = flying(fence | {"FENCE_ACTION": action})
    assert station.status == mavlink.MAV_STATE_ACTIVE
    station.sim.vehicle.body.position_enu_m = (60.0, 10.0, 10.0)
    station.run(1.2)
    assert number_of(station) == number
    assert station.status == mavlink.MAV_STATE_ACTIVE
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 1.0) == ACCEPTED
    status, bit = station.last(mavlink.MAVLink_sys_status_message), mavlink.MAV_SYS_STATUS_GEOFENCE
    assert not status.onboard_control_sensors_health & bit
    assert bool(status.onboard_control_sensors_enabled & bit) == (action != 0)


def test_a_pause_stands_in_guided_with_its_target_until_it_continues_or_the_mode_changes() -> None:
    station, pause = flying(), mavlink.MAV_CMD_DO_PAUSE_CONTINUE
    assert station.command(SET_INTERVAL, 85.0, 1e5) == ACCEPTED
    assert station.command(pause, 0.0) == ACCEPTED
    station.run(2.0)
    north_m = station.position[0]
    station.send(local_setpoint(20.0, 0.0, -10.0))
    station.run(5.0)
    assert station.position[0] == pytest.approx(north_m, abs=0.5)
    echo = station.last(mavlink.MAVLink_position_target_local_ned_message)
    assert number_of(station) == GUIDED
    assert echo.x == pytest.approx(20.0)
    assert station.command(pause, 2.0) == DENIED
    assert station.command(pause, 1.0) == ACCEPTED
    station.run(10.0)
    assert station.position[0] == pytest.approx(20.0, abs=0.5)
    station.command(pause, 0.0)
    assert [choose(station, number) for number in (BRAKE, GUIDED)] == [ACCEPTED] * 2
    station.send(local_setpoint(10.0, 0.0, -10.0))
    station.run(10.0)
    assert station.position[0] == pytest.approx(10.0, abs=0.5)


@pytest.mark.parametrize("rate", [20.0, -40.0])
def test_circle_goes_round_what_the_nose_pointed_at(rate: float) -> None:
    station = flying({"CIRCLE_RADIUS": 800.0, "CIRCLE_RATE": rate})
    body = station.sim.vehicle.body
    heading = body.yaw_ned_rad
    centre = (
        body.position_enu_m[0] + 8.0 * math.sin(heading),
        body.position_enu_m[1] + 8.0 * math.cos(heading),
    )
    assert choose(station, CIRCLE) == ACCEPTED
    station.run(3.0)
    turned = 0.0
    east, north, _ = body.position_enu_m
    before = math.atan2(east - centre[0], north - centre[1])
    for _ in range(50):
        station.run(0.1)
        east, north, up = body.position_enu_m
        now = math.atan2(east - centre[0], north - centre[1])
        turned += math.remainder(now - before, math.tau)
        before = now
        assert math.dist((east, north), centre) == pytest.approx(8.0, abs=2.5)
        assert up == pytest.approx(10.0, abs=0.5)
    assert math.degrees(turned) == pytest.approx(5.0 * rate, rel=0.2)
