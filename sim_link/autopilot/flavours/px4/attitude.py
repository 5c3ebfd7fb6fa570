"""SET_ATTITUDE_TARGET of PX4 on a point mass: thrust along an attitude is an acceleration.

Body rates are not flown, because a point mass has no attitude of its own to turn: a message that
masks the attitude is refused, and is no proof of life. Source: MAVLink common, message 82.
"""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.autopilot.setpoints import AttitudeTarget, Setpoint
from sim_link.world.point_mass import GRAVITY_MPS2

CANNOT_BE_LEFT_OUT = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
)
HOVER_THRUST = 0.5
"""PX4 MPC_THR_HOVER."""
SHORTEST_QUATERNION = 0.1


def setpoint_from_attitude(message: AttitudeTarget) -> Setpoint | None:
    """The setpoint of SET_ATTITUDE_TARGET, or None if it is refused."""
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
