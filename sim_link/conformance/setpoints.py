"""Setpoints as a client sends them, right and wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.mav.dialect import Message, mavlink

POSITION = 0x0DF8
POSITION_YAW = 0x09F8
VELOCITY = 0x0DC7
VELOCITY_YAW_RATE = 0x05C7
POSITION_VELOCITY = 0x0DC0
ACCELERATION = 0x0C3F
NOTHING = 0x0FFF & ~0x0200
FORCE = 0x0200
LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
LOCAL_OFFSET = mavlink.MAV_FRAME_LOCAL_OFFSET_NED
BODY_NED = mavlink.MAV_FRAME_BODY_NED
BODY_OFFSET = mavlink.MAV_FRAME_BODY_OFFSET_NED
METRES_PER_E7 = 0.011132
"""Of latitude."""

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class LocalSetpoint:
    """SET_POSITION_TARGET_LOCAL_NED; north, east, down."""

    position_m: Triple = ZERO
    velocity_mps: Triple = ZERO
    acceleration_mps2: Triple = ZERO
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    mask: int = POSITION
    frame: int = LOCAL_NED

    def message(self, target: tuple[int, int]) -> Message:
        """The message for an autopilot."""
        return mavlink.MAVLink_set_position_target_local_ned_message(
            0,
            *target,
            self.frame,
            self.mask,
            *self.position_m,
            *self.velocity_mps,
            *self.acceleration_mps2,
            self.yaw_rad,
            self.yaw_rate_radps,
        )


@dataclass(frozen=True, slots=True)
class GlobalSetpoint:
    """SET_POSITION_TARGET_GLOBAL_INT."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float
    frame: int = mavlink.MAV_FRAME_GLOBAL_INT
    mask: int = POSITION

    def message(self, target: tuple[int, int]) -> Message:
        """The message for an autopilot."""
        return mavlink.MAVLink_set_position_target_global_int_message(
            0,
            *target,
            self.frame,
            self.mask,
            self.latitude_e7,
            self.longitude_e7,
            self.altitude_m,
            *[0.0] * 8,
        )


def moved_e7(latitude_e7: int, longitude_e7: int, north_m: float, east_m: float) -> tuple[int, int]:
    """A place some metres away; flat earth."""
    east_scale = METRES_PER_E7 * math.cos(math.radians(latitude_e7 / 1e7))
    return (
        latitude_e7 + round(north_m / METRES_PER_E7),
        longitude_e7 + round(east_m / east_scale),
    )


def distance_m(start_e7: tuple[int, int], end_e7: tuple[int, int]) -> float:
    """How far two places are from each other; flat earth."""
    north_m = (end_e7[0] - start_e7[0]) * METRES_PER_E7
    east_m = (end_e7[1] - start_e7[1]) * METRES_PER_E7
    return math.hypot(north_m, east_m * math.cos(math.radians(start_e7[0] / 1e7)))
