"""Position, motion and sensor readings of the vehicle, as the fields of MAVLink messages.

Each function is named as its message and gives its fields in the order of the XML, or None where
there is nothing to report. Degrees, millimetres, NED and boot milliseconds begin here. Sensors and
actuators are those of a point mass with four motors. Source: MAVLink common.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from companion.geometry.coordinates import ned_from_enu
from companion.mav.dialect import mavlink
from sim_link.autopilot.control_inputs import Axes, Echo
from sim_link.autopilot.estimator import FixName
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.point_mass import GRAVITY_MPS2

Fields = tuple[object, ...]
INT16_MAX = 0x7FFF
FARTHEST_M = 1e7
"""Longest distance of a target whose latitude can be computed."""
UINT16_MAX, UINT32_MAX = 0xFFFF, 0xFFFF_FFFF
STILL = (0.0, 0.0, 0.0)
FIX_TYPES: dict[FixName, int] = {
    "3d": mavlink.GPS_FIX_TYPE_3D_FIX,
    "dgps": mavlink.GPS_FIX_TYPE_DGPS,
    "rtk_float": mavlink.GPS_FIX_TYPE_RTK_FLOAT,
    "rtk_fixed": mavlink.GPS_FIX_TYPE_RTK_FIXED,
}
UNKNOWN_COVARIANCE = [math.nan] + [0.0] * 20


def boot_ms(vehicle: SimVehicle) -> int:
    """Return milliseconds since boot by its own clock, which wraps after 49.7 days."""
    return round(1e3 * vehicle.stamp_s) & UINT32_MAX


def boot_us(vehicle: SimVehicle) -> int:
    """Return microseconds since boot by its own clock."""
    return round(1e6 * vehicle.stamp_s)


def to_int16(value: float) -> int:
    """Return the rounded value, limited to the field's range."""
    return round(min(INT16_MAX, max(-INT16_MAX, value)))


def to_int32(value: float) -> int:
    """Return the rounded value, limited to the field's range."""
    return round(min(2**31 - 1, max(-(2**31 - 1), value)))


def to_e7(position: tuple[float, float, float]) -> tuple[int, int, int]:
    """Return 1e-7 degrees and millimetres from degrees and metres."""
    return (to_int32(position[0] * 1e7), to_int32(position[1] * 1e7), to_int32(position[2] * 1e3))


def _centidegrees(angle_rad: float) -> int:
    return round(math.degrees(angle_rad) * 1e2) % 36000


def local_position_ned(vehicle: SimVehicle) -> Fields | None:
    """Return the position relative to the EKF origin; None without an estimate."""
    if not vehicle.flavour.has_position(vehicle.time_s):
        return None
    position = ned_from_enu(vehicle.estimator.local_enu_m)
    return (boot_ms(vehicle), *position, *ned_from_enu(vehicle.body.velocity_enu_mps))


def _roll_and_pitch(vehicle: SimVehicle) -> tuple[float, float]:
    """Return the true roll and pitch, which inertial sensors estimate well."""
    return vehicle.body.attitude[:2]


def attitude(vehicle: SimVehicle) -> Fields:
    """Return roll and pitch of the acceleration and of the wind, no rates."""
    return (boot_ms(vehicle), *_roll_and_pitch(vehicle), vehicle.aircraft.heading_ned_rad, *STILL)


