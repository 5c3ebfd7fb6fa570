"""Flight modes by the names that rules use, as each autopilot numbers them.

Written down again here, apart from the simulator's own table: a probe must not agree with a wrong
number. Source: PX4 `px4_custom_mode.h`; ArduPilot `ArduCopter/mode.h`.
"""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.conformance.rules import Flavour

PX4_MAIN_SUB = {
    "manual": (1, 0),
    "altitude": (2, 0),
    "position": (3, 0),
    "takeoff": (4, 2),
    "hold": (4, 3),
    "mission": (4, 4),
    "return": (4, 5),
    "land": (4, 6),
    "acro": (5, 0),
    "offboard": (6, 0),
    "stabilized": (7, 0),
}
ARDUCOPTER = {
    "stabilized": 0,
    "acro": 1,
    "altitude": 2,
    "mission": 3,
    "offboard": 4,
    "loiter": 5,
    "return": 6,
    "land": 9,
    "position": 16,
    "hold": 17,
}
"""`offboard` is GUIDED and `hold` BRAKE."""
PX4_BASE_MODE = {"hold": 29, "takeoff": 29, "mission": 29, "return": 29, "land": 29} | {
    "position": 81,
    "altitude": 81,
}
"""HEARTBEAT.base_mode disarmed, as observed on PX4 1.15."""
ARDUCOPTER_BASE_MODE = {"stabilized": 0x51, "altitude": 0x51, "land": 0x51} | {
    "mission": 0x59,
    "offboard": 0x59,
    "loiter": 0x59,
    "return": 0x59,
    "position": 0x59,
    "hold": 0x59,
}
"""HEARTBEAT.base_mode disarmed, as observed on ArduCopter 4.5."""
AUTOPILOT_OF = {
    Flavour.PX4: mavlink.MAV_AUTOPILOT_PX4,
    Flavour.ARDUPILOT: mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
}
CUSTOM = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def custom_mode(flavour: Flavour, mode: str) -> int:
    """HEARTBEAT.custom_mode of a mode.

    Raises:
        KeyError: The autopilot has no such mode.
    """
    if flavour is Flavour.ARDUPILOT:
        return ARDUCOPTER[mode]
    main, sub = PX4_MAIN_SUB[mode]
    return main << 16 | sub << 24


def set_mode_params(flavour: Flavour, mode: str) -> tuple[float, float, float]:
    """Parameters 1 to 3 of MAV_CMD_DO_SET_MODE."""
    if flavour is Flavour.ARDUPILOT:
        return (float(CUSTOM), float(ARDUCOPTER[mode]), 0.0)
    main, sub = PX4_MAIN_SUB[mode]
    return (float(CUSTOM), float(main), float(sub))
