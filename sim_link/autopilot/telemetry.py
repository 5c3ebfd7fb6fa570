"""The vehicle's state as MAVLink messages: health, battery, home, mission, identity; all by id.

Source: MAVLink common; bits as PX4 1.15 and ArduCopter 4.5 send them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.domain import FlightMode
from companion.geometry.coordinates import ned_from_enu
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from sim_link.autopilot import motion_messages as motion
from sim_link.autopilot.aircraft import CELLS
from sim_link.autopilot.motion_messages import INT16_MAX, UINT16_MAX, boot_ms, boot_us, to_e7
from sim_link.autopilot.protocols import plan_items
from sim_link.autopilot.protocols.addressing import flags_of
from sim_link.autopilot.protocols.plan_items import MissionProgress
from sim_link.autopilot.vehicle import SimVehicle

MAVLINK_VERSION = 3
INERTIAL_SENSORS = flags_of("MAV_SYS_STATUS_SENSOR", "3D_GYRO 3D_ACCEL 3D_MAG ABSOLUTE_PRESSURE")
GPS = mavlink.MAV_SYS_STATUS_SENSOR_GPS
AHRS = mavlink.MAV_SYS_STATUS_AHRS
RC = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
BATTERY = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
FENCE = mavlink.MAV_SYS_STATUS_GEOFENCE
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
BATTERY_LOW_SHARE, BATTERY_CRITICAL_SHARE = 0.15, 0.07
NEUTRAL_US = 1500
NO_ERRORS = (
    *("drop_rate_comm", "errors_comm"),
    *("errors_count1", "errors_count2", "errors_count3", "errors_count4"),
)

GOOD_ESTIMATE = flags_of(
    "ESTIMATOR",
    "ATTITUDE VELOCITY_HORIZ VELOCITY_VERT POS_HORIZ_REL POS_HORIZ_ABS POS_VERT_ABS "
    "PRED_POS_HORIZ_REL PRED_POS_HORIZ_ABS",
)
"""EKF_STATUS_FLAGS has the same bits."""
BLIND_ESTIMATE = flags_of("ESTIMATOR", "ATTITUDE VELOCITY_VERT POS_VERT_ABS CONST_POS_MODE")


def heartbeat(vehicle: SimVehicle) -> Message:
    """HEARTBEAT of the autopilot."""
    state = vehicle.flavour.heartbeat_state(vehicle.time_s)
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        vehicle.flavour.identity.autopilot,
        state.base_mode,
        state.custom_mode,
        state.system_status,
        MAVLINK_VERSION,
    )


def sys_status(vehicle: SimVehicle) -> Message:
    """SYS_STATUS; the prearm bit is healthy while arming would be accepted."""
    now_s, battery = vehicle.time_s, vehicle.battery
    present = INERTIAL_SENSORS | GPS | AHRS | BATTERY | PREARM
    health = INERTIAL_SENSORS
    health |= GPS if vehicle.estimator.has_fix else 0
    health |= AHRS if vehicle.estimator.is_position_valid else 0
    health |= BATTERY if battery.share > BATTERY_CRITICAL_SHARE else 0
    if vehicle.scenario.rc.is_present or vehicle.sticks.is_joystick_alive(now_s):
        present |= RC
        health |= RC if vehicle.sticks.read(now_s) is not None else 0
    fence = vehicle.flavour.fence_state(vehicle.body.position_enu_m)
    present |= FENCE if fence.is_present else 0
    health |= 0 if fence.is_breached else FENCE  # without a fence too: clients report a breach
    if vehicle.is_armed or vehicle.flavour.arming_refusal(now_s) is None:
        health |= PREARM
    enabled = present if fence.is_enabled else present & ~FENCE
    return mavlink.MAVLink_sys_status_message(
        present,
        enabled,
        health,
        load=250,
        voltage_battery=CELLS * battery.cell_mv if battery.is_known else UINT16_MAX,
        current_battery=battery.current_ca if battery.is_known else -1,
        battery_remaining=battery.percent if battery.is_known else -1,
        **dict.fromkeys(NO_ERRORS, 0),
    )


def system_time(vehicle: SimVehicle) -> Message:
    """SYSTEM_TIME; the Unix time stays 0 (unknown), so that a run depends on its seed only."""
    return mavlink.MAVLink_system_time_message(0, boot_ms(vehicle))


def extended_sys_state(vehicle: SimVehicle) -> Message:
    """EXTENDED_SYS_STATE."""
    return mavlink.MAVLink_extended_sys_state_message(
        mavlink.MAV_VTOL_STATE_UNDEFINED, vehicle.flavour.landed_state.value
    )


def battery_status(vehicle: SimVehicle) -> Message:
    """BATTERY_STATUS: a four-cell pack that only flying empties."""
    battery = vehicle.battery
    state = mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if not battery.is_known:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED
    elif battery.share <= BATTERY_CRITICAL_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    elif battery.share <= BATTERY_LOW_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW
    cells = [battery.cell_mv if battery.is_known else UINT16_MAX] * CELLS
    unused = [UINT16_MAX] * (10 - CELLS)
    drawn = (battery.current_ca, battery.consumed_mah) if battery.is_known else (-1, -1)
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_ALL,
        mavlink.MAV_BATTERY_TYPE_LIPO,
        INT16_MAX,
        cells + unused,
        *(*drawn, -1, battery.percent if battery.is_known else -1),
        time_remaining=battery.remaining_s if battery.is_known else 0,
        charge_state=state,
    )


def home_position(vehicle: SimVehicle) -> Message | None:
    """HOME_POSITION; its place about the EKF origin too."""
    if not vehicle.has_home:
        return None
    local = vehicle.estimator.local_from_world(vehicle.home_enu_m)
    is_copter = vehicle.flavour.identity.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    orientation = [math.nan] * 4 if is_copter else [1.0, 0.0, 0.0, 0.0]
    return mavlink.MAVLink_home_position_message(
        *vehicle.home_e7, *ned_from_enu(local), orientation, 0.0, 0.0, 0.0, boot_us(vehicle)
    )


def gps_global_origin(vehicle: SimVehicle) -> Message | None:
    """GPS_GLOBAL_ORIGIN: the zero of LOCAL_POSITION_NED, to the last digit as it was set."""
    if not vehicle.has_home:
        return None
    origin = vehicle.estimator.origin
    place = to_e7((origin.latitude_deg, origin.longitude_deg, origin.altitude_m))
    return mavlink.MAVLink_gps_global_origin_message(*place, boot_us(vehicle))


def autopilot_version(vehicle: SimVehicle) -> Message:
    """AUTOPILOT_VERSION."""
    identity = vehicle.flavour.identity
    return mavlink.MAVLink_autopilot_version_message(
        identity.capabilities,
        *(identity.firmware_version, identity.firmware_version, 0, 0),
        *([0] * 8, [0] * 8, [0] * 8),
        *(0, 0, vehicle.system_id),
    )


def mission_progress(vehicle: SimVehicle) -> MissionProgress:
    """How far the mission is."""
    mission = vehicle.aircraft.mission
    return MissionProgress(
        mission.current,
        len(mission.items),
        mission.state,
        is_in_mission_mode=vehicle.flavour.mode is FlightMode.MISSION,
        has_home=vehicle.flavour.rules.first_mission_item == 1,
    )


def mission_current(vehicle: SimVehicle) -> Message:
    """MISSION_CURRENT."""
    return plan_items.mission_current(mission_progress(vehicle))


def estimator_status(vehicle: SimVehicle) -> Message:
    """ESTIMATOR_STATUS."""
    is_good = vehicle.estimator.is_position_valid
    ratio = vehicle.estimator.test_ratio
    return mavlink.MAVLink_estimator_status_message(
        boot_us(vehicle),
        GOOD_ESTIMATE if is_good else BLIND_ESTIMATE,
        *(ratio, ratio, ratio, 0.05, 0.0, 0.0),
        0.3 if is_good else 50.0,
        0.4,
    )


def ekf_status_report(vehicle: SimVehicle) -> Message:
    """EKF_STATUS_REPORT, ArduPilot's."""
    is_good = vehicle.estimator.is_position_valid
    ratio = vehicle.estimator.test_ratio
    flags = GOOD_ESTIMATE if is_good else BLIND_ESTIMATE
    return MAVLink_ekf_status_report_message(flags, ratio, ratio, ratio, 0.05, 0.0, 0.0)


