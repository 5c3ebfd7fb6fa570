"""A vehicle that errs about its position, and its radio, as others see them on the wire."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from companion.domain import FlightMode
from companion.mav.dialect import MAVLink_radio_ranging_message, RangingFlag, mavlink
from sim_link.autopilot.estimator import FixChange, NavigationParams
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, PayloadParams, Scenario
from sim_link.world.environment import FieldChannelParams
from sim_link.world.point_mass import MulticopterParams, WindParams
from sim_link.world.radio_channel import AntennaModelParams
from tests.protocol.sim_helpers import ACCEPTED, ARM, GroundStation, local_setpoint

ERRS = NavigationParams(
    fix="dgps", sigma_m=2.0, height_sigma_m=3.0, time_constant_s=100.0, compass_error_deg=6.0
)
QUIET = FieldChannelParams(
    range_offset_m=0.0,
    bearing_offset_deg=0.0,
    p_nlos=0.0,
    range_sigma_m=0.0,
    bearing_sigma_deg=0.0,
)


def flying(scenario: Scenario, seed: int = 1, **setpoint: Any) -> GroundStation:
    """PX4 that holds a setpoint of 10 m to the north and to the east, 20 m up."""
    station = GroundStation(scenario, seed)
    station.stream = lambda: local_setpoint(10.0, 10.0, -20.0, **setpoint)
    station.run(3.0)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    station.run(20.0)
    return station


def test_the_vehicle_truly_stands_off_by_its_error() -> None:
    station = flying(Scenario(navigation=ERRS))
    vehicle = station.sim.vehicle
    shown = station.last(mavlink.MAVLink_local_position_ned_message)
    assert (shown.y, shown.x, -shown.z) == pytest.approx((10.0, 10.0, 20.0), abs=0.8)
    bias, truth = vehicle.estimator.bias_enu_m, vehicle.body.position_enu_m
    assert math.hypot(*bias) > 1.0
    stands = [t - s for t, s in zip(truth, (10.0, 10.0, 20.0), strict=True)]
    assert stands == pytest.approx([-b for b in bias], abs=0.8)


def test_every_report_of_the_place_has_the_same_error() -> None:
    station = flying(Scenario(navigation=ERRS))
    vehicle = station.sim.vehicle
    station.run(0.02)
    east, north, up = vehicle.estimator.reported_enu_m
    odometry = station.last(mavlink.MAVLink_odometry_message)
    assert (odometry.y, odometry.x, -odometry.z) == pytest.approx((east, north, up), abs=0.2)
    for kind in (mavlink.MAVLink_global_position_int_message, mavlink.MAVLink_gps_raw_int_message):
        fix: Any = station.last(kind)
        local = vehicle.estimator.world_origin.enu_from_geodetic(
            fix.lat / 1e7, fix.lon / 1e7, fix.alt / 1e3
        )
        assert local == pytest.approx((east, north, up), abs=0.3)


def test_it_stays_on_the_ground_until_it_is_sent_up_and_home_is_where_it_believes() -> None:
    station = GroundStation(Scenario(navigation=ERRS), 3)
    station.run(3.0)
    assert station.command(ARM, 1.0) == ACCEPTED
    station.run(3.0)
    vehicle = station.sim.vehicle
    assert vehicle.body.is_on_ground
    assert vehicle.body.position_enu_m == pytest.approx((10.0, 10.0, 0.0), abs=1e-9)
    assert vehicle.home_enu_m == pytest.approx(vehicle.aircraft.motion.position_enu_m, abs=1.0)
    assert vehicle.home_enu_m != vehicle.body.position_enu_m


def test_the_compass_error_is_in_the_heading_that_is_reported_and_flown() -> None:
    station = flying(Scenario(navigation=ERRS), yaw=0.5, mask=0x09F8)
    reported = station.last(mavlink.MAVLink_attitude_message)
    assert reported.yaw == pytest.approx(0.5, abs=0.01)
    true_rad = station.sim.vehicle.body.yaw_ned_rad
    assert true_rad == pytest.approx(0.5 - math.radians(6.0), abs=0.01)


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_receivers_tell_fix_and_accuracy(flavour: FlavourName) -> None:
    changes = (FixChange(at_s=5.0, fix="rtk_float", sigma_m=0.3),)
    navigation = NavigationParams(
        fix="rtk_fixed", sigma_m=0.02, height_sigma_m=0.04, reported_ratio=0.5, fix_changes=changes
    )
    autopilot = AutopilotParams(flavour=flavour)
    station = GroundStation(Scenario(navigation=navigation, autopilot=autopilot))
    number = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT
    station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 200_000)
    station.run(4.0)
    fix = station.last(mavlink.MAVLink_gps_raw_int_message)
    assert (fix.fix_type, fix.h_acc, fix.v_acc) == (6, 10, 20)
    station.run(4.0)
    fix = station.last(mavlink.MAVLink_gps_raw_int_message)
    assert (fix.fix_type, fix.h_acc, fix.v_acc) == (5, 150, 20)


def test_px4s_estimator_tells_it_in_metres() -> None:
    station = GroundStation(Scenario(navigation=ERRS))
    station.run(3.0)
    status = station.last(mavlink.MAVLink_estimator_status_message)
    assert status.pos_horiz_accuracy == pytest.approx(2.0)
    assert status.pos_vert_accuracy == pytest.approx(3.0)


def test_a_vehicle_without_errors_reports_what_a_receiver_with_rtk_does() -> None:
    station = GroundStation()
    station.run(3.0)
    fix = station.last(mavlink.MAVLink_gps_raw_int_message)
    assert (fix.fix_type, fix.h_acc, fix.v_acc) == (6, 20, 40)
    status = station.last(mavlink.MAVLink_estimator_status_message)
    assert status.pos_horiz_accuracy == pytest.approx(0.02)


def test_a_change_of_the_fix_moves_the_belief_at_once_and_the_truth_after_it() -> None:
    changes = (FixChange(at_s=30.0, fix="3d", sigma_m=5.0),)
    navigation = NavigationParams(fix="rtk_fixed", sigma_m=0.0, fix_changes=changes)
    station = flying(Scenario(navigation=navigation))
    body = station.sim.vehicle.body
    while station.now_s < 29.9:
        station.run(0.02)
    before = body.position_enu_m
    assert before == pytest.approx((10.0, 10.0, 20.0), abs=0.05)
    while station.now_s < 30.1:
        station.run(0.02)
    assert math.hypot(*station.sim.vehicle.estimator.bias_enu_m) > 1.0
    assert math.dist(body.position_enu_m, before) < 0.5
    station.run(15.0)
    assert math.dist(body.position_enu_m, before) > 1.0


def rangings(station: GroundStation) -> list[Any]:
    return station.all(MAVLink_radio_ranging_message, component=158)


def test_an_array_prints_in_its_own_frame_with_flags() -> None:
    antenna = AntennaModelParams(kind="two_axis", mount_deg=(0.0, -90.0, 0.0))
    scenario = Scenario(channel=QUIET, payload=PayloadParams(antenna=antenna))
    said = rangings(flying(scenario))[-1]
    assert said.flags == RangingFlag.BODY_FRAME | RangingFlag.ARRAY_ANGLE
    slant_m = math.sqrt(40.0**2 + 40.0**2 + 20.0**2)
    assert math.sin(said.bearing) == pytest.approx(40.0 / slant_m, abs=0.01)
    assert math.sin(said.elevation) == pytest.approx(40.0 / slant_m, abs=0.01)


def test_the_wind_leans_the_vehicle_and_turns_what_its_antenna_prints() -> None:
    wind = WindParams(north_mps=-10.0, let_through=0.0)
    antenna = AntennaModelParams(kind="line")
    scenario = Scenario(channel=QUIET, wind=wind, payload=PayloadParams(antenna=antenna))
    station = flying(scenario)
    reported = station.last(mavlink.MAVLink_attitude_message)
    assert math.degrees(reported.pitch) == pytest.approx(-10.0, abs=0.5)
    calm = rangings(flying(Scenario(channel=QUIET, payload=PayloadParams(antenna=antenna))))[-1]
    assert rangings(station)[-1].bearing == pytest.approx(calm.bearing, abs=0.01)  # pitch: no turn
    east = WindParams(east_mps=-10.0, let_through=0.0)
    aside = rangings(flying(Scenario(channel=QUIET, wind=east, payload=scenario.payload)))[-1]
    assert abs(aside.bearing - calm.bearing) > math.radians(3.0)


def test_what_lags_tells_of_where_the_vehicle_was() -> None:
    positions: dict[float, tuple[float, ...]] = {}

    def errors_m(lag_s: float) -> np.ndarray[Any, Any]:
        payload = PayloadParams(lag_s=lag_s, rate_hz=5.0)
        fast = MulticopterParams(max_speed_mps=5.0)
        station = flying(Scenario(channel=QUIET, payload=payload, vehicle=fast))
        station.stream = lambda: local_setpoint(90.0, 10.0, -20.0)
        positions.clear()
        station.inbox.clear()
        for _ in range(600):
            station.run(0.02)
            positions[round(station.sim.vehicle.time_s, 2)] = (
                station.sim.vehicle.body.position_enu_m
            )
        known = [each for each in rangings(station) if round(each.time_usec / 1e6, 2) in positions]
        target = (50.0, 50.0, 0.0)
        return np.array(
            [m.range - math.dist(positions[round(m.time_usec / 1e6, 2)], target) for m in known]
        )

    assert np.abs(errors_m(0.0)).max() < 1e-3
    late = errors_m(0.4)
    assert late.max() > 0.5  # drawing near: it reports the range of 2 m before
    assert late.min() < -0.5  # and going away
