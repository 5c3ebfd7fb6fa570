"""Offboard setpoints of PX4: which are valid and what they ask for.

A field that is NaN or infinite counts as masked. A setpoint is refused, and is then no proof of
life, if its frame is not one of ours, if it sets the FORCE bit, or if it leaves neither position,
velocity nor acceleration. One that gives only some axes is a proof of life that asks to stay in
place.

SET_ATTITUDE_TARGET on a point mass: thrust along an attitude is an acceleration. Body rates are not
flown, because a point mass has no attitude of its own to turn: a message that masks the attitude is
refused, and is no proof of life.

Source: MAVLink common, messages 82, 84 and 86; PX4 user guide, offboard; PX4 1.15 as observed.
"""

from __future__ import annotations

import math

from companion.domain import PositionEnu
from companion.geometry.coordinates import enu_from_ned, wrap_pi
from companion.mav import dialect
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.control_inputs import (
    AttitudeTarget,
    GlobalTarget,
    LocalTarget,
    PositionTarget,
    Setpoint,
    TargetMessage,
    bits_of_no_numbers,
    enu_of,
    is_on_earth,
)
from sim_link.world.point_mass import GRAVITY_MPS2

HORIZONTAL_POSITION_IGNORE = dialect.X_IGNORE | dialect.Y_IGNORE
HORIZONTAL_VELOCITY_IGNORE = dialect.VX_IGNORE | dialect.VY_IGNORE
MOTION_IGNORE = dialect.POSITION_IGNORE | dialect.VELOCITY_IGNORE | dialect.ACCELERATION_IGNORE
RELATIVE_FRAME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
TERRAIN_FRAME = mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL_INT,
    RELATIVE_FRAME,
    TERRAIN_FRAME,
)


def setpoint_from_local(message: LocalTarget, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of SET_POSITION_TARGET_LOCAL_NED, or None if it is refused.

    BODY_NED (8) is for velocities and accelerations only, forward, right and down of the nose.
    """
    position_ned = (message.x, message.y, message.z)
    mask = effective_mask(message, position_ned)
    if mask is None:
        return None
    has_position = mask & dialect.POSITION_IGNORE != dialect.POSITION_IGNORE
    match message.coordinate_frame:
        case mavlink.MAV_FRAME_LOCAL_NED:
            place = aircraft.estimator.world_from_local(enu_from_ned(position_ned))
            return _assemble(message, mask, place if has_position else None)
        case mavlink.MAV_FRAME_BODY_NED if not has_position:
            return _assemble(message, mask, None, aircraft.heading_ned_rad)
    return None


def setpoint_from_global(message: GlobalTarget, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of SET_POSITION_TARGET_GLOBAL_INT, or None if it is refused.

    Frame 5 has its altitude above sea level, frame 11 above the flat ground. Frame 6 should have it
    above home; PX4 1.15 adds the height of the origin above home instead of taking it off.
    """
    if message.coordinate_frame not in GLOBAL_FRAMES:
        return None
    mask = effective_mask(message, (message.lat_int, message.lon_int, message.alt))
    if mask is None:
        return None
    if mask & dialect.POSITION_IGNORE:
        return _assemble(message, mask, None)
    if not is_on_earth(message.lat_int, message.lon_int):
        return None
    frame, altitude_m = message.coordinate_frame, message.alt
    if frame == TERRAIN_FRAME:
        altitude_m += aircraft.estimator.world_origin.altitude_m + aircraft.motion.ground_up_m
    elif frame == RELATIVE_FRAME:
        altitude_m += 2.0 * aircraft.estimator.origin.altitude_m - aircraft.home_altitude_m
    place = aircraft.place_from(
        message.lat_int, message.lon_int, altitude_m, mavlink.MAV_FRAME_GLOBAL
    )
    return _assemble(message, mask, place)


def effective_mask(message: PositionTarget, position: tuple[float, float, float]) -> int | None:
    """Return the type mask with the bits of what is no number, too.

    None if the setpoint is refused.
    """
    mask = int(message.type_mask) | bits_of_no_numbers(message, position)
    is_empty = mask & MOTION_IGNORE == MOTION_IGNORE
    return None if mask & dialect.FORCE_SET or is_empty else mask


def _assemble(
    message: PositionTarget,
    mask: int,
    enu_m: PositionEnu | None,
    body_yaw_rad: float | None = None,
) -> Setpoint:
    """Return the setpoint at a position (None: not given), its vectors by heading (None: north)."""
    has_en = enu_m is not None and not mask & HORIZONTAL_POSITION_IGNORE
    has_up = enu_m is not None and not mask & dialect.Z_IGNORE
    has_velocity_en = not mask & HORIZONTAL_VELOCITY_IGNORE
    has_climb = not mask & dialect.VZ_IGNORE
    yaw = None if mask & dialect.YAW_IGNORE else float(message.yaw)
    if yaw is not None and body_yaw_rad is not None:
        yaw = wrap_pi(yaw + body_yaw_rad)
    yaw_rate = None if mask & dialect.YAW_RATE_IGNORE else float(message.yaw_rate)
    acceleration = None
    if not mask & dialect.ACCELERATION_IGNORE:
        acceleration = enu_of(message.afx, message.afy, message.afz, body_yaw_rad)
    if not ((has_en or has_velocity_en) and (has_up or has_climb)):
        return Setpoint(
            acceleration_enu_mps2=acceleration, yaw_ned_rad=yaw, yaw_rate_ned_radps=yaw_rate
        )
    east, north, climb_mps = enu_of(message.vx, message.vy, message.vz, body_yaw_rad)
    return Setpoint(
        position_en_m=enu_m[:2] if enu_m is not None and has_en else None,
        up_m=enu_m[2] if enu_m is not None and has_up else None,
        velocity_en_mps=(east, north) if has_velocity_en else None,
        climb_mps=climb_mps if has_climb else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )


CANNOT_BE_LEFT_OUT = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
)
HOVER_THRUST = 0.5
SHORTEST_QUATERNION = 0.1


def setpoint_from_attitude(message: AttitudeTarget) -> Setpoint | None:
    """Return the setpoint of SET_ATTITUDE_TARGET, or None if it is refused."""
    values = (*message.q, message.thrust)
    if message.type_mask & CANNOT_BE_LEFT_OUT or not all(map(math.isfinite, values)):
        return None
    length = math.hypot(*message.q)
    if length < SHORTEST_QUATERNION or not 0.0 <= message.thrust <= 1.0:
        return None
    w, x, y, z = (part / length for part in message.q)
    thrust_mps2 = message.thrust / HOVER_THRUST * GRAVITY_MPS2
    north = -2.0 * (x * z + w * y) * thrust_mps2
    east = -2.0 * (y * z - w * x) * thrust_mps2
    up = (1.0 - 2.0 * (x * x + y * y)) * thrust_mps2 - GRAVITY_MPS2
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return Setpoint(acceleration_enu_mps2=(east, north, up), yaw_ned_rad=yaw)


def setpoint_from(message: TargetMessage, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of a message, or None if it is refused."""
    if isinstance(message, LocalTarget):
        return setpoint_from_local(message, aircraft)
    if isinstance(message, GlobalTarget):
        return setpoint_from_global(message, aircraft)
    return setpoint_from_attitude(message)
