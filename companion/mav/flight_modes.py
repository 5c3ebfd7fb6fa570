"""Flight modes on the wire by autopilot and vehicle class, and the HEARTBEATs of vehicles.

PX4 packs `main << 16 | sub << 24` into HEARTBEAT.custom_mode, the same for every class (PX4
`px4_custom_mode.h`). ArduPilot sends a number that each of its firmwares defines for itself: 4 is
GUIDED on Copter and ACRO on Plane, where 17, Copter's BRAKE, is QSTABILIZE (ArduPilot `mode.h` of
each vehicle; the names are those of the ardupilotmega dialect). So a number identifies a mode only
together with HEARTBEAT.type, and for a class that is not supported every mode is unknown.
"""

from __future__ import annotations

from companion.domain import ARDUPILOT_NAMES, Autopilot, FlightMode, VehicleClass
from companion.mav.dialect import Message, mavlink

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

PX4_OTHER_NAMES = {
    (4, 8): "follow target",
    (4, 9): "precision landing",
    (4, 10): "VTOL takeoff",
    **{(4, number): f"external mode {number - 10}" for number in range(11, 19)},
    (4, 19): "guided course",
    (4, 20): "descend",
    (10, 0): "termination",
    (11, 0): "altitude cruise",
}
"""Names by main and sub number of modes without a `FlightMode`, up to PX4 1.18-dev."""

OFFBOARD_NUMBER = 30
"""Number that all ArduPilot vehicles reserve for an external controller's mode; Copter has none
itself, but a script may register one, which flies as GUIDED does (ArduPilot #28939, #28110)."""


def _numbered(names: str) -> dict[int, str]:
    """Return a table from `number:NAME` words."""
    pairs = (word.split(":") for word in names.split())
    return {int(number): name for number, name in pairs}


ARDUCOPTER_NAMES = _numbered(
    "0:STABILIZE 1:ACRO 2:ALT_HOLD 3:AUTO 4:GUIDED 5:LOITER 6:RTL 7:CIRCLE 9:LAND 11:DRIFT "
    "13:SPORT 14:FLIP 15:AUTOTUNE 16:POSHOLD 17:BRAKE 18:THROW 19:AVOID_ADSB 20:GUIDED_NOGPS "
    "21:SMART_RTL 22:FLOWHOLD 23:FOLLOW 24:ZIGZAG 25:SYSTEMID 26:AUTOROTATE 27:AUTO_RTL 28:TURTLE"
)
"""Names by number, also of modes without a `FlightMode`."""
ARDUPLANE_NAMES = _numbered(
    "0:MANUAL 1:CIRCLE 2:STABILIZE 3:TRAINING 4:ACRO 5:FLY_BY_WIRE_A 6:FLY_BY_WIRE_B 7:CRUISE "
    "8:AUTOTUNE 10:AUTO 11:RTL 12:LOITER 13:TAKEOFF 14:AVOID_ADSB 15:GUIDED 16:INITIALIZING "
    "17:QSTABILIZE 18:QHOVER 19:QLOITER 20:QLAND 21:QRTL 22:QAUTOTUNE 23:QACRO 24:THERMAL "
    "25:LOITER_ALT_QLAND 26:AUTOLAND"
)
ARDUROVER_NAMES = _numbered(
    "0:MANUAL 1:ACRO 3:STEERING 4:HOLD 5:LOITER 6:FOLLOW 7:SIMPLE 8:DOCK 9:CIRCLE 10:AUTO 11:RTL "
    "12:SMART_RTL 15:GUIDED 16:INITIALIZING"
)
ARDUSUB_NAMES = _numbered(
    "0:STABILIZE 1:ACRO 2:ALT_HOLD 3:AUTO 4:GUIDED 7:CIRCLE 9:SURFACE 16:POSHOLD 19:MANUAL "
    "20:MOTORDETECT 21:SURFTRAK"
)
TRACKER_NAMES = _numbered("0:MANUAL 1:STOP 2:SCAN 3:SERVO_TEST 4:GUIDED 10:AUTO 16:INITIALIZING")
ARDUPILOT_MODE_NAMES: dict[VehicleClass, dict[int, str]] = {
    VehicleClass.MULTICOPTER: ARDUCOPTER_NAMES,
    VehicleClass.COAXIAL: ARDUCOPTER_NAMES,
    VehicleClass.HELICOPTER: ARDUCOPTER_NAMES,
    VehicleClass.UNSET: ARDUCOPTER_NAMES,
    VehicleClass.FIXED_WING: ARDUPLANE_NAMES,
    VehicleClass.VTOL: ARDUPLANE_NAMES,
    VehicleClass.ROVER: ARDUROVER_NAMES,
    VehicleClass.BOAT: ARDUROVER_NAMES,
    VehicleClass.SUBMARINE: ARDUSUB_NAMES,
    VehicleClass.TRACKER: TRACKER_NAMES,
}
_NUMBER = {name: number for number, name in ARDUCOPTER_NAMES.items()}
ARDUCOPTER_NUMBER = {mode: _NUMBER[name] for mode, name in ARDUPILOT_NAMES.items()}

