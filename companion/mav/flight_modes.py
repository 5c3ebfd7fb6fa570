"""Flight modes on the wire, for PX4 and ArduCopter.

PX4 packs `main << 16 | sub << 24` into HEARTBEAT.custom_mode (PX4 `px4_custom_mode.h`);
ArduCopter sends its mode number (ArduPilot `ArduCopter/mode.h`).
"""

from __future__ import annotations

from companion.domain import ARDUPILOT_NAMES, Autopilot, FlightMode
from companion.mav.dialect import mavlink

PX4_MAIN_AND_SUB: dict[FlightMode, tuple[int, int]] = {
    FlightMode.MANUAL: (1, 0),
    FlightMode.ALTITUDE: (2, 0),
    FlightMode.POSITION: (3, 0),
    FlightMode.READY: (4, 1),
    FlightMode.TAKEOFF: (4, 2),
    FlightMode.HOLD: (4, 3),
    FlightMode.MISSION: (4, 4),
    FlightMode.RETURN: (4, 5),
    FlightMode.LAND: (4, 6),
    FlightMode.ACRO: (5, 0),
    FlightMode.OFFBOARD: (6, 0),
    FlightMode.STABILIZED: (7, 0),
}
_ARDUCOPTER_NAMES = (
    "STABILIZE ACRO ALT_HOLD AUTO GUIDED LOITER RTL CIRCLE MODE_8 LAND MODE_10 DRIFT MODE_12 SPORT "
    "FLIP AUTOTUNE POSHOLD BRAKE THROW AVOID_ADSB GUIDED_NOGPS SMART_RTL FLOWHOLD FOLLOW ZIGZAG "
    "SYSTEMID AUTOROTATE AUTO_RTL"
)
ARDUCOPTER_NAMES = dict(enumerate(_ARDUCOPTER_NAMES.split()))
"""By number, also of modes that are no `FlightMode`."""
_NUMBER = {name: number for number, name in ARDUCOPTER_NAMES.items()}
ARDUCOPTER_NUMBER = {mode: _NUMBER[name] for mode, name in ARDUPILOT_NAMES.items()}

_PX4_MODE = {packed: mode for mode, packed in PX4_MAIN_AND_SUB.items()}
_ARDUCOPTER_MODE = {number: mode for mode, number in ARDUCOPTER_NUMBER.items()}
CUSTOM_MODE_ENABLED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def px4_custom_mode(mode: FlightMode) -> int:
    """HEARTBEAT.custom_mode of a PX4 mode."""
    main, sub = PX4_MAIN_AND_SUB[mode]
    return main << 16 | sub << 24


def px4_mode(main: int, sub: int) -> FlightMode | None:
    """The PX4 mode of a main and sub number, or None if PX4 has no such mode."""
    if main != 4:
        sub = 0
    return _PX4_MODE.get((main, sub))


def autopilot_of(heartbeat: mavlink.MAVLink_heartbeat_message) -> Autopilot | None:
    """Whose HEARTBEAT it is, or None if the sender is no autopilot (a station, a payload)."""
    match heartbeat.autopilot:
        case mavlink.MAV_AUTOPILOT_PX4:
            return Autopilot.PX4
        case mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            return Autopilot.ARDUPILOT
        case mavlink.MAV_AUTOPILOT_INVALID:
            return None
    return Autopilot.OTHER


def mode_of(heartbeat: mavlink.MAVLink_heartbeat_message, autopilot: Autopilot) -> FlightMode:
    """The mode that an autopilot's HEARTBEAT shows."""
    custom_mode = heartbeat.custom_mode
    if autopilot is Autopilot.ARDUPILOT:
        return _ARDUCOPTER_MODE.get(custom_mode, FlightMode.UNKNOWN)
    if autopilot is Autopilot.PX4:
        return px4_mode(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF) or FlightMode.UNKNOWN
    return FlightMode.UNKNOWN


def other_mode_name(heartbeat: mavlink.MAVLink_heartbeat_message, autopilot: Autopilot) -> str:
    """What an operator calls the mode of a HEARTBEAT that is no `FlightMode`."""
    number = heartbeat.custom_mode
    if autopilot is Autopilot.ARDUPILOT:
        return ARDUCOPTER_NAMES.get(number, f"MODE_{number}")
    return f"mode {number >> 16 & 0xFF}/{number >> 24 & 0xFF}"


def set_mode_params(
    mode: FlightMode, autopilot: Autopilot, *, is_armed: bool
) -> tuple[float, float, float]:
    """Parameters 1 to 3 of MAV_CMD_DO_SET_MODE; a `KeyError` for a mode that there is not."""
    base_mode = CUSTOM_MODE_ENABLED
    if is_armed:
        base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    if autopilot is Autopilot.ARDUPILOT:
        return (float(base_mode), float(ARDUCOPTER_NUMBER[mode]), 0.0)
    main, sub = PX4_MAIN_AND_SUB[mode]
    return (float(base_mode), float(main), float(sub))
