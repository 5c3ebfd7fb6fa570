"""What both autopilots share in reading a command."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from companion.domain import PositionEnu
from companion.mav.dialect import mavlink
from sim_link.autopilot.protocols.commands import DEGREE, Command, CommandResult

if TYPE_CHECKING:
    from sim_link.autopilot.aircraft import Aircraft

ACCEPTED = CommandResult.ACCEPTED
TEMPORARILY_REJECTED = CommandResult.TEMPORARILY_REJECTED
DENIED = CommandResult.DENIED
UNSUPPORTED = CommandResult.UNSUPPORTED
FAILED = CommandResult.FAILED
UNSUPPORTED_MAV_FRAME = CommandResult.UNSUPPORTED_MAV_FRAME

MAX_ALTITUDE_M = 83_000.0
"""ArduPilot's limit of a stored altitude, LOCATION_ALT_MAX_M."""
MAX_DISTANCE_M = 1e5
MAX_HEIGHT_M = 1000.0
"""Above home, of a take-off or a place to go to."""
CHANGE_MODE_FLAG = 1
"""MAV_DO_REPOSITION_FLAGS_CHANGE_MODE."""
FORCE_ARMING = 21196
"""Magic number of MAV_CMD_COMPONENT_ARM_DISARM's second parameter."""


def place_e7(command: Command) -> tuple[int, int] | None:
    """Latitude and longitude of a command, 1e-7 degrees; None if it leaves them open."""
    latitude_deg, longitude_deg = command.latitude_deg, command.longitude_deg
    if latitude_deg is None or longitude_deg is None:
        return None
    if not (math.isfinite(latitude_deg) and math.isfinite(longitude_deg)):
        return None
    return (round(latitude_deg * DEGREE), round(longitude_deg * DEGREE))


def is_place(place: tuple[int, int]) -> bool:
    """Whether latitude and longitude are somewhere; 0/0 means that nobody knows."""
    return place != (0, 0) and abs(place[0]) <= 90 * DEGREE and abs(place[1]) <= 180 * DEGREE


def is_altitude(altitude_m: float) -> bool:
    """Whether an altitude is a number that something may be at."""
    return abs(altitude_m) <= MAX_ALTITUDE_M


def is_near(place_enu_m: PositionEnu) -> bool:
    """Whether a flat local frame still means anything there."""
    return all(abs(value) <= MAX_DISTANCE_M for value in place_enu_m)


def whole(value: float) -> int | None:
    """The integer that a float parameter holds, or None (NaN, infinite, 0.4)."""
    return int(value) if math.isfinite(value) and value == int(value) else None


def is_force(value: float) -> bool | None:
    """Whether ARM_DISARM's second parameter forces; None if it is nonsense."""
    if math.isnan(value) or value == 0.0:
        return False
    return True if value == FORCE_ARMING else None


def may_change_mode(command: Command) -> bool:
    """Whether DO_REPOSITION may choose the mode that goes there."""
    return bool((whole(command.params[1]) or 0) & CHANGE_MODE_FLAG)


def set_home(
    aircraft: Aircraft, command: Command, refused: CommandResult, *, lasts: bool
) -> CommandResult:
    """MAV_CMD_DO_SET_HOME: here, or at a place of any frame that the aircraft knows.

    Args:
        aircraft: Whose home.
        command: The first parameter is 1 for the present place.
        refused: What this autopilot answers to a place that is none.
        lasts: Whether arming leaves a given home where it is.
    """
    if command.params[0] == 1.0:
        aircraft.set_home(aircraft.body.position_enu_m, is_given=False)
        return ACCEPTED
    frame = mavlink.MAV_FRAME_GLOBAL if command.frame is None else command.frame
    place, altitude_m = place_e7(command), command.params[6]
    if place is None or not is_place(place) or not is_altitude(altitude_m):
        return refused
    home = aircraft.place_from(*place, altitude_m, frame)
    if home is None:
        return UNSUPPORTED_MAV_FRAME
    if not is_near(home):
        return refused
    aircraft.set_home(home, is_given=lasts)
    return ACCEPTED
