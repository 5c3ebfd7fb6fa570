"""What a streamed setpoint asks for, and what the two autopilots share in reading one.

Source: MAVLink common, POSITION_TARGET_TYPEMASK and messages 84 and 86.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import Point, PositionEnu
from companion.mav import type_mask
from companion.mav.dialect import mavlink

LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message
AttitudeTarget = mavlink.MAVLink_set_attitude_target_message

MAX_LATITUDE_E7 = 900_000_000
MAX_LONGITUDE_E7 = 1_800_000_000


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where to fly and how fast; None where nothing is asked. All of it None: stay in place."""

    position_en_m: Point | None = None
    """In the world's frame."""
    up_m: float | None = None
    velocity_en_mps: Point | None = None
    climb_mps: float | None = None
    acceleration_enu_mps2: PositionEnu | None = None
    yaw_ned_rad: float | None = None
    yaw_rate_ned_radps: float | None = None
    """Clockwise positive."""


class SetpointMonitor:
    """Keeps the newest valid setpoint and when it came."""

    def __init__(self) -> None:
        self.arrived_s: float | None = None
        """When the newest valid one came; None before any."""
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
        self.arrived_s = now_s

    def is_alive(self, now_s: float, timeout_s: float) -> bool:
        """Whether the newest valid setpoint is younger than `timeout_s`."""
        return self.arrived_s is not None and now_s - self.arrived_s < timeout_s


def has_finite_fields(
    message: LocalTarget | GlobalTarget, position: tuple[float, float, float]
) -> bool:
    """Whether every field that is not masked is a finite number."""
    mask = message.type_mask
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


def is_on_earth(latitude_e7: int, longitude_e7: int) -> bool:
    """Whether latitude and longitude in 1e-7 degrees are a place."""
    return abs(latitude_e7) <= MAX_LATITUDE_E7 and abs(longitude_e7) <= MAX_LONGITUDE_E7


def turned(forward: float, right: float, yaw_ned_rad: float) -> Point:
    """East and north of a vector that is given forward and right of a heading."""
    cos_yaw, sin_yaw = math.cos(yaw_ned_rad), math.sin(yaw_ned_rad)
    return (forward * sin_yaw + right * cos_yaw, forward * cos_yaw - right * sin_yaw)