_CLASSES = {
    VehicleClass.MULTICOPTER: (
        "QUADROTOR HEXAROTOR OCTOROTOR TRICOPTER DODECAROTOR DECAROTOR GENERIC_MULTIROTOR"
    ),
    VehicleClass.COAXIAL: "COAXIAL",
    VehicleClass.HELICOPTER: "HELICOPTER",
    VehicleClass.FIXED_WING: "FIXED_WING",
    VehicleClass.VTOL: (
        "VTOL_DUOROTOR VTOL_QUADROTOR VTOL_TILTROTOR VTOL_RESERVED2 VTOL_RESERVED3 VTOL_RESERVED4 "
        "VTOL_RESERVED5 VTOL_GYRODYNE"
    ),
    VehicleClass.ROVER: "GROUND_ROVER GROUND_QUADRUPED",
    VehicleClass.BOAT: "SURFACE_BOAT",
    VehicleClass.SUBMARINE: "SUBMARINE",
    VehicleClass.AIRSHIP: "AIRSHIP FREE_BALLOON",
    VehicleClass.TRACKER: "ANTENNA_TRACKER",
    VehicleClass.UNSET: "GENERIC",
    VehicleClass.OTHER: "ROCKET FLAPPING_WING KITE PARAFOIL SPACECRAFT_ORBITER",
}
CLASS_OF_TYPE: dict[int, VehicleClass] = {
    getattr(mavlink, f"MAV_TYPE_{name}"): vehicle_class
    for vehicle_class, names in _CLASSES.items()
    for name in names.split()
}
"""Vehicle class by MAV_TYPE; types without a class are stations and components."""

_PX4_MODE = {packed: mode for mode, packed in PX4_MAIN_AND_SUB.items()}
_ARDUCOPTER_MODE = {number: mode for mode, number in ARDUCOPTER_NUMBER.items()}
CUSTOM_MODE_ENABLED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def px4_custom_mode(mode: FlightMode) -> int:
    """Return HEARTBEAT.custom_mode of a PX4 mode."""
    main, sub = PX4_MAIN_AND_SUB[mode]
    return main << 16 | sub << 24


def px4_mode(main: int, sub: int) -> FlightMode | None:
    """Return the PX4 mode of a main and sub number, or None if PX4 has no such mode."""
    if main != 4:
        sub = 0
    return _PX4_MODE.get((main, sub))


def class_of(heartbeat: mavlink.MAVLink_heartbeat_message) -> VehicleClass:
    """Return the class of the vehicle whose autopilot sent a HEARTBEAT."""
    return CLASS_OF_TYPE.get(heartbeat.type, VehicleClass.OTHER)


