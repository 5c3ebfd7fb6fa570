"""ArduCopter's flight modes: numbers, names, and what each needs and does.

Source: ArduPilot `ArduCopter/mode.h`; ArduCopter 4.5 as observed in SITL.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.pilot import Task

GUIDED_FLAGS = 0x59
"""Custom mode, stabilised, guided, manual input."""
PLAIN_FLAGS = 0x51
ARMED_FLAG = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


@dataclass(frozen=True, slots=True)
class CopterMode:
    """One mode."""

    number: int
    """HEARTBEAT.custom_mode."""
    name: str
    mode: FlightMode
    """What it does, in the words that both autopilots share."""
    task: Task
    needs_position: bool
    is_armable: bool
    flags: int
    """HEARTBEAT.base_mode while disarmed."""


def _mode(
    number: int,
    name: str,
    mode: FlightMode,
    task: Task,
    *,
    needs_position: bool = True,
    is_armable: bool = True,
    flags: int = GUIDED_FLAGS,
) -> CopterMode:
    return CopterMode(number, name, mode, task, needs_position, is_armable, flags)


_STICKS = Task.OBEY_STICKS
STABILIZE = _mode(
    0, "STABILIZE", FlightMode.STABILIZED, _STICKS, needs_position=False, flags=PLAIN_FLAGS
)
AUTO = _mode(3, "AUTO", FlightMode.MISSION, Task.FLY_MISSION, is_armable=False)
GUIDED = _mode(4, "GUIDED", FlightMode.OFFBOARD, Task.FOLLOW)
LOITER = _mode(5, "LOITER", FlightMode.POSITION, _STICKS)
RTL = _mode(6, "RTL", FlightMode.RETURN, Task.RETURN, is_armable=False)
LAND = _mode(
    9,
    "LAND",
    FlightMode.LAND,
    Task.LAND,
    needs_position=False,
    is_armable=False,
    flags=PLAIN_FLAGS,
)
ALT_HOLD = _mode(
    2, "ALT_HOLD", FlightMode.ALTITUDE, _STICKS, needs_position=False, flags=PLAIN_FLAGS
)
SMART_RTL = _mode(21, "SMART_RTL", FlightMode.RETURN, Task.RETURN, is_armable=False)
BRAKE = _mode(17, "BRAKE", FlightMode.HOLD, Task.STAY, is_armable=False)

MODES: dict[int, CopterMode] = {
    mode.number: mode
    for mode in (
        STABILIZE,
        _mode(1, "ACRO", FlightMode.ACRO, _STICKS, needs_position=False, flags=PLAIN_FLAGS),
        ALT_HOLD,
        AUTO,
        GUIDED,
        LOITER,
        RTL,
        _mode(7, "CIRCLE", FlightMode.HOLD, Task.CIRCLE, is_armable=False),
        LAND,
        _mode(16, "POSHOLD", FlightMode.POSITION, _STICKS),
        BRAKE,
        SMART_RTL,
    )
}
"""Every mode that is flown here."""
NOT_FLOWN = {18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS"}
"""Modes of the real one that are refused here, with a text."""
BY_WHAT_IT_DOES: dict[FlightMode, CopterMode] = {
    mode.mode: mode for mode in reversed(MODES.values()) if mode.number not in (7, 16, 21)
}
"""The plain mode for each purpose: not CIRCLE, POSHOLD or SMART_RTL."""
