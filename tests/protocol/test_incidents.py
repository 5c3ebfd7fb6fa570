"""Incidents of the simulated vehicle that no client requests, by script or at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.domain import FlightMode
from companion.mav import dialect
from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink
from sim_link.autopilot import incidents
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import Incident
from sim_link.autopilot.scenario import AutopilotParams, RcParams, Scenario
from tests.protocol.sim_helpers import ACCEPTED, ARM, DENIED, TAKEOFF, GroundStation, local_setpoint

STABILIZE, GUIDED, LOITER, RTL, LAND, ALT_HOLD = 0, 4, 5, 6, 9, 2
RC_CHANNELS = float(mavlink.MAVLINK_MSG_ID_RC_CHANNELS)


def px4(*script: Incident, **scenario: object) -> GroundStation:
    """Ten metres up, in HOLD, about 13 s after boot."""
    station = GroundStation(Scenario(incidents=script, **scenario))  # type: ignore[arg-type]
    station.take_off()
    return station


def copter(parameters: dict[str, float] | None = None) -> GroundStation:
    """Ten metres up, in GUIDED, positions flowing."""
    autopilot = AutopilotParams(flavour="ardupilot", parameters=parameters or {})
    station = GroundStation(Scenario(autopilot=autopilot))
    station.run(3.0)
    for number in (32, 33, 193):
        assert station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e5) == ACCEPTED
    assert station.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, float(GUIDED)) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(TAKEOFF, *[0.0] * 6, 10.0) == ACCEPTED
    station.run(8.0)
    return station


def happen(station: GroundStation, incident: Incident) -> None:
    station.sim.apply_incident(incident, station.now_s)


def mode_of(station: GroundStation) -> FlightMode:
    return station.mode


def copter_mode(station: GroundStation) -> int:
    station.refresh()
    return int(station.heartbeat.custom_mode)


def test_a_script_happens_at_its_times_in_any_order() -> None:
    station = px4(
        incidents.PilotMode(start_s=25.0, mode=FlightMode.LAND),
        incidents.PilotMode(start_s=20.0, mode=FlightMode.RETURN),
    )
    station.run(19.9 - station.now_s)
    assert mode_of(station) is FlightMode.HOLD
    station.run(0.2)
    assert mode_of(station) is FlightMode.RETURN
    station.run(25.1 - station.now_s)
    assert mode_of(station) is FlightMode.LAND


def test_a_pilot_without_a_transmitter_cannot_have_a_mode_for_sticks() -> None:
    station = px4()
    happen(station, incidents.PilotMode(mode=FlightMode.POSITION))
    assert mode_of(station) is FlightMode.HOLD
    happen(station, incidents.PilotSticks(forward=0.0))
    happen(station, incidents.PilotMode(mode=FlightMode.POSITION))
    assert mode_of(station) is FlightMode.POSITION


@pytest.mark.parametrize(
    ("mode", "number"),
    [
        (FlightMode.POSITION, LOITER),
        (FlightMode.RETURN, RTL),
        (FlightMode.LAND, LAND),
        (FlightMode.ALTITUDE, ALT_HOLD),
    ],
)
def test_a_pilot_of_arducopter_switches_modes(mode: FlightMode, number: int) -> None:
    station = copter()
    happen(station, incidents.PilotMode(mode=mode))
    assert copter_mode(station) == number


def test_sticks_show_in_rc_channels_and_fly_where_a_mode_obeys_them() -> None:
    station = px4(rc=RcParams(is_present=True))
    happen(station, incidents.PilotMode(mode=FlightMode.POSITION))
    before = station.position
    happen(station, incidents.PilotSticks(forward=0.8, yaw=-0.5, duration_s=2.0))
    station.run(1.0)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, RC_CHANNELS) == ACCEPTED
    channels = station.last(mavlink.MAVLink_rc_channels_message)
    assert (channels.chan2_raw, channels.chan4_raw) == (1100, 1250)
    assert station.position[0] - before[0] > 1.5
    station.run(2.0)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, RC_CHANNELS) == ACCEPTED
    assert station.last(mavlink.MAVLink_rc_channels_message).chan2_raw == 1500


def test_a_lost_transmitter_comes_back() -> None:
    station = px4(rc=RcParams(is_present=True))
    happen(station, incidents.RcLoss(duration_s=4.0))
    station.run(1.0)
    assert station.status == mavlink.MAV_STATE_CRITICAL
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, RC_CHANNELS) == DENIED
    station.run(4.0)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, RC_CHANNELS) == ACCEPTED


@pytest.mark.slow
def test_a_poor_estimate_shows_in_estimator_status_and_ends() -> None:
    station = px4(incidents.EkfPoor(start_s=20.0, ratio=2.0, duration_s=5.0))
    station.run(22.0 - station.now_s)
    report = station.last(mavlink.MAVLink_estimator_status_message)
    assert report.pos_horiz_ratio == pytest.approx(2.0)
    assert station.all(mavlink.MAVLink_local_position_ned_message)
    assert mode_of(station) is FlightMode.HOLD
    station.run(26.5 - station.now_s)
    assert station.last(mavlink.MAVLink_estimator_status_message).pos_horiz_ratio < 0.1


def test_a_jump_of_the_heading_shows_in_the_reports_and_turns_the_vehicle_back() -> None:
    station = px4()
    station.stream = lambda: local_setpoint(yaw=0.0, mask=dialect.POSITION_AND_YAW)
    station.run(0.5)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    happen(station, incidents.EkfJump(east_m=0.0, yaw_deg=30.0))
    station.run(0.1)
    reported = station.last(mavlink.MAVLink_attitude_message).yaw
    assert reported == pytest.approx(math.radians(30.0), abs=0.1)
    station.run(3.0)
    assert station.last(mavlink.MAVLink_attitude_message).yaw == pytest.approx(0.0, abs=0.01)
    assert station.sim.vehicle.body.yaw_ned_rad == pytest.approx(math.radians(-30.0), abs=0.01)


def test_a_shifted_origin_is_reported_and_moves_only_the_local_frame() -> None:
    station = px4()
    before, true = station.position, station.sim.vehicle.body.position_enu_m
    station.inbox.clear()
    happen(station, incidents.OriginShift(east_m=10.0, north_m=-1000.0))
    station.run(0.1)
    assert station.all(mavlink.MAVLink_gps_global_origin_message)
    north, east, down = station.position
    moved = (north - before[0], east - before[1], down - before[2])
    assert moved == pytest.approx((1000.0, -10.0, 0.0), abs=0.2)
    station.run(2.0)
    assert station.sim.vehicle.body.position_enu_m == pytest.approx(true, abs=0.1)


def test_a_charge_changes_and_may_be_unknown() -> None:
    station = px4()
    happen(station, incidents.BatteryCharge(share=0.14))
    station.run(2.0)
    status = station.last(mavlink.MAVLink_sys_status_message)
    assert status.battery_remaining == 14
    assert station.last(mavlink.MAVLink_battery_status_message).battery_remaining == 14
    happen(station, incidents.BatteryCharge(share=None))
    station.run(2.0)
    status = station.last(mavlink.MAVLink_sys_status_message)
    reported = (status.voltage_battery, status.current_battery, status.battery_remaining)
    assert reported == (0xFFFF, -1, -1)
    assert station.last(mavlink.MAVLink_battery_status_message).battery_remaining == -1


def test_a_wind_changes() -> None:
    station = px4()
    before = station.sim.vehicle.body.position_enu_m
    happen(station, incidents.WindChange(east_mps=12.0))
    station.run(5.0)
    after = station.sim.vehicle.body.position_enu_m
    assert 0.5 < after[0] - before[0] < 3.0
    assert after[1] == pytest.approx(before[1], abs=0.1)


@pytest.mark.parametrize("make", [px4, copter])
def test_a_reboot_is_silent_falls_and_begins_a_new_clock(
    make: Callable[[], GroundStation],
) -> None:
    station = make()
    position = station.sim.vehicle.body.position_enu_m
    happen(station, incidents.VehicleReboot(down_s=2.0))
    station.inbox.clear()
    station.run(1.9)
    assert not station.inbox
    station.run(2.0)
    beat = station.all(mavlink.MAVLink_heartbeat_message)[0]
    assert not beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 2.0) == ACCEPTED
    assert station.last(mavlink.MAVLink_system_time_message).time_boot_ms < 2500
    body = station.sim.vehicle.body
    assert body.is_on_ground
    assert body.position_enu_m[:2] == pytest.approx(position[:2], abs=0.1)


def test_a_scripted_reboot_happens_once() -> None:
    station = px4(incidents.VehicleReboot(start_s=20.0, down_s=1.0))
    station.run(20.5 - station.now_s)
    station.inbox.clear()
    station.run(10.0)
    assert station.sim.vehicle.time_s == pytest.approx(9.5, abs=0.1)


@pytest.mark.parametrize(("action", "number"), [(1, LAND), (2, ALT_HOLD), (3, LAND)])
def test_arducopter_answers_a_poor_estimate_by_its_parameter(action: int, number: int) -> None:
    station = copter({"FS_EKF_ACTION": action})
    happen(station, incidents.EkfPoor(ratio=0.9))
    station.run(0.8)
    assert copter_mode(station) == GUIDED
    station.run(0.6)
    assert copter_mode(station) == number
    report = station.last(MAVLink_ekf_status_report_message)
    assert report.pos_horiz_variance == pytest.approx(0.9)


@pytest.mark.parametrize(("action", "number"), [(1, STABILIZE), (2, STABILIZE), (3, LAND)])
def test_arducopter_leaves_a_mode_without_position_alone_unless_configured_otherwise(
    action: int, number: int
) -> None:
    station = copter({"FS_EKF_ACTION": action})
    happen(station, incidents.PilotSticks(forward=0.0))
    happen(station, incidents.PilotMode(mode=FlightMode.STABILIZED))
    happen(station, incidents.EkfPoor(ratio=0.9))
    station.run(1.5)
    assert copter_mode(station) == number


@pytest.mark.parametrize("started_s", np.random.default_rng(1).uniform(0.0, 300.0, 20))
def test_a_stall_ends_at_any_time_on_a_clock_that_only_its_timers_move(started_s: float) -> None:
    stalls = [incidents.AutopilotStall(start_s=1.0 + 30.1 * n, duration_s=30.0) for n in range(20)]
    sim = SimEndpoint(Scenario(incidents=tuple(stalls)), 1, started_s)
    before_s = -math.inf
    while (now_s := sim.next_timer_s()) < started_s + 610.0:
        sim.handle_timer(now_s)
        assert now_s > before_s
        before_s = now_s