def _quaternion(vehicle: SimVehicle) -> tuple[float, float, float, float]:
    (roll, pitch), yaw = _roll_and_pitch(vehicle), vehicle.aircraft.heading_ned_rad
    cr, sr = math.cos(roll / 2.0), math.sin(roll / 2.0)
    cp, sp = math.cos(pitch / 2.0), math.sin(pitch / 2.0)
    cy, sy = math.cos(yaw / 2.0), math.sin(yaw / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def attitude_quaternion(vehicle: SimVehicle) -> Fields:
    """Return the same, w first."""
    return (boot_ms(vehicle), *_quaternion(vehicle), *STILL)


def odometry(vehicle: SimVehicle) -> Fields | None:
    """Return the position in LOCAL_NED, velocity in BODY_FRD; None without an estimate."""
    if not vehicle.flavour.has_position(vehicle.time_s):
        return None
    v_east, v_north, v_up = vehicle.body.velocity_enu_mps
    heading_rad = vehicle.aircraft.heading_ned_rad
    cos_yaw, sin_yaw = math.cos(heading_rad), math.sin(heading_rad)
    return (
        *(boot_us(vehicle), mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD),
        *ned_from_enu(vehicle.estimator.local_enu_m),
        list(_quaternion(vehicle)),
        *(v_north * cos_yaw + v_east * sin_yaw, v_east * cos_yaw - v_north * sin_yaw, -v_up),
        *STILL,
        *(UNKNOWN_COVARIANCE, UNKNOWN_COVARIANCE),
    )


def global_position_int(vehicle: SimVehicle) -> Fields | None:
    """Return GLOBAL_POSITION_INT; None without an estimate."""
    if not vehicle.flavour.has_position(vehicle.time_s):
        return None
    lat, lon, alt = to_e7(vehicle.geodetic)
    above_home = to_int32(alt - 1e3 * vehicle.aircraft.home_altitude_m)
    velocity = [to_int16(1e2 * axis) for axis in ned_from_enu(vehicle.body.velocity_enu_mps)]
    heading = _centidegrees(vehicle.aircraft.heading_ned_rad)
    return (boot_ms(vehicle), lat, lon, alt, above_home, *velocity, heading)


def gps_raw_int(vehicle: SimVehicle) -> Fields:
    """Return a good fix (horizontal and vertical dilution 0.9 and 1.2, 14 satellites), or none.

    Accuracies are one sigma, in millimetres; 0 is unknown.
    """
    if not vehicle.estimator.receiver_has_fix(0):
        return (boot_us(vehicle), mavlink.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, *[UINT16_MAX] * 4, 0)
    v_east, v_north, _ = vehicle.body.velocity_enu_mps
    speed, course = to_int16(1e2 * math.hypot(v_east, v_north)), math.atan2(v_east, v_north)
    position = to_e7(vehicle.geodetic)
    fix, motion = FIX_TYPES[vehicle.estimator.fix], (speed, _centidegrees(course))
    accuracy_m = vehicle.estimator.reported_accuracy_m
    h_acc_mm, v_acc_mm = (round(1e3 * sigma_m) for sigma_m in accuracy_m)
    return (boot_us(vehicle), fix, *position, 90, 120, *motion, 14, 0, h_acc_mm, v_acc_mm)


def gps2_raw(vehicle: SimVehicle) -> Fields | None:
    """Return the second receiver, with the same satellites; None where it is not fitted."""
    has_fix = vehicle.estimator.receiver_has_fix(1)
    if has_fix is None:
        return None
    dgps = (0, 0)  # satellites of the differential correction, and its age
    if not has_fix:
        return (boot_us(vehicle), mavlink.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, *[UINT16_MAX] * 4, 0, *dgps)
    position, fix = to_e7(vehicle.geodetic), FIX_TYPES[vehicle.estimator.fix]
    return (boot_us(vehicle), fix, *position, 90, 120, UINT16_MAX, UINT16_MAX, 14, *dgps)


def altitude(vehicle: SimVehicle) -> Fields:
    """Return altitudes above sea level, the origin, home and the flat ground."""
    up_m = vehicle.estimator.reported_enu_m[2]
    amsl_m = vehicle.estimator.world_origin.altitude_m + up_m
    local_m, above_home_m = vehicle.estimator.local_enu_m[2], up_m - vehicle.home_enu_m[2]
    terrain_m = -1000.0
    above_ground_m = vehicle.body.height_m
    return (boot_us(vehicle), amsl_m, amsl_m, local_m, above_home_m, terrain_m, above_ground_m)


def vfr_hud(vehicle: SimVehicle) -> Fields:
    """Return speeds, heading, throttle, altitude and climb."""
    v_east, v_north, v_up = vehicle.body.velocity_enu_mps
    speed = math.hypot(v_east, v_north)
    throttle = 0 if not vehicle.is_armed else (10 if vehicle.body.is_on_ground else 50)
    heading_deg = round(math.degrees(vehicle.aircraft.heading_ned_rad)) % 360
    amsl_m = vehicle.estimator.world_origin.altitude_m + vehicle.estimator.reported_enu_m[2]
    return (speed, speed, heading_deg, throttle, amsl_m, v_up)


def nav_controller_output(vehicle: SimVehicle) -> Fields:
    """Return the distance and direction to where it goes."""
    controller, position = vehicle.aircraft.controller, vehicle.aircraft.motion.position_enu_m
    goal = controller.goal_enu_m or controller.hold_enu_m
    bearing = round(math.degrees(math.atan2(goal[0] - position[0], goal[1] - position[1])))
    distance_m = min(UINT16_MAX, round(math.dist(goal[:2], position[:2])))
    tilt = [math.degrees(angle) for angle in _roll_and_pitch(vehicle)]
    return (*tilt, bearing, bearing, distance_m, goal[2] - position[2], 0.0, 0.0)


def position_target_local_ned(vehicle: SimVehicle) -> Fields | None:
    """Return the target that is flown; None where none is."""
    echo = vehicle.flavour.echo()
    if echo is None:
        return None
    shown = vehicle.estimator.shown_from_world(_filled(echo.position_enu_m, 0.0))
    east, north, up = (
        echo.unused if axis is None else value
        for value, axis in zip(shown, echo.position_enu_m, strict=True)
    )
    head = (boot_ms(vehicle), mavlink.MAV_FRAME_LOCAL_NED, echo.type_mask)
    return (*head, *ned_from_enu((east, north, up)), *_motion(echo))


def position_target_global_int(vehicle: SimVehicle) -> Fields | None:
    """Return the same above sea level; None without a target position."""
    echo = vehicle.flavour.echo()
    position = None if echo is None else echo.whole_position
    if echo is None or position is None or any(abs(value) > FARTHEST_M for value in position):
        return None
    lat, lon, alt = vehicle.estimator.world_origin.geodetic_from_enu(position)
    head = (boot_ms(vehicle), mavlink.MAV_FRAME_GLOBAL_INT, echo.type_mask)
    return (*head, to_int32(lat * 1e7), to_int32(lon * 1e7), alt, *_motion(echo))


def _motion(echo: Echo) -> tuple[float, ...]:
    unused = echo.unused
    return (
        *ned_from_enu(_filled(echo.velocity_enu_mps, unused)),
        *ned_from_enu(_filled(echo.acceleration_enu_mps2, unused)),
        unused if echo.yaw_ned_rad is None else echo.yaw_ned_rad,
        unused if echo.yaw_rate_ned_radps is None else echo.yaw_rate_ned_radps,
    )


def _filled(axes: Axes, unused: float) -> PositionEnu:
    east, north, up = (unused if axis is None else axis for axis in axes)
    return (east, north, up)


IDLE_THRUST, HOVER_THRUST = 0.1, 0.5
MOTOR_OFF_US, MOTOR_IDLE_US, MOTOR_RANGE_US = 900, 1000, 1000
FIELD_NORTH_GAUSS, FIELD_DOWN_GAUSS = 0.21, 0.43
SEA_LEVEL_HPA, SCALE_HEIGHT_M, PRESSURE_EXPONENT = 1013.25, 44_330.0, 5.255
"""International standard atmosphere."""
TEMPERATURE_C = 20.0
ALL_IMU_FIELDS = 0x1FFF
RANGE_MIN_CM, RANGE_MAX_CM = 10, 10_000
UNKNOWN_RANGE_COVARIANCE = 255
RAIL_MV = 5000


def _thrust_share(vehicle: SimVehicle) -> float:
    if not vehicle.is_armed:
        return 0.0
    return IDLE_THRUST if vehicle.body.is_on_ground else HOVER_THRUST


def attitude_target(vehicle: SimVehicle) -> Fields:
    """Return the current attitude, which a point mass attains at once."""
    return (boot_ms(vehicle), 0, list(_quaternion(vehicle)), *STILL, _thrust_share(vehicle))


def servo_output_raw(vehicle: SimVehicle) -> Fields:
    """Return the outputs of four motors at equal speed."""
    pulse_us = MOTOR_OFF_US
    if vehicle.is_armed:
        pulse_us = round(MOTOR_IDLE_US + _thrust_share(vehicle) * MOTOR_RANGE_US)
    return (boot_us(vehicle) & UINT32_MAX, 0, *[pulse_us] * 4, *[0] * 4)


def _specific_force_mps2(vehicle: SimVehicle) -> float:
    east, north, up = vehicle.body.acceleration_enu_mps2
    return math.sqrt(east * east + north * north + (up + GRAVITY_MPS2) ** 2)


def _field_gauss(vehicle: SimVehicle) -> tuple[float, float, float]:
    heading, north = vehicle.aircraft.heading_ned_rad, FIELD_NORTH_GAUSS
    return (north * math.cos(heading), -north * math.sin(heading), FIELD_DOWN_GAUSS)


def _amsl_m(vehicle: SimVehicle) -> float:
    return vehicle.estimator.world_origin.altitude_m + vehicle.body.position_enu_m[2]


def _pressure_hpa(vehicle: SimVehicle) -> float:
    return float(SEA_LEVEL_HPA * (1.0 - _amsl_m(vehicle) / SCALE_HEIGHT_M) ** PRESSURE_EXPONENT)


def highres_imu(vehicle: SimVehicle) -> Fields:
    """Return the thrust as specific force, no rates, a field to the north and down."""
    force = (0.0, 0.0, -_specific_force_mps2(vehicle))
    air = (_pressure_hpa(vehicle), 0.0, _amsl_m(vehicle), TEMPERATURE_C)
    return (boot_us(vehicle), *force, *STILL, *_field_gauss(vehicle), *air, ALL_IMU_FIELDS)


def raw_imu(vehicle: SimVehicle) -> Fields:
    """Return readings in ArduPilot's units: thousandths of g, and of gauss."""
    force_mg = to_int16(-1e3 * _specific_force_mps2(vehicle) / GRAVITY_MPS2)
    field = [to_int16(1e3 * axis) for axis in _field_gauss(vehicle)]
    temperature = round(1e2 * TEMPERATURE_C)
    return (boot_us(vehicle), 0, 0, force_mg, 0, 0, 0, *field, 0, temperature)


def scaled_imu2(vehicle: SimVehicle) -> Fields:
    """Return the first sensor's readings for any further one."""
    _, *axes, _, temperature = raw_imu(vehicle)
    return (boot_ms(vehicle), *axes, temperature)


def scaled_pressure(vehicle: SimVehicle) -> Fields:
    """Return the pressure of the standard atmosphere."""
    return (boot_ms(vehicle), _pressure_hpa(vehicle), 0.0, round(1e2 * TEMPERATURE_C))


def terrain_report(vehicle: SimVehicle) -> Fields:
    """Return a report without terrain data."""
    lat, lon, _ = to_e7(vehicle.geodetic)
    return (lat, lon, 0, 0.0, 0.0, 0, 0)


def power_status(_vehicle: SimVehicle) -> Fields:
    """Return POWER_STATUS of a supply without faults."""
    return (RAIL_MV, RAIL_MV, mavlink.MAV_POWER_STATUS_BRICK_VALID)


def vibration(vehicle: SimVehicle) -> Fields:
    """Return zeros: a point mass does not vibrate."""
    return (boot_us(vehicle), *STILL, 0, 0, 0)


def distance_sensor(vehicle: SimVehicle) -> Fields:
    """Return the range of a downward laser; out of range: its maximum and one centimetre."""
    range_cm = min(round(1e2 * vehicle.body.height_m), RANGE_MAX_CM + 1)
    reach = (RANGE_MIN_CM, RANGE_MAX_CM, max(RANGE_MIN_CM, range_cm))
    kind = (mavlink.MAV_DISTANCE_SENSOR_LASER, 0, mavlink.MAV_SENSOR_ROTATION_PITCH_270)
    return (boot_ms(vehicle), *reach, *kind, UNKNOWN_RANGE_COVARIANCE)
