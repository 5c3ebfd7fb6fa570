"""Identity, parameters, message rates and modes of ArduCopter 4.5.

`firmware.yaml` has its rules (fields of `Firmware`), `streams.csv` what it sends.

`parameters.csv` has its parameters. Names, types and defaults were compared one by one with what an
ArduCopter 4.5.5 shows, and with SITL's `copter.parm` (battery monitor, flight modes, fence radius,
throttle failsafe); ranges follow the Copter Parameter List, and bind scenarios only: a client may
set what is out of range. The battery failsafes are BATT_FS_*, as since Copter 3.6.

Other firmwares each have a table of modes of their own; a number that one of them does not have is
refused, and one that has a meaning there is interpreted by it. PX4 has one numbering for all types
of vehicle.

Source of the modes: ArduPilot `mode.h` of Copter, Plane, Rover, Sub and Tracker; ArduCopter 4.5 as
observed in SITL.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from companion.domain import FlightMode
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import OFFBOARD_NUMBER
from sim_link.autopilot.flavour import read_firmware
from sim_link.autopilot.flight_controller import STEP_S, Task
from sim_link.autopilot.incidents import VehicleTypeName
from sim_link.autopilot.protocols.message_streams import StreamProfile, message_id, message_ids
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore, read_rows, read_specs
from sim_link.autopilot.scenario import Scenario

PACKAGE = "sim_link.autopilot.ardupilot"
ARDUPILOT_PARAMETERS = read_specs(PACKAGE)


def ardupilot_parameters(scenario: Scenario) -> ParameterStore:
    """Return ArduCopter's parameters as a scenario has them.

    The voltages of the battery failsafe are those of the simulated four-cell pack at 15 and 7 %;
    the reaction is ArduPilot's default: a text.
    """
    initial: dict[str, float] = {
        "SYSID_THISMAV": scenario.system_id,
        "BATT_LOW_VOLT": 14.42,
        "BATT_CRT_VOLT": 14.2,
    }
    return ParameterStore(ARDUPILOT_PARAMETERS, initial | scenario.autopilot.parameters)


STREAM_ROWS = read_rows(PACKAGE, "streams.csv")
DATA_STREAMS: dict[int, tuple[int, ...]] = {
    getattr(mavlink, f"MAV_DATA_STREAM_{group}"): tuple(
        message_id(row["message"]) for row in STREAM_ROWS if row["group"] == group
    )
    for group in dict.fromkeys(row["group"] for row in STREAM_ROWS if row["group"])
}
"""Messages of each MAV_DATA_STREAM group, ArduPilot `GCS_Mavlink.cpp`."""

NOT_ITS_OWN = message_ids(
    "MISSION_CHECKSUM RADIO_RC_CHANNELS AVAILABLE_MODES CURRENT_MODE AVAILABLE_MODES_MONITOR "
    "GNSS_INTEGRITY RANGING_BEACON COMMAND_CANCEL RADIO_RANGING TARGET_ESTIMATE"
)
"""Known here, but neither to common.xml nor to ardupilotmega.xml of that version."""
VENDORS = (range(150, 227), range(10001, 10152), range(11000, 11061))
"""Ids of ardupilotmega.xml and of the dialects that it includes."""
DIALECT = frozenset(CRC_EXTRA_BY_ID).difference(NOT_ITS_OWN).union(*VENDORS)

STREAMS = StreamProfile(
    {message_id(row["message"]): float(row["hz"]) for row in STREAM_ROWS},
    STEP_S,
    fixed=frozenset(),
    groups=DATA_STREAMS,
)
FIRMWARE = read_firmware(PACKAGE, STREAMS, DIALECT)


HORIZONTAL = mavlink.SPEED_TYPE_GROUNDSPEED
CLIMB, DESCENT = mavlink.SPEED_TYPE_CLIMB_SPEED, mavlink.SPEED_TYPE_DESCENT_SPEED


@dataclass(frozen=True, slots=True)
class CopterMode:
    """Flight mode of ArduCopter."""

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
"""Modes that are never entered; real ArduCopter's THROW waits for a throw."""
MODE_BY_PURPOSE: dict[FlightMode, CopterMode] = {
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


class WireMode(NamedTuple):
    """Mode with its number in a firmware."""

    number: int
    name: str
    copter_number: int | None
    """The Copter mode that does the same; None if it cannot be entered here."""


def _wire_modes(text: str) -> dict[int, WireMode]:
    """Return a table from `number:NAME=copter number` words."""
    modes = {}
    for word in text.split():
        number, _, rest = word.partition(":")
        name, _, copter = rest.partition("=")
        modes[int(number)] = WireMode(int(number), name, int(copter) if copter else None)
    return modes


PLANE = _wire_modes(
    "0:MANUAL=0 1:CIRCLE=7 2:STABILIZE=0 3:TRAINING=0 4:ACRO=1 5:FBWA=0 6:FBWB=2 7:CRUISE=2 "
    "8:AUTOTUNE 10:AUTO=3 11:RTL=6 12:LOITER=17 13:TAKEOFF 14:AVOID_ADSB=19 15:GUIDED=4 "
    "16:INITIALISING 24:THERMAL"
)
QUADPLANE = PLANE | _wire_modes(
    "17:QSTABILIZE=0 18:QHOVER=2 19:QLOITER=5 20:QLAND=9 21:QRTL=6 22:QAUTOTUNE 23:QACRO=1"
)
ROVER = _wire_modes(
    "0:MANUAL=0 1:ACRO=1 3:STEERING=0 4:HOLD=17 5:LOITER=17 6:FOLLOW 7:SIMPLE=0 9:CIRCLE=7 "
    "10:AUTO=3 11:RTL=6 12:SMART_RTL=21 15:GUIDED=4 16:INITIALISING"
)
SUB = _wire_modes(
    "0:STABILIZE=0 1:ACRO=1 2:ALT_HOLD=2 3:AUTO=3 4:GUIDED=4 7:CIRCLE=7 9:SURFACE=9 16:POSHOLD=16 "
    "19:MANUAL=0 20:MOTOR_DETECT 21:SURFTRAK=2"
)
TRACKER = _wire_modes("0:MANUAL=0 1:STOP=17 2:SCAN 3:SERVOTEST 4:GUIDED 10:AUTO 16:INITIALISING")
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
