"""Offboard setpoints of PX4: which are valid and what they ask for.

A setpoint is refused whole, and is then no proof of life, if a field that it does not mask is NaN
or infinite (PX4 drops single axes instead), if its frame is not one of ours, if it sets the FORCE
bit, or if it leaves neither position, velocity nor acceleration. One that gives only some axes is
a proof of life that asks to stay in place, as PX4 does with it.

Source: MAVLink common, messages 84 and 86; PX4 user guide, offboard; PX4 1.15 as observed.
"""

from __future__ import annotations

import math

from companion.domain import Point, PositionEnu
from companion.geometry.frames import enu_from_ned, wrap_pi
from companion.mav import type_mask
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.setpoints import (
    GlobalTarget,
    LocalTarget,
    Setpoint,
    has_finite_fields,
    is_on_earth,
    turned,
)

HORIZONTAL_POSITION_IGNORE = type_mask.X_IGNORE | type_mask.Y_IGNORE
HORIZONTAL_VELOCITY_IGNORE = type_mask.VX_IGNORE | type_mask.VY_IGNORE
MOTION_IGNORE = (
    type_mask.POSITION_IGNORE | type_mask.VELOCITY_IGNORE | type_mask.ACCELERATION_IGNORE
)
TERRAIN_FRAME = mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    TERRAIN_FRAME,
)


def setpoint_from_local(message: LocalTarget, aircraft: Aircraft) -> Setpoint | None:
    """The setpoint of SET_POSITION_TARGET_LOCAL_NED, or None if it is refused.

    BODY_NED (8) is for velocities and accelerations only, forward, right and down of the nose.
    """
    position_ned = (message.x, message.y, message.z)
    if not _is_valid(message, position_ned):
        return None
    has_position = message.type_mask & type_mask.POSITION_IGNORE != type_mask.POSITION_IGNORE
    match message.coordinate_frame:
        case mavlink.MAV_FRAME_LOCAL_NED:
            place = aircraft.estimator.world_from_local(enu_from_ned(position_ned))
            return _assemble(message, place if has_position else None, None)
        case mavlink.MAV_FRAME_BODY_NED if not has_position:
            return _assemble(message, None, aircraft.heading_ned_rad)
    return None


def setpoint_from_global(message: GlobalTarget, aircraft: Aircraft) -> Setpoint | None:
    """The setpoint of SET_POSITION_TARGET_GLOBAL_INT, or None if it is refused.

    Frame 5 has its altitude above sea level, frame 6 above home (PX4 1.15 is wrong there by twice
    the height between origin and home; this is not), frame 11 above the flat ground.
    """
    if message.coordinate_frame not in GLOBAL_FRAMES:
        return None
    if not _is_valid(message, (message.lat_int, message.lon_int, message.alt)):
        return None
    if message.type_mask & type_mask.POSITION_IGNORE:
        return _assemble(message, None, None)
    if not is_on_earth(message.lat_int, message.lon_int):
        return None
    frame, altitude_m = message.coordinate_frame, message.alt
    if frame == TERRAIN_FRAME:
        frame = mavlink.MAV_FRAME_GLOBAL
        altitude_m += aircraft.estimator.world_origin.altitude_m + aircraft.body.ground_up_m
    place = aircraft.place_from(message.lat_int, message.lon_int, altitude_m, frame)
    return _assemble(message, place, None)


def _is_valid(message: LocalTarget | GlobalTarget, position: tuple[float, float, float]) -> bool:
    mask = message.type_mask
    if mask & type_mask.FORCE_SET or mask & MOTION_IGNORE == MOTION_IGNORE:
        return False
    return has_finite_fields(message, position)


def _assemble(
    message: LocalTarget | GlobalTarget, enu_m: PositionEnu | None, body_yaw_rad: float | None
) -> Setpoint:
    """The setpoint of a valid message.

    Args:
        message: The message.
        enu_m: Its position in the world's frame, None if it gives none.
        body_yaw_rad: The heading that its vectors are about; None: they are north and east.
    """
    mask = message.type_mask
    has_en = enu_m is not None and not mask & HORIZONTAL_POSITION_IGNORE
    has_up = enu_m is not None and not mask & type_mask.Z_IGNORE
    has_velocity_en = not mask & HORIZONTAL_VELOCITY_IGNORE
    has_climb = not mask & type_mask.VZ_IGNORE
    yaw = None if mask & type_mask.YAW_IGNORE else float(message.yaw)
    if yaw is not None and body_yaw_rad is not None:
        yaw = wrap_pi(yaw + body_yaw_rad)
    yaw_rate = None if mask & type_mask.YAW_RATE_IGNORE else float(message.yaw_rate)
    has_motion = (has_en or has_velocity_en) and (has_up or has_climb)
    acceleration = None
    if not mask & type_mask.ACCELERATION_IGNORE:
        acceleration = (*_en(message.afx, message.afy, body_yaw_rad), -float(message.afz))
    if not has_motion:
        return Setpoint(
            acceleration_enu_mps2=acceleration, yaw_ned_rad=yaw, yaw_rate_ned_radps=yaw_rate
        )
    return Setpoint(
        position_en_m=enu_m[:2] if enu_m is not None and has_en else None,
        up_m=enu_m[2] if enu_m is not None and has_up else None,
        velocity_en_mps=_en(message.vx, message.vy, body_yaw_rad) if has_velocity_en else None,
        climb_mps=-message.vz if has_climb else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )


def _en(x: float, y: float, body_yaw_rad: float | None) -> Point:
    """East and north of a vector that is north and east, or forward and right."""
    if body_yaw_rad is None or not (math.isfinite(x) and math.isfinite(y)):
        return (float(y), float(x))
    return turned(x, y, body_yaw_rad)
