"""Offboard setpoints: which are valid, what they ask for, and whether they still arrive.

A setpoint is refused whole, and is then no proof of life, if a field that it does not mask is NaN
or infinite, if its frame is not one of ours, if it sets the FORCE bit, or if it leaves neither a
position nor a velocity. One that gives only some axes is a proof of life that asks to stay in
place, as PX4 does with it.

Source: MAVLink common, POSITION_TARGET_TYPEMASK and messages 84 and 86; PX4 user guide, offboard.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import Point, PositionEnu
from companion.geometry.frames import LocalOrigin, enu_from_ned
from companion.mav import type_mask
from companion.mav.dialect import mavlink

LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message

HORIZONTAL_POSITION_IGNORE = type_mask.X_IGNORE | type_mask.Y_IGNORE
HORIZONTAL_VELOCITY_IGNORE = type_mask.VX_IGNORE | type_mask.VY_IGNORE
MOTION_IGNORE = type_mask.POSITION_IGNORE | type_mask.VELOCITY_IGNORE
MAX_LATITUDE_E7 = 900_000_000
MAX_LONGITUDE_E7 = 1_800_000_000


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where to fly and how fast; None where nothing is asked. All of it None: stay in place."""

    position_en_m: Point | None = None
    up_m: float | None = None
    velocity_en_mps: Point | None = None
    climb_mps: float | None = None
    yaw_ned_rad: float | None = None
    yaw_rate_ned_radps: float | None = None
    """Clockwise positive."""


class OffboardMonitor:
    """Keeps the newest valid setpoint and tells whether the stream is alive.

    Args:
        timeout_s: Age of the newest valid setpoint from which the stream counts as lost.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._arrived_s: float | None = None
        self.setpoint = Setpoint()
        self.received = 0
        """Setpoint messages addressed to us, the refused ones included."""
        self.refused = 0

    def take(self, setpoint: Setpoint | None, now_s: float) -> None:
        """Count a message and keep its setpoint; None means that it was refused."""
        self.received += 1
        if setpoint is None:
            self.refused += 1
            return
        self.setpoint = setpoint
        self._arrived_s = now_s

    def is_alive(self, now_s: float) -> bool:
        """Whether the newest valid setpoint is young enough."""
        return self._arrived_s is not None and now_s - self._arrived_s < self._timeout_s


def setpoint_from_local(message: LocalTarget) -> Setpoint | None:
    """The setpoint of SET_POSITION_TARGET_LOCAL_NED, or None if it is refused."""
    position_ned = (message.x, message.y, message.z)
    if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None
    if not _is_valid(message, position_ned):
        return None
    return _assemble(message, enu_from_ned(position_ned))


def setpoint_from_global(
    message: GlobalTarget, origin: LocalOrigin, home_altitude_m: float
) -> Setpoint | None:
    """The setpoint of SET_POSITION_TARGET_GLOBAL_INT, or None if it is refused.

    Args:
        message: Frame 5 has its altitude above sea level, frame 6 above home.
        origin: Zero of the local frame.
        home_altitude_m: Home above mean sea level.
    """
    match message.coordinate_frame:
        case mavlink.MAV_FRAME_GLOBAL_INT:
            altitude_m = message.alt
        case mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT:
            altitude_m = message.alt + home_altitude_m
        case _:
            return None
    if not _is_valid(message, (message.lat_int, message.lon_int, altitude_m)):
        return None
    if message.type_mask & type_mask.POSITION_IGNORE:
        return _assemble(message, None)
    if abs(message.lat_int) > MAX_LATITUDE_E7 or abs(message.lon_int) > MAX_LONGITUDE_E7:
        return None
    return _assemble(
        message,
        origin.enu_from_geodetic(message.lat_int / 1e7, message.lon_int / 1e7, altitude_m),
    )


def _is_valid(message: LocalTarget | GlobalTarget, position: tuple[float, float, float]) -> bool:
    mask = message.type_mask
    if mask & type_mask.FORCE_SET or mask & MOTION_IGNORE == MOTION_IGNORE:
        return False
    fields = (
        (type_mask.X_IGNORE, position[0]),
        (type_mask.Y_IGNORE, position[1]),
        (type_mask.Z_IGNORE, position[2]),
        (type_mask.VX_IGNORE, message.vx),
        (type_mask.VY_IGNORE, message.vy),
        (type_mask.VZ_IGNORE, message.vz),
        (type_mask.AX_IGNORE, message.afx),
        (type_mask.AY_IGNORE, message.afy),
        (type_mask.AZ_IGNORE, message.afz),
        (type_mask.YAW_IGNORE, message.yaw),
        (type_mask.YAW_RATE_IGNORE, message.yaw_rate),
    )
    return all(mask & bit or math.isfinite(value) for bit, value in fields)


def _assemble(message: LocalTarget | GlobalTarget, enu_m: PositionEnu | None) -> Setpoint:
    """The setpoint of a valid message; `enu_m` is its position, None if it gives none."""
    mask = message.type_mask
    has_en = enu_m is not None and not mask & HORIZONTAL_POSITION_IGNORE
    has_up = enu_m is not None and not mask & type_mask.Z_IGNORE
    has_velocity_en = not mask & HORIZONTAL_VELOCITY_IGNORE
    has_climb = not mask & type_mask.VZ_IGNORE
    yaw = None if mask & type_mask.YAW_IGNORE else float(message.yaw)
    yaw_rate = None if mask & type_mask.YAW_RATE_IGNORE else float(message.yaw_rate)
    if not (has_en or has_velocity_en) or not (has_up or has_climb):
        return Setpoint(yaw_ned_rad=yaw, yaw_rate_ned_radps=yaw_rate)
    return Setpoint(
        position_en_m=enu_m[:2] if enu_m is not None and has_en else None,
        up_m=enu_m[2] if enu_m is not None and has_up else None,
        velocity_en_mps=(message.vy, message.vx) if has_velocity_en else None,
        climb_mps=-message.vz if has_climb else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )
