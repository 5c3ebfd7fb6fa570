"""Classes of vehicle on the wire: HEARTBEAT.type, and the modes that each firmware numbers.

However it is called, the vehicle moves as the simulated multicopter does: what a class changes is
what a client sees and may ask for. PX4 numbers modes alike for all classes. ArduPilot's firmwares
each have a table of their own; a number that one of them does not have is refused, and one that
another has a meaning for is taken in that meaning.

Source: MAVLink minimal, MAV_TYPE; ArduPilot `mode.h` of Copter, Plane, Rover, Sub and Tracker.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

from companion.mav.dialect import mavlink

VehicleTypeName = Literal[
    "quadrotor",
    "hexarotor",
    "octorotor",
    "tricopter",
    "dodecarotor",
    "decarotor",
    "coaxial",
    "helicopter",
    "plane",
    "quadplane",
    "tiltrotor",
    "tailsitter",
    "rover",
    "boat",
    "sub",
    "tracker",
    "generic",
]
OTHER_NAMES = {
    "plane": "FIXED_WING",
    "quadplane": "VTOL_RESERVED2",  # VTOL_FIXEDROTOR in later dialects
    "tiltrotor": "VTOL_TILTROTOR",
    "tailsitter": "VTOL_QUADROTOR",
    "rover": "GROUND_ROVER",
    "boat": "SURFACE_BOAT",
    "sub": "SUBMARINE",
    "tracker": "ANTENNA_TRACKER",
}
MAV_TYPE: Mapping[VehicleTypeName, int] = {
    name: getattr(mavlink, f"MAV_TYPE_{OTHER_NAMES.get(name, name.upper())}")
    for name in get_args(VehicleTypeName)
}


class WireMode(NamedTuple):
    """Mode with its number in a firmware."""

    number: int
    name: str
    copter_number: int | None
    """The Copter mode that does the same; None: it cannot be entered here."""


def _table(text: str) -> dict[int, WireMode]:
    """Return a table from `number:NAME=copter number` words."""
    modes = {}
    for word in text.split():
        number, _, rest = word.partition(":")
        name, _, copter = rest.partition("=")
        modes[int(number)] = WireMode(int(number), name, int(copter) if copter else None)
    return modes


PLANE = _table(
    "0:MANUAL=0 1:CIRCLE=7 2:STABILIZE=0 3:TRAINING=0 4:ACRO=1 5:FBWA=0 6:FBWB=2 7:CRUISE=2 "
    "8:AUTOTUNE 10:AUTO=3 11:RTL=6 12:LOITER=17 13:TAKEOFF 14:AVOID_ADSB=19 15:GUIDED=4 "
    "16:INITIALISING 24:THERMAL"
)
QUADPLANE = PLANE | _table(
    "17:QSTABILIZE=0 18:QHOVER=2 19:QLOITER=5 20:QLAND=9 21:QRTL=6 22:QAUTOTUNE 23:QACRO=1"
)
ROVER = _table(
    "0:MANUAL=0 1:ACRO=1 3:STEERING=0 4:HOLD=17 5:LOITER=17 6:FOLLOW 7:SIMPLE=0 9:CIRCLE=7 "
    "10:AUTO=3 11:RTL=6 12:SMART_RTL=21 15:GUIDED=4 16:INITIALISING"
)
SUB = _table(
    "0:STABILIZE=0 1:ACRO=1 2:ALT_HOLD=2 3:AUTO=3 4:GUIDED=4 7:CIRCLE=7 9:SURFACE=9 16:POSHOLD=16 "
    "19:MANUAL=0 20:MOTOR_DETECT 21:SURFTRAK=2"
)
TRACKER = _table("0:MANUAL=0 1:STOP=17 2:SCAN 3:SERVOTEST 4:GUIDED 10:AUTO 16:INITIALISING")
ARDUPILOT_TABLES: Mapping[VehicleTypeName, Mapping[int, WireMode]] = {
    "plane": PLANE,
    "quadplane": QUADPLANE,
    "tiltrotor": QUADPLANE,
    "tailsitter": QUADPLANE,
    "rover": ROVER,
    "boat": ROVER,
    "sub": SUB,
    "tracker": TRACKER,
}
"""Mode tables of all types but those that Copter flies."""
IGNORES_LOCAL_SETPOINTS = frozenset({"plane", "quadplane", "tiltrotor", "tailsitter", "tracker"})
"""ArduPlane's GUIDED flies to positions of commands only, a tracker to none."""


def shown_number(vehicle_type: VehicleTypeName, copter_number: int, chosen: int | None) -> int:
    """Return ArduPilot's HEARTBEAT.custom_mode, as chosen while that mode lasts."""
    table = ARDUPILOT_TABLES.get(vehicle_type)
    if table is None:
        return copter_number
    if chosen is not None and table[chosen].copter_number == copter_number:
        return chosen
    same = [mode.number for mode in table.values() if mode.copter_number == copter_number]
    return same[0] if same else 0
