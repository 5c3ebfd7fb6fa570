"""What an operator's autopilot calls a mode: OFFBOARD is GUIDED on ArduPilot, HOLD is BRAKE."""

from __future__ import annotations

from companion.domain import Autopilot, FlightMode

ARDUPILOT_NAMES: dict[FlightMode, str] = {
    FlightMode.OFFBOARD: "GUIDED",
    FlightMode.HOLD: "BRAKE",
    FlightMode.LAND: "LAND",
    FlightMode.RETURN: "RTL",
    FlightMode.MISSION: "AUTO",
    FlightMode.POSITION: "LOITER",
    FlightMode.ALTITUDE: "ALT_HOLD",
    FlightMode.STABILIZED: "STABILIZE",
    FlightMode.ACRO: "ACRO",
    FlightMode.UNKNOWN: "another mode",
}


def mode_name(mode: FlightMode, autopilot: Autopilot) -> str:
    """The mode in the words of the autopilot's own tools."""
    if autopilot is Autopilot.ARDUPILOT:
        return ARDUPILOT_NAMES.get(mode, mode.value)
    return mode.value