def rc_channels(vehicle: SimVehicle) -> Message | None:
    """RC_CHANNELS: roll, pitch, throttle and yaw; None while nobody holds any sticks."""
    sticks = vehicle.sticks.read(vehicle.time_s)
    if sticks is None:
        return None
    deflections = (sticks.right, -sticks.forward, sticks.up, sticks.yaw)
    roll, pitch, throttle, yaw = (round(NEUTRAL_US + 500 * value) for value in deflections)
    rest = (NEUTRAL_US,) * 4
    unused = (UINT16_MAX,) * 10
    return mavlink.MAVLink_rc_channels_message(
        boot_ms(vehicle), 8, roll, pitch, throttle, yaw, *rest, *unused, 255
    )


Builder = Callable[[SimVehicle], Message | None]

_BUILDERS: tuple[Builder, ...] = (
    *(heartbeat, sys_status, system_time, extended_sys_state, battery_status, home_position),
    *(gps_global_origin, autopilot_version, mission_current, estimator_status, rc_channels),
    *(motion.local_position_ned, motion.attitude, motion.attitude_quaternion, motion.odometry),
    *(motion.global_position_int, motion.altitude, motion.vfr_hud, motion.nav_controller_output),
    *(motion.position_target_local_ned, motion.position_target_global_int),
    *(motion.attitude_target, motion.highres_imu, motion.servo_output_raw, motion.raw_imu),
    *(motion.scaled_pressure, motion.power_status, motion.vibration, motion.distance_sensor),
    motion.gps_raw_int,
)
"""Each named as its message."""
BUILDERS = {
    int(getattr(mavlink, f"MAVLINK_MSG_ID_{build.__name__.upper()}")): build for build in _BUILDERS
} | {int(MAVLink_ekf_status_report_message.id): ekf_status_report}
"""What can be told; a flavour's rates say which of these it has."""


class Telemetry:
    """Builds messages of one vehicle."""

    def __init__(self, vehicle: SimVehicle) -> None:
        self._vehicle = vehicle

    def build(self, number: int) -> Message | None:
        """The message with id `number`, or None if it is unknown or has nothing to say now."""
        builder = BUILDERS.get(number)
        if builder is None or number not in self._vehicle.flavour.rules.streams.default_rates_hz:
            return None
        return builder(self._vehicle)
