"""MAVLink commands as values, whichever message carried them.

Parameters may be NaN where a command does not use them. Source: MAVLink developer guide, "Command
Protocol".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.mav.dialect import mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
FAILED = mavlink.MAV_RESULT_FAILED
COMMAND_INT_ONLY = 8
UNSUPPORTED_MAV_FRAME = 9
"""MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME, which the dialect does not have yet."""

FORCE_ARMING = 21196
"""Magic number of MAV_CMD_COMPONENT_ARM_DISARM's second parameter."""
LOCATED_COMMANDS = frozenset(
    {
        mavlink.MAV_CMD_DO_REPOSITION,
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_NAV_TAKEOFF,
        mavlink.MAV_CMD_NAV_LAND,
    }
)
"""Commands whose parameters 5 to 7 are a place."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command, whichever message carried it."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT; None for COMMAND_LONG, whose altitudes are above sea level."""
    place_e7: tuple[int, int] | None = None
    """Latitude and longitude of a COMMAND_INT, 1e-7 degrees."""
    sender: tuple[int, int] = (0, 0)
    """System and component id."""

    @property
    def is_int(self) -> bool:
        """Whether it came as COMMAND_INT."""
        return self.frame is not None

    @property
    def latitude_longitude_e7(self) -> tuple[int, int] | None:
        """The place, 1e-7 degrees; None if it names none or nonsense."""
        if self.place_e7 is not None:
            return None if self.place_e7 in ((0, 0), (2**31 - 1, 2**31 - 1)) else self.place_e7
        latitude, longitude = self.params[4:6]
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return None
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            return None
        return (round(latitude * 1e7), round(longitude * 1e7))


def command_from_long(message: mavlink.MAVLink_command_long_message) -> Command:
    """The command of a COMMAND_LONG."""
    return Command(
        message.command,
        (
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            message.param5,
            message.param6,
            message.param7,
        ),
        sender=(message.get_srcSystem(), message.get_srcComponent()),
    )


def command_from_int(message: mavlink.MAVLink_command_int_message) -> Command:
    """The command of a COMMAND_INT; its x and y are `place_e7`, and plain numbers in `params`."""
    return Command(
        message.command,
        (
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            float(message.x),
            float(message.y),
            message.z,
        ),
        message.frame,
        (message.x, message.y),
        sender=(message.get_srcSystem(), message.get_srcComponent()),
    )


def whole(value: float) -> int | None:
    """The integer that a float parameter holds, or None (NaN, infinite, 0.4)."""
    return int(value) if math.isfinite(value) and value == int(value) else None


def is_force(value: float) -> bool | None:
    """Whether ARM_DISARM's second parameter forces; None if it is nonsense."""
    if math.isnan(value) or value == 0.0:
        return False
    return True if value == FORCE_ARMING else None
