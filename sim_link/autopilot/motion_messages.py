"""Where the vehicle is and how it moves, as MAVLink messages.

Degrees, millimetres, NED and boot milliseconds begin here. Source: MAVLink common.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from companion.geometry.frames import ned_from_enu
from companion.mav import type_mask
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.setpoints import Setpoint
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.world.point_mass import GRAVITY_MPS2

INT16_MAX = 0x7FFF
FARTHEST_M = 1e7
"""A target beyond this has no latitude."""
UINT16_MAX = 0xFFFF
NAN = math.nan
UNKNOWN_COVARIANCE = [NAN] + [0.0] * 20


def boot_ms(vehicle: SimVehicle) -> int:
    """Milliseconds since boot, which start again at zero after 49.7 days."""
    return round(1e3 * vehicle.time_s) & 0xFFFF_FFFF


def boot_us(vehicle: SimVehicle) -> int:
    """Microseconds since boot."""
    return round(1e6 * vehicle.time_s)


def to_int16(value: float) -> int:
    """Rounded, and limited to what the field holds."""
    return round(min(INT16_MAX, max(-INT16_MAX, value)))


def to_int32(value: float) -> int:
    """Rounded, and limited to what the field holds."""
    return round(min(2**31 - 1, max(-(2**31 - 1), value)))


def to_e7(place: tuple[float, float, float]) -> tuple[int, int, int]:
    """1e-7 degrees and millimetres of degrees and metres."""
    return (to_int32(place[0] * 1e7), to_int32(place[1] * 1e7), to_int32(place[2] * 1e3))


def local_position_ned(vehicle: SimVehicle) -> Message | None:
    """LOCAL_POSITION_NED about the EKF origin; None without an estimate."""
    if not vehicle.has_position:
        return None
    north, east, down = ned_from_enu(vehicle.estimator.local_enu_m)
    v_north, v_east, v_down = ned_from_enu(vehicle.body.velocity_enu_mps)
    return mavlink.MAVLink_local_position_ned_message(
        boot_ms(vehicle), north, east, down, v_north, v_east, v_down
    )


def _roll_and_pitch(vehicle: SimVehicle) -> tuple[float, float]:
    """The tilt that the present acceleration needs."""
    body = vehicle.body
    east, north, _ = body.acceleration_enu_mps2
    cos_yaw, sin_yaw = math.cos(body.yaw_ned_rad), math.sin(body.yaw_ned_rad)
    forward = north * cos_yaw + east * sin_yaw
    right = east * cos_yaw - north * sin_yaw
    return (math.atan2(right, GRAVITY_MPS2), -math.atan2(forward, GRAVITY_MPS2))


def attitude(vehicle: SimVehicle) -> Message:
    """ATTITUDE."""
    roll, pitch = _roll_and_pitch(vehicle)
    return mavlink.MAVLink_attitude_message(
        boot_ms(vehicle), roll, pitch, vehicle.heading_ned_rad, 0.0, 0.0, 0.0
    )


def _quaternion(vehicle: SimVehicle) -> tuple[float, float, float, float]:
    roll, pitch = _roll_and_pitch(vehicle)
    cr, sr = math.cos(roll / 2.0), math.sin(roll / 2.0)
    cp, sp = math.cos(pitch / 2.0), math.sin(pitch / 2.0)
    cy, sy = math.cos(vehicle.heading_ned_rad / 2.0), math.sin(vehicle.heading_ned_rad / 2.0)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def attitude_quaternion(vehicle: SimVehicle) -> Message:
    """ATTITUDE_QUATERNION; w first."""
    return mavlink.MAVLink_attitude_quaternion_message(
        boot_ms(vehicle), *_quaternion(vehicle), 0.0, 0.0, 0.0
    )


def odometry(vehicle: SimVehicle) -> Message | None:
    """ODOMETRY: position in LOCAL_NED, velocity in BODY_FRD; None without an estimate."""
    if not vehicle.has_position:
        return None
    north, east, down = ned_from_enu(vehicle.estimator.local_enu_m)
    v_east, v_north, v_up = vehicle.body.velocity_enu_mps
    cos_yaw, sin_yaw = math.cos(vehicle.heading_ned_rad), math.sin(vehicle.heading_ned_rad)
    return mavlink.MAVLink_odometry_message(
        boot_us(vehicle),
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        north,
        east,
        down,
        list(_quaternion(vehicle)),
        v_north * cos_yaw + v_east * sin_yaw,
        v_east * cos_yaw - v_north * sin_yaw,
        -v_up,
        0.0,
        0.0,
        0.0,
        UNKNOWN_COVARIANCE,
        UNKNOWN_COVARIANCE,
    )


def global_position_int(vehicle: SimVehicle) -> Message | None:
    """GLOBAL_POSITION_INT; None without an estimate."""
    if not vehicle.has_position:
        return None
    lat, lon, alt = to_e7(vehicle.geodetic)
    v_north, v_east, v_down = ned_from_enu(vehicle.body.velocity_enu_mps)
    return mavlink.MAVLink_global_position_int_message(
        boot_ms(vehicle),
        lat,
        lon,
        alt,
        to_int32(alt - 1e3 * vehicle.home_altitude_m),
        to_int16(1e2 * v_north),
        to_int16(1e2 * v_east),
        to_int16(1e2 * v_down),
        round(math.degrees(vehicle.heading_ned_rad) * 1e2) % 36000,
    )


def gps_raw_int(vehicle: SimVehicle) -> Message:
    """GPS_RAW_INT with a good 3-D fix, or none."""
    if not vehicle.estimator.has_fix:
        return mavlink.MAVLink_gps_raw_int_message(
            boot_us(vehicle),
            *(mavlink.GPS_FIX_TYPE_NO_FIX, 0, 0, 0),
            *(UINT16_MAX, UINT16_MAX, UINT16_MAX, UINT16_MAX, 0),
        )
    lat, lon, alt = to_e7(vehicle.geodetic)
    v_east, v_north, _ = vehicle.body.velocity_enu_mps
    return mavlink.MAVLink_gps_raw_int_message(
        boot_us(vehicle),
        mavlink.GPS_FIX_TYPE_3D_FIX,
        lat,
        lon,
        alt,
        eph=90,
        epv=120,
        vel=to_int16(1e2 * math.hypot(v_east, v_north)),
        cog=round(math.degrees(math.atan2(v_east, v_north)) * 1e2) % 36000,
        satellites_visible=14,
    )


def altitude(vehicle: SimVehicle) -> Message:
    """ALTITUDE: above sea level, the origin, home and the flat ground."""
    up_m = vehicle.estimator.reported_enu_m[2]
    amsl_m = vehicle.estimator.world_origin.altitude_m + up_m
    return mavlink.MAVLink_altitude_message(
        boot_us(vehicle),
        amsl_m,
        amsl_m,
        vehicle.estimator.local_enu_m[2],
        up_m - vehicle.home_enu_m[2],
        -1000.0,
        vehicle.body.height_m,
    )


def vfr_hud(vehicle: SimVehicle) -> Message:
    """VFR_HUD."""
    v_east, v_north, v_up = vehicle.body.velocity_enu_mps
    speed = math.hypot(v_east, v_north)
    throttle = 0 if not vehicle.is_armed else (10 if vehicle.body.is_on_ground else 50)
    return mavlink.MAVLink_vfr_hud_message(
        speed,
        speed,
        round(math.degrees(vehicle.heading_ned_rad)) % 360,
        throttle,
        vehicle.estimator.world_origin.altitude_m + vehicle.estimator.reported_enu_m[2],
        v_up,
    )


def nav_controller_output(vehicle: SimVehicle) -> Message:
    """NAV_CONTROLLER_OUTPUT: distance and direction to where it goes."""
    goal, place = vehicle.goal_enu_m, vehicle.body.position_enu_m
    bearing = round(math.degrees(math.atan2(goal[0] - place[0], goal[1] - place[1])))
    roll, pitch = _roll_and_pitch(vehicle)
    distance_m = min(UINT16_MAX, round(math.dist(goal[:2], place[:2])))
    return mavlink.MAVLink_nav_controller_output_message(
        math.degrees(roll),
        math.degrees(pitch),
        bearing,
        bearing,
        distance_m,
        goal[2] - place[2],
        0.0,
        0.0,
    )


def _mask(setpoint: Setpoint) -> int:
    mask = 0 if setpoint.acceleration_enu_mps2 else type_mask.ACCELERATION_IGNORE
    mask |= 0 if setpoint.position_en_m else type_mask.X_IGNORE | type_mask.Y_IGNORE
    mask |= 0 if setpoint.up_m is not None else type_mask.Z_IGNORE
    mask |= 0 if setpoint.velocity_en_mps else type_mask.VX_IGNORE | type_mask.VY_IGNORE
    mask |= 0 if setpoint.climb_mps is not None else type_mask.VZ_IGNORE
    mask |= 0 if setpoint.yaw_ned_rad is not None else type_mask.YAW_IGNORE
    mask |= 0 if setpoint.yaw_rate_ned_radps is not None else type_mask.YAW_RATE_IGNORE
    return mask


def _motion(setpoint: Setpoint) -> tuple[float, ...]:
    """Velocity and acceleration, NED, yaw and yaw rate; 0 where nothing is asked."""
    v_east, v_north = setpoint.velocity_en_mps or (0.0, 0.0)
    a_east, a_north, a_up = setpoint.acceleration_enu_mps2 or (0.0, 0.0, 0.0)
    return (
        *(v_north, v_east, -(setpoint.climb_mps or 0.0)),
        *(a_north, a_east, -a_up),
        setpoint.yaw_ned_rad or 0.0,
        setpoint.yaw_rate_ned_radps or 0.0,
    )


def position_target_local_ned(vehicle: SimVehicle) -> Message | None:
    """POSITION_TARGET_LOCAL_NED: the setpoint that is flown; None where none is."""
    setpoint = vehicle.flavour.target()
    if setpoint is None:
        return None
    east, north, up = vehicle.estimator.shown_from_world(_place(setpoint))
    x, y = (north, east) if setpoint.position_en_m else (0.0, 0.0)
    return mavlink.MAVLink_position_target_local_ned_message(
        boot_ms(vehicle),
        mavlink.MAV_FRAME_LOCAL_NED,
        _mask(setpoint),
        x,
        y,
        0.0 if setpoint.up_m is None else -up,
        *_motion(setpoint),
    )


def position_target_global_int(vehicle: SimVehicle) -> Message | None:
    """POSITION_TARGET_GLOBAL_INT in frame GLOBAL_INT; None where none is flown."""
    setpoint = vehicle.flavour.target()
    if setpoint is None:
        return None
    place = _place(setpoint)
    if any(abs(value) > FARTHEST_M for value in place):
        return None
    lat, lon, alt = vehicle.estimator.world_origin.geodetic_from_enu(place)
    return mavlink.MAVLink_position_target_global_int_message(
        boot_ms(vehicle),
        mavlink.MAV_FRAME_GLOBAL_INT,
        _mask(setpoint),
        to_int32(lat * 1e7),
        to_int32(lon * 1e7),
        alt,
        *_motion(setpoint),
    )


def _place(setpoint: Setpoint) -> PositionEnu:
    east, north = setpoint.position_en_m or (0.0, 0.0)
    return (east, north, setpoint.up_m or 0.0)