def autopilot_of(heartbeat: mavlink.MAVLink_heartbeat_message) -> Autopilot | None:
    """Return the autopilot that sent a HEARTBEAT; None if its sender is not an autopilot.

    By type, stations, gimbals, cameras, onboard computers, ADS-B receivers and the like are
    excluded, whatever their `autopilot` field. MAV_AUTOPILOT_INVALID is "no autopilot", and GENERIC
    is sent by many components in its place. An antenna tracker runs ArduPilot, but moves only
    itself.
    """
    vehicle_class = CLASS_OF_TYPE.get(heartbeat.type)
    if vehicle_class in (None, VehicleClass.TRACKER):
        return None
    match heartbeat.autopilot:
        case mavlink.MAV_AUTOPILOT_PX4:
            return Autopilot.PX4
        case mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            return Autopilot.ARDUPILOT
        case mavlink.MAV_AUTOPILOT_INVALID | mavlink.MAV_AUTOPILOT_GENERIC:
            return None
    return Autopilot.OTHER


def is_of_component(message: Message) -> bool:
    """Return True for a HEARTBEAT of a sender that is not an autopilot, whatever its ids."""
    return isinstance(message, mavlink.MAVLink_heartbeat_message) and autopilot_of(message) is None


def gives_control(heartbeat: mavlink.MAVLink_heartbeat_message) -> bool:
    """Return True if a HEARTBEAT shows an armed vehicle in OFFBOARD or GUIDED."""
    autopilot = autopilot_of(heartbeat)
    is_armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    return (
        is_armed
        and autopilot is not None
        and mode_of(heartbeat, autopilot, offers_offboard=True) is FlightMode.OFFBOARD
    )


def mode_of(
    heartbeat: mavlink.MAVLink_heartbeat_message,
    autopilot: Autopilot,
    *,
    offers_offboard: bool = False,
) -> FlightMode:
    """Return the mode in an autopilot's HEARTBEAT; unknown for a class that is not supported.

    Mode 30 of an ArduPilot is known only if the vehicle `offers_offboard`.
    """
    custom_mode = heartbeat.custom_mode
    if not class_of(heartbeat).is_flown:
        return FlightMode.UNKNOWN
    if autopilot is Autopilot.ARDUPILOT:
        if offers_offboard and custom_mode == OFFBOARD_NUMBER:
            return FlightMode.OFFBOARD
        return _ARDUCOPTER_MODE.get(custom_mode, FlightMode.UNKNOWN)
    if autopilot is Autopilot.PX4:
        return px4_mode(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF) or FlightMode.UNKNOWN
    return FlightMode.UNKNOWN


def other_mode_name(heartbeat: mavlink.MAVLink_heartbeat_message, autopilot: Autopilot) -> str:
    """Return the operator's name for the mode of a HEARTBEAT without a `FlightMode`."""
    number = heartbeat.custom_mode
    if autopilot is Autopilot.ARDUPILOT:
        names = ARDUPILOT_MODE_NAMES.get(class_of(heartbeat), {})
        return names.get(number, "OFFBOARD" if number == OFFBOARD_NUMBER else f"MODE_{number}")
    main, sub = number >> 16 & 0xFF, number >> 24 & 0xFF
    mode = px4_mode(main, sub) if autopilot is Autopilot.PX4 else None
    other = PX4_OTHER_NAMES.get((main, sub), f"mode {main}/{sub}")
    return other if mode is None else mode.value


def set_mode_params(
    mode: FlightMode, autopilot: Autopilot, *, is_armed: bool
) -> tuple[float, float, float]:
    """Return parameters 1 to 3 of MAV_CMD_DO_SET_MODE; `KeyError`: there is no such mode."""
    base_mode = CUSTOM_MODE_ENABLED
    if is_armed:
        base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    if autopilot is Autopilot.ARDUPILOT:
        return (float(base_mode), float(ARDUCOPTER_NUMBER[mode]), 0.0)
    main, sub = PX4_MAIN_AND_SUB[mode]
    return (float(base_mode), float(main), float(sub))
