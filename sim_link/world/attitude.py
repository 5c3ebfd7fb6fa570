"""Attitude of a vehicle, and transformations of vectors between rotated frames.

Frames are forward, right, down (the body's, an antenna's) within north, east, down. A frame is
turned first by yaw about its third axis, then by pitch about its second, then by roll about its
first, as aircraft are: R = R_z(yaw) R_y(pitch) R_x(roll) takes a vector's components in the turned
frame to those in the outer one; `seen_from` is its transpose.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Components = tuple[float, float, float]
"""Along the three axes of a frame."""


class EulerAngles(NamedTuple):
    """Euler angles of a turned frame in an outer one, rad; a body's yaw is clockwise from north."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0


LEVEL = EulerAngles()


def seen_from(attitude: EulerAngles, outer: Components) -> Components:
    """Return the components of an outer vector in the turned frame: R transposed, times it."""
    x, y, z = outer
    cos, sin = math.cos(attitude.yaw_rad), math.sin(attitude.yaw_rad)
    x, y = cos * x + sin * y, cos * y - sin * x
    cos, sin = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
    x, z = cos * x - sin * z, sin * x + cos * z
    cos, sin = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
    return (x, cos * y + sin * z, cos * z - sin * y)


def leaning(forward_mps2: float, right_mps2: float, down_mps2: float) -> tuple[float, float]:
    """Return roll and pitch of a multicopter whose thrust gives a horizontal acceleration.

    `down_mps2` is what the thrust holds against, gravity in steady flight. The roll leaves out that
    the pitch has shortened the upright part of the thrust: 1 degree at 20 degrees of both.
    """
    return math.atan2(right_mps2, down_mps2), -math.atan2(forward_mps2, down_mps2)
