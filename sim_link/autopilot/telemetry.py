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
from sim_link.autopilot import motion_messages as sensors
from sim_link.autopilot.aircraft import CELLS
from sim_link.autopilot.motion_messages import boot_ms, boot_us, to_e7
from sim_link.autopilot.protocols.plan_items import MissionProgress, mission_current
from sim_link.autopilot.vehicle import SimVehicle

MAVLINK_VERSION = 3
INERTIAL_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
)
GPS = mavlink.MAV_SYS_STATUS_SENSOR_GPS
AHRS = mavlink.MAV_SYS_STATUS_AHRS
RC = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
BATTERY = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
FENCE = mavlink.MAV_SYS_STATUS_GEOFENCE
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
BATTERY_LOW_SHARE, BATTERY_CRITICAL_SHARE = 0.15, 0.07
UINT16_MAX = 0xFFFF
INT16_MAX = 0x7FFF
NEUTRAL_US = 1500

GOOD_ESTIMATE = (
    mavlink.ESTIMATOR_ATTITUDE
    | mavlink.ESTIMATOR_VELOCITY_HORIZ
    | mavlink.ESTIMATOR_VELOCITY_VERT
    | mavlink.ESTIMATOR_POS_HORIZ_REL
    | mavlink.ESTIMATOR_POS_HORIZ_ABS
    | mavlink.ESTIMATOR_POS_VERT_ABS
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
)
"""EKF_STATUS_FLAGS has the same bits."""
BLIND_ESTIMATE = (
    mavlink.ESTIMATOR_ATTITUDE
    | mavlink.ESTIMATOR_VELOCITY_VERT
    | mavlink.ESTIMATOR_POS_VERT_ABS
    | mavlink.ESTIMATOR_CONST_POS_MODE
)


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
        drop_rate_comm=0,
        errors_comm=0,
        errors_count1=0,
        errors_count2=0,
        errors_count3=0,
        errors_count4=0,
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
    if not battery.is_known:
        return _unknown_battery()
    state = mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if battery.share <= BATTERY_CRITICAL_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    elif battery.share <= BATTERY_LOW_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_ALL,
        mavlink.MAV_BATTERY_TYPE_LIPO,
        INT16_MAX,
        [battery.cell_mv] * CELLS + [UINT16_MAX] * (10 - CELLS),
        battery.current_ca,
        battery.consumed_mah,
        -1,
        battery.percent,
        time_remaining=battery.remaining_s,
        charge_state=state,
    )


def _unknown_battery() -> Message:
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_ALL,
        mavlink.MAV_BATTERY_TYPE_LIPO,
        INT16_MAX,
        [UINT16_MAX] * 10,
        -1,
        -1,
        -1,
        -1,
        charge_state=mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED,
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
        identity.firmware_version,
        identity.firmware_version,
        0,
        0,
        [0] * 8,
        [0] * 8,
        [0] * 8,
        0,
        0,
        vehicle.system_id,
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


def current_mission(vehicle: SimVehicle) -> Message:
    """MISSION_CURRENT."""
    return mission_current(mission_progress(vehicle))


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

BUILDERS: dict[int, Builder] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: extended_sys_state,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: motion.local_position_ned,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: motion.attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: motion.attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: motion.odometry,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: motion.global_position_int,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: motion.altitude,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: motion.vfr_hud,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: motion.nav_controller_output,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: motion.position_target_local_ned,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: motion.position_target_global_int,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: sensors.attitude_target,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: sensors.highres_imu,
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: sensors.servo_output_raw,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: sensors.raw_imu,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: sensors.scaled_pressure,
    mavlink.MAVLINK_MSG_ID_POWER_STATUS: sensors.power_status,
    mavlink.MAVLINK_MSG_ID_VIBRATION: sensors.vibration,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: sensors.distance_sensor,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: motion.gps_raw_int,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: battery_status,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: home_position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: gps_global_origin,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: current_mission,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: estimator_status,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: rc_channels,
    MAVLink_ekf_status_report_message.id: ekf_status_report,
}
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
