"""The vehicle's state as the fields of MAVLink messages: health, battery, home; and all by id.

As in `motion_messages` each function is named as its message. Source: MAVLink common; bits as
PX4 1.15 and ArduCopter 4.5 send them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import get_args

from companion.domain import FlightMode
from companion.geometry.coordinates import ned_from_enu
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from companion.mav.payloads import IdentifiedMissionCurrent
from sim_link.autopilot import motion_messages as motion
from sim_link.autopilot.aircraft import CELLS
from sim_link.autopilot.incidents import VehicleTypeName
from sim_link.autopilot.motion_messages import (
    INT16_MAX,
    UINT16_MAX,
    Fields,
    boot_ms,
    boot_us,
    to_e7,
)
from sim_link.autopilot.protocols.addressing import flags_of
from sim_link.autopilot.protocols.command_protocol import NS_PER_S
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
LOAD_PERMILLE = 250
NO_ERRORS = (0, 0, 0, 0, 0, 0)
"""Error counts of the link and of the autopilot."""

GOOD_ESTIMATE = flags_of(
    "ESTIMATOR",
    "ATTITUDE VELOCITY_HORIZ VELOCITY_VERT POS_HORIZ_REL POS_HORIZ_ABS POS_VERT_ABS "
    "PRED_POS_HORIZ_REL PRED_POS_HORIZ_ABS",
)
"""EKF_STATUS_FLAGS has the same bits."""
BLIND_ESTIMATE = flags_of("ESTIMATOR", "ATTITUDE VELOCITY_VERT POS_VERT_ABS CONST_POS_MODE")

OTHER_TYPE_NAMES = {
    "plane": "FIXED_WING",
    "quadplane": "VTOL_RESERVED2",  # VTOL_FIXEDROTOR in later dialects
    "tiltrotor": "VTOL_TILTROTOR",
    "tailsitter": "VTOL_QUADROTOR",
    "rover": "GROUND_ROVER",
    "boat": "SURFACE_BOAT",
    "sub": "SUBMARINE",
    "tracker": "ANTENNA_TRACKER",
}
MAV_TYPE: Mapping[VehicleTypeName, int] = {
    name: getattr(mavlink, f"MAV_TYPE_{OTHER_TYPE_NAMES.get(name, name.upper())}")
    for name in get_args(VehicleTypeName)
}
"""MAV_TYPE by name of the vehicle; each moves as the simulated multicopter does."""


def heartbeat(vehicle: SimVehicle) -> Fields:
    """Return the autopilot's HEARTBEAT."""
    vehicle_type = MAV_TYPE[vehicle.scenario.autopilot.vehicle_type]
    kind = (vehicle_type, vehicle.flavour.firmware.autopilot)
    return (*kind, *vehicle.flavour.heartbeat_state(vehicle.time_s), MAVLINK_VERSION)


def sys_status(vehicle: SimVehicle) -> Fields:
    """Return SYS_STATUS, whose prearm bit is healthy while arming would be accepted."""
    now_s, battery = vehicle.time_s, vehicle.battery
    present = INERTIAL_SENSORS | GPS | AHRS | BATTERY | PREARM
    health = INERTIAL_SENSORS
    health |= GPS if vehicle.estimator.has_fix else 0
    health |= AHRS if vehicle.estimator.is_position_valid else 0
    health |= BATTERY if battery.share > BATTERY_CRITICAL_SHARE else 0
    if vehicle.sticks.resting is not None or vehicle.sticks.is_joystick_alive(now_s):
        present |= RC
        health |= RC if vehicle.sticks.read(now_s) is not None else 0
    fence = vehicle.flavour.fence_state(vehicle.aircraft.motion.position_enu_m)
    present |= FENCE if fence.is_present else 0
    health |= 0 if fence.is_breached else FENCE  # without a fence too: clients report a breach
    if vehicle.is_armed or vehicle.flavour.arming_refusal(now_s) is None:
        health |= PREARM
    enabled = present if fence.is_enabled else present & ~FENCE
    power = (UINT16_MAX, -1, -1)
    if battery.is_known:
        power = (CELLS * battery.cell_mv, battery.current_ca, battery.percent)
    return (present, enabled, health, LOAD_PERMILLE, *power, *NO_ERRORS)


def system_time(vehicle: SimVehicle) -> Fields:
    """Return SYSTEM_TIME; Unix time stays 0 (unknown), so that a run depends on its seed only."""
    return (0, boot_ms(vehicle))


def timesync(vehicle: SimVehicle) -> Fields:
    """Return a TIMESYNC request."""
    return (0, max(1, round(NS_PER_S * vehicle.stamp_s)))


def ping(vehicle: SimVehicle) -> Fields:
    """Return a broadcast PING request, numbered by its second."""
    return (boot_us(vehicle), int(vehicle.time_s), 0, 0)


def extended_sys_state(vehicle: SimVehicle) -> Fields:
    """Return the landed state."""
    return (mavlink.MAV_VTOL_STATE_UNDEFINED, vehicle.flavour.landed_state.value)


def battery_status(vehicle: SimVehicle) -> Fields:
    """Return a four-cell pack that only flying empties."""
    battery = vehicle.battery
    kind = (mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO)
    if not battery.is_known:
        unknown = mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED
        return (0, *kind, INT16_MAX, [UINT16_MAX] * 10, -1, -1, -1, -1, 0, unknown)
    state = mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if battery.share <= BATTERY_CRITICAL_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    elif battery.share <= BATTERY_LOW_SHARE:
        state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW
    cells = [battery.cell_mv] * CELLS + [UINT16_MAX] * (10 - CELLS)
    charge = (battery.current_ca, battery.consumed_mah, -1, battery.percent, battery.remaining_s)
    return (0, *kind, INT16_MAX, cells, *charge, state)


