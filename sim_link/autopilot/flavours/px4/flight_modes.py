"""PX4's flight modes as data: what each one flies, and what HEARTBEAT shows of it.

Source: PX4 1.15 as observed in SITL; MAVLink common, MAV_MODE_FLAG.
"""

from __future__ import annotations

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import PX4_MAIN_AND_SUB
from sim_link.autopilot.pilot import Task
from sim_link.autopilot.protocols.addressing import flags_of

MAIN_MODES = frozenset(main for main, _ in PX4_MAIN_AND_SUB.values())
WITHOUT_POSITION_CONTROL = frozenset({FlightMode.STABILIZED, FlightMode.ACRO, FlightMode.MANUAL})
STICK_MODES = WITHOUT_POSITION_CONTROL | {FlightMode.POSITION, FlightMode.ALTITUDE}
TASKS: dict[FlightMode, Task] = {
    FlightMode.HOLD: Task.STAY,
    FlightMode.TAKEOFF: Task.TAKE_OFF,
    FlightMode.LAND: Task.LAND,
    FlightMode.RETURN: Task.RETURN,
    FlightMode.MISSION: Task.FLY_MISSION,
    FlightMode.OFFBOARD: Task.FOLLOW,
}
"""Tasks of all modes but those for sticks."""
ENDED_BY_DISARMING = frozenset(TASKS) - {FlightMode.OFFBOARD}
AUTO_FLAGS = flags_of("MAV_MODE_FLAG", "STABILIZE_ENABLED GUIDED_ENABLED AUTO_ENABLED")
MANUAL_FLAGS = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
STICK_FLAGS = MANUAL_FLAGS | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
BASE_MODE_FLAGS: dict[FlightMode, int] = {
    **dict.fromkeys((FlightMode.POSITION, FlightMode.ALTITUDE, FlightMode.STABILIZED), STICK_FLAGS),
    **dict.fromkeys((FlightMode.MANUAL, FlightMode.ACRO), MANUAL_FLAGS),
}
"""Flags of a mode beside CUSTOM_MODE_ENABLED; modes not listed are automatic (OFFBOARD apart)."""
