"""Sensors and actuators as MAVLink messages: what a point mass with four motors would show.

Source: MAVLink common.
"""

from __future__ import annotations

import math

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.motion_messages import boot_ms, boot_us, quaternion
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.point_mass import GRAVITY_MPS2

IDLE_THRUST, HOVER_THRUST = 0.1, 0.5
MOTOR_OFF_US, MOTOR_IDLE_US, MOTOR_RANGE_US = 900, 1000, 1000
FIELD_NORTH_GAUSS, FIELD_DOWN_GAUSS = 0.21, 0.43
SEA_LEVEL_HPA, SCALE_HEIGHT_M, PRESSURE_EXPONENT = 1013.25, 44_330.0, 5.255
"""International standard atmosphere."""
TEMPERATURE_C = 20.0
ALL_IMU_FIELDS = 0x1FFF
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


def highres_imu(vehicle: SimVehicle) -> Message:
    """HIGHRES_IMU: the thrust as specific force, no rates, a field to the north and down."""
    east, north, up = vehicle.body.acceleration_enu_mps2
    thrust_mps2 = math.sqrt(east * east + north * north + (up + GRAVITY_MPS2) ** 2)
    heading = vehicle.heading_ned_rad
    amsl_m = vehicle.estimator.world_origin.altitude_m + vehicle.body.position_enu_m[2]
    return mavlink.MAVLink_highres_imu_message(
        boot_us(vehicle),
        *(0.0, 0.0, -thrust_mps2),
        *(0.0, 0.0, 0.0),
        FIELD_NORTH_GAUSS * math.cos(heading),
        -FIELD_NORTH_GAUSS * math.sin(heading),
        FIELD_DOWN_GAUSS,
        SEA_LEVEL_HPA * (1.0 - amsl_m / SCALE_HEIGHT_M) ** PRESSURE_EXPONENT,
        0.0,
        amsl_m,
        TEMPERATURE_C,
        ALL_IMU_FIELDS,
    )