def home_position(vehicle: SimVehicle) -> Fields | None:
    """Return HOME_POSITION, local position relative to the EKF origin; None without a home."""
    if not vehicle.flavour.has_home(vehicle.time_s):
        return None
    local = ned_from_enu(vehicle.estimator.local_from_world(vehicle.home_enu_m))
    orientation = list(vehicle.flavour.firmware.home_orientation)
    home_us = round(1e6 * vehicle.clock.read_s(vehicle.aircraft.home_set_s))
    return (*vehicle.home_e7, *local, orientation, 0.0, 0.0, 0.0, home_us)


def gps_global_origin(vehicle: SimVehicle) -> Fields | None:
    """Return the origin of LOCAL_POSITION_NED exactly as it was set; None without a home."""
    if not vehicle.flavour.has_home(vehicle.time_s):
        return None
    origin = vehicle.origin
    position = to_e7((origin.latitude_deg, origin.longitude_deg, origin.altitude_m))
    return (*position, boot_us(vehicle))


def autopilot_version(vehicle: SimVehicle) -> Fields:
    """Return AUTOPILOT_VERSION, without hashes."""
    firmware = vehicle.flavour.firmware
    versions = (firmware.version, firmware.version, 0, 0)
    uid = vehicle.scenario.autopilot.uid
    uid = vehicle.system_id if uid is None else uid
    return (firmware.capabilities, *versions, *[[0] * 8] * 3, 0, 0, uid)


def mission_progress(vehicle: SimVehicle) -> MissionProgress:
    """Return the progress of the mission."""
    mission = vehicle.aircraft.mission
    return MissionProgress(
        mission.current,
        len(mission.items),
        mission.state,
        is_in_mission_mode=vehicle.flavour.mode is FlightMode.MISSION,
        has_home=vehicle.flavour.firmware.first_mission_item == 1,
        plan_ids=vehicle.aircraft.plan_ids,
    )


def mission_current(vehicle: SimVehicle) -> Fields:
    """Return MISSION_CURRENT."""
    return mission_progress(vehicle).fields


def estimator_status(vehicle: SimVehicle) -> Fields:
    """Return PX4's ESTIMATOR_STATUS."""
    is_good, ratio = vehicle.estimator.is_position_valid, vehicle.estimator.test_ratio
    ratios = (ratio("velocity"), ratio("position"), ratio("height"), ratio("compass"))
    flags = GOOD_ESTIMATE if is_good else BLIND_ESTIMATE
    horizontal_m, vertical_m = vehicle.estimator.reported_accuracy_m
    accuracy = (horizontal_m if is_good else 50.0, vertical_m)
    return (boot_us(vehicle), flags, *ratios, 0.0, 0.0, *accuracy)


def ekf_status_report(vehicle: SimVehicle) -> Fields:
    """Return ArduPilot's EKF_STATUS_REPORT."""
    _, flags, velocity, position, height, compass, *_ = estimator_status(vehicle)
    return (flags, velocity, position, height, compass, 0.0)


def rc_channels(vehicle: SimVehicle) -> Fields | None:
    """Return roll, pitch, throttle and yaw; None without a transmitter or its receiver's pulses."""
    sticks = vehicle.sticks.pulses(vehicle.time_s)
    if sticks is None:
        return None
    deflections = (sticks.right, -sticks.forward, sticks.up, sticks.yaw)
    held = [round(NEUTRAL_US + 500 * value) for value in deflections]
    return (boot_ms(vehicle), 8, *held, *[NEUTRAL_US] * 4, *[UINT16_MAX] * 10, 255)


def fence_status(vehicle: SimVehicle) -> Fields:
    """Return the breach state of the fence; breaches are not counted."""
    is_breached = vehicle.flavour.fence_state(vehicle.aircraft.motion.position_enu_m).is_breached
    kind = mavlink.FENCE_BREACH_BOUNDARY if is_breached else mavlink.FENCE_BREACH_NONE
    return (int(is_breached), int(is_breached), kind, boot_ms(vehicle) if is_breached else 0)


Builder = Callable[[SimVehicle], Fields | None]

_NAMED: dict[str, Builder] = {**vars(motion), **globals()}
"""Each function is named as its message."""
_CLASSES = {
    kind: build
    for name, build in _NAMED.items()
    if (kind := getattr(mavlink, f"MAVLink_{name}_message", None)) is not None
} | {
    MAVLink_ekf_status_report_message: ekf_status_report,
    IdentifiedMissionCurrent: mission_current,
    mavlink.MAVLink_scaled_imu3_message: motion.scaled_imu2,
    mavlink.MAVLink_scaled_pressure2_message: motion.scaled_pressure,
}
BUILDERS = {int(message.id): (message, build) for message, build in _CLASSES.items()}
"""All supported messages; a firmware has those with a rate."""


def build_message(vehicle: SimVehicle, number: int) -> Message | None:
    """Return the message with id `number`; None if unknown, or without current data."""
    if number not in BUILDERS or number not in vehicle.flavour.firmware.streams.default_rates_hz:
        return None
    message, build = BUILDERS[number]
    fields = build(vehicle)
    return None if fields is None else message(*fields)
