"""ArduCopter's flight modes as data: numbers, names, and what each needs.

Source: ArduPilot `ArduCopter/mode.h`; ArduCopter 4.5 as observed in SITL.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import FlightMode
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import OFFBOARD_NUMBER
from sim_link.autopilot.pilot import Task

HORIZONTAL = mavlink.SPEED_TYPE_GROUNDSPEED
CLIMB, DESCENT = mavlink.SPEED_TYPE_CLIMB_SPEED, mavlink.SPEED_TYPE_DESCENT_SPEED


@dataclass(frozen=True, slots=True)
class CopterMode:
    """One mode."""

    number: int
    name: str
    mode: FlightMode
    """Flight mode common to both autopilots."""
    task: Task
    needs_position: bool = True
    is_armable: bool = True

    @property
    def flags(self) -> int:
        """HEARTBEAT.base_mode while disarmed: custom, stabilised, manual input, perhaps guided."""
        return 0x59 if self.needs_position else 0x51


_STICKS = Task.FLY_BY_STICKS
_TABLE = (
    CopterMode(0, "STABILIZE", FlightMode.STABILIZED, _STICKS, needs_position=False),
    CopterMode(1, "ACRO", FlightMode.ACRO, _STICKS, needs_position=False),
    CopterMode(2, "ALT_HOLD", FlightMode.ALTITUDE, _STICKS, needs_position=False),
    CopterMode(3, "AUTO", FlightMode.MISSION, Task.FLY_MISSION, is_armable=False),
    CopterMode(4, "GUIDED", FlightMode.OFFBOARD, Task.FOLLOW),
    CopterMode(5, "LOITER", FlightMode.POSITION, _STICKS),
    CopterMode(6, "RTL", FlightMode.RETURN, Task.RETURN, is_armable=False),
    CopterMode(7, "CIRCLE", FlightMode.HOLD, Task.CIRCLE, is_armable=False),
    CopterMode(9, "LAND", FlightMode.LAND, Task.LAND, needs_position=False, is_armable=False),
    CopterMode(11, "DRIFT", FlightMode.POSITION, _STICKS),
    CopterMode(16, "POSHOLD", FlightMode.POSITION, _STICKS),
    CopterMode(17, "BRAKE", FlightMode.HOLD, Task.STAY, is_armable=False),
    CopterMode(19, "AVOID_ADSB", FlightMode.HOLD, Task.STAY, is_armable=False),
    CopterMode(20, "GUIDED_NOGPS", FlightMode.HOLD, Task.STAY, needs_position=False),
    CopterMode(21, "SMART_RTL", FlightMode.RETURN, Task.RETURN, is_armable=False),
    CopterMode(24, "ZIGZAG", FlightMode.POSITION, _STICKS),
)
MODES: dict[int, CopterMode] = {mode.number: mode for mode in _TABLE}
STABILIZE, ALT_HOLD, AUTO, GUIDED, LOITER = (MODES[number] for number in (0, 2, 3, 4, 5))
RTL, LAND, BRAKE, SMART_RTL = (MODES[number] for number in (6, 9, 17, 21))
NEVER_ENTERED = {
    **{14: "FLIP", 15: "AUTOTUNE", 18: "THROW", 22: "FLOWHOLD"},
    **{23: "FOLLOW", 25: "SYSTEMID", 27: "AUTO_RTL"},
}
"""Modes that refuse to begin; the real one's THROW waits for a throw."""
BY_WHAT_IT_DOES: dict[FlightMode, CopterMode] = {
    mode.mode: mode for mode in _TABLE if mode.number in (0, 1, 2, 3, 4, 5, 6, 9, 17)
}
"""The plain mode for each purpose."""


def available_modes() -> list[Message]:
    """Return AVAILABLE_MODES of all modes, a script's OFFBOARD last, as ArduCopter 4.7."""
    names = [*((each.number, each.name) for each in _TABLE), (OFFBOARD_NUMBER, "OFFBOARD")]
    return [
        mavlink.MAVLink_available_modes_message(len(names), index, 0, number, 0, name.encode())
        for index, (number, name) in enumerate(names, 1)
    ]
