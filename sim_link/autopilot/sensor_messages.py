"""Sensors and actuators as MAVLink messages: what a point mass with four motors would show.

Source: MAVLink common.
"""

from __future__ import annotations

import math

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.motion_messages import boot_ms, boot_us, quaternion, to_int16
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.point_mass import GRAVITY_MPS2

IDLE_THRUST, HOVER_THRUST = 0.1, 0.5
MOTOR_OFF_US, MOTOR_IDLE_US, MOTOR_RANGE_US = 900, 1000, 1000
FIELD_NORTH_GAUSS, FIELD_DOWN_GAUSS = 0.21, 0.43
SEA_LEVEL_HPA, SCALE_HEIGHT_M, PRESSURE_EXPONENT = 1013.25, 44_330.0, 5.255
"""International standard atmosphere."""
TEMPERATURE_C = 20.0
ALL_IMU_FIELDS = 0x1FFF
RANGE_MIN_CM, RANGE_MAX_CM = 10, 10_000
UNKNOWN_COVARIANCE = 255
RAIL_MV = 5000
UINT32 = 0xFFFF_FFFF


def attitude_target(vehicle: SimVehicle) -> Message:
    """ATTITUDE_TARGET: a point mass has the attitude that it wants."""
    return mavlink.MAVLink_attitude_target_message(
        boot_ms(vehicle), 0, list(quaternion(vehicle)), 0.0, 0.0, 0.0, thrust_share(vehicle)
    )


def thrust_share(vehicle: SimVehicle) -> float:
    """How much thrust it gives, 0 to 1."""
    if not vehicle.is_armed:
        return 0.0
    return IDLE_THRUST if vehicle.body.is_on_ground else HOVER_THRUST


def servo_output_raw(vehicle: SimVehicle) -> Message:
    """SERVO_OUTPUT_RAW: four motors that turn alike."""
    pulse_us = MOTOR_OFF_US
    if vehicle.is_armed:
        pulse_us = round(MOTOR_IDLE_US + thrust_share(vehicle) * MOTOR_RANGE_US)
    return mavlink.MAVLink_servo_output_raw_message(
        boot_us(vehicle) & UINT32, 0, *[pulse_us] * 4, *[0] * 4
    )


def _specific_force_mps2(vehicle: SimVehicle) -> float:
    """What an accelerometer feels along the thrust."""
    east, north, up = vehicle.body.acceleration_enu_mps2
    return math.sqrt(east * east + north * north + (up + GRAVITY_MPS2) ** 2)


def _field_gauss(vehicle: SimVehicle) -> tuple[float, float, float]:
    """The magnetic field forward, right and down."""
    heading = vehicle.heading_ned_rad
    north = FIELD_NORTH_GAUSS
    return (north * math.cos(heading), -north * math.sin(heading), FIELD_DOWN_GAUSS)


def _amsl_m(vehicle: SimVehicle) -> float:
    return vehicle.estimator.world_origin.altitude_m + vehicle.body.position_enu_m[2]


def _pressure_hpa(vehicle: SimVehicle) -> float:
    return float(SEA_LEVEL_HPA * (1.0 - _amsl_m(vehicle) / SCALE_HEIGHT_M) ** PRESSURE_EXPONENT)


def highres_imu(vehicle: SimVehicle) -> Message:
    """HIGHRES_IMU: the thrust as specific force, no rates, a field to the north and down."""
    return mavlink.MAVLink_highres_imu_message(
        boot_us(vehicle),
        *(0.0, 0.0, -_specific_force_mps2(vehicle)),
        *(0.0, 0.0, 0.0),
        *_field_gauss(vehicle),
        _pressure_hpa(vehicle),
        0.0,
        _amsl_m(vehicle),
        TEMPERATURE_C,
        ALL_IMU_FIELDS,
    )


def raw_imu(vehicle: SimVehicle) -> Message:
    """RAW_IMU in ArduPilot's units: thousandths of g, and of gauss."""
    force_mg = to_int16(-1e3 * _specific_force_mps2(vehicle) / GRAVITY_MPS2)
    forward, right, down = (to_int16(1e3 * axis) for axis in _field_gauss(vehicle))
    return mavlink.MAVLink_raw_imu_message(
        boot_us(vehicle),
        *(0, 0, force_mg),
        *(0, 0, 0),
        *(forward, right, down),
        temperature=round(1e2 * TEMPERATURE_C),
    )


def scaled_pressure(vehicle: SimVehicle) -> Message:
    """SCALED_PRESSURE of the standard atmosphere."""
    return mavlink.MAVLink_scaled_pressure_message(
        boot_ms(vehicle), _pressure_hpa(vehicle), 0.0, round(1e2 * TEMPERATURE_C)
    )


def power_status(vehicle: SimVehicle) -> Message:  # noqa: ARG001  always well supplied
    """POWER_STATUS: a good supply."""
    flags = mavlink.MAV_POWER_STATUS_BRICK_VALID
    return mavlink.MAVLink_power_status_message(RAIL_MV, RAIL_MV, flags)


def vibration(vehicle: SimVehicle) -> Message:
    """VIBRATION: a point mass has none."""
    return mavlink.MAVLink_vibration_message(boot_us(vehicle), 0.0, 0.0, 0.0, 0, 0, 0)


def distance_sensor(vehicle: SimVehicle) -> Message:
    """DISTANCE_SENSOR: a laser that looks down; beyond its reach one centimetre more than that."""
    range_cm = round(1e2 * vehicle.body.height_m)
    return mavlink.MAVLink_distance_sensor_message(
        boot_ms(vehicle),
        RANGE_MIN_CM,
        RANGE_MAX_CM,
        max(RANGE_MIN_CM, min(range_cm, RANGE_MAX_CM + 1)),
        mavlink.MAV_DISTANCE_SENSOR_LASER,
        0,
        mavlink.MAV_SENSOR_ROTATION_PITCH_270,
        UNKNOWN_COVARIANCE,
    )
