"""PX4's reaction to each MAV_CMD.

It accepts the same invalid values as PX4 (NaN to arm, main mode 99).

Source: PX4 1.15 as observed in SITL; MAVLink common, MAV_CMD.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED, px4_mode
from sim_link.autopilot.flavour import (
    ACCEPTED,
    DENIED,
    MAX_HEIGHT_M,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    UNSUPPORTED_MAV_FRAME,
    Handler,
    chooses,
    is_altitude,
    is_force,
    is_valid_position,
    may_change_mode,
    set_home,
    terminate,
)
from sim_link.autopilot.protocols.command_protocol import UNANSWERED, Command
from sim_link.autopilot.px4.firmware_profile import MAIN_MODES
from sim_link.autopilot.px4.flavour import Px4Flavour

GLOBAL = mavlink.MAV_FRAME_GLOBAL


def _arm_disarm(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    wanted, is_forced = command.params[0], is_force(command.params[1])
    if math.isnan(wanted):
        return ACCEPTED
    if wanted not in (0.0, 1.0):
        return UNANSWERED
    if is_forced is None:
        return DENIED
    if wanted == 1.0:
        return flavour.arm(now_s)
    return flavour.disarm(is_forced=is_forced)


def _set_mode(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    base, main, sub = command.whole(1), command.whole(2), command.whole(3, default=0)
    if main not in MAIN_MODES or not (base or 0) & CUSTOM_MODE_ENABLED:
        return ACCEPTED
    mode = None if sub is None else px4_mode(main, sub)
    if mode in (None, FlightMode.READY):
        return TEMPORARILY_REJECTED
    if mode is FlightMode.TAKEOFF:
        flavour.aircraft.controller.takeoff_up_m = _default_takeoff_up_m(flavour)
    return flavour.choose(mode, now_s)


def _take_off(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    altitude_m = command.params[6]
    home_up_m = flavour.aircraft.home_enu_m[2]
    up_m = flavour.aircraft.up_from(altitude_m, GLOBAL if command.frame is None else command.frame)
    if up_m is None:
        return UNSUPPORTED_MAV_FRAME
    if math.isnan(altitude_m):
        up_m = _default_takeoff_up_m(flavour)
    if not 0.0 < up_m - home_up_m <= MAX_HEIGHT_M:
        return DENIED
    flavour.aircraft.controller.takeoff_up_m = up_m
    return flavour.choose(FlightMode.TAKEOFF, now_s)


def _default_takeoff_up_m(flavour: Px4Flavour) -> float:
    return flavour.aircraft.home_enu_m[2] + flavour.parameters["MIS_TAKEOFF_ALT"]


def _reposition(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    """Go to a position and stay there; a missing height leaves it unchanged."""
    aircraft, controller = flavour.aircraft, flavour.aircraft.controller
    frame = GLOBAL if command.frame is None else command.frame
    altitude_m = command.params[6]
    up_m = aircraft.up_from(altitude_m, frame)
    if up_m is None:
        return UNSUPPORTED_MAV_FRAME
    position = command.position_e7
    if position is None or not aircraft.is_armed:
        return UNSUPPORTED
    if not is_valid_position(position):
        return DENIED
    if aircraft.body.is_on_ground:
        return TEMPORARILY_REJECTED
    located = aircraft.position_from(*position, 0.0, GLOBAL)
    assert located is not None
    east, north, _ = located
    up_m = aircraft.motion.position_enu_m[2] if math.isnan(altitude_m) else up_m
    if not is_altitude(up_m) or up_m - aircraft.home_enu_m[2] > MAX_HEIGHT_M:
        return DENIED
    if flavour.fence_margin_m((east, north, up_m)) < 0.0:
        aircraft.notify(mavlink.MAV_SEVERITY_ERROR, "Reposition is outside geofence")
        return DENIED
    if flavour.mode is not FlightMode.HOLD and not may_change_mode(command):
        return TEMPORARILY_REJECTED
    flavour.choose(FlightMode.HOLD, now_s)
    flavour.settle(now_s, "commanded")
    speed_mps, yaw = command.params[0], command.params[3]
    controller.go_to(
        (east, north, up_m),
        speed_mps if speed_mps > 0.0 and math.isfinite(speed_mps) else None,
        yaw if math.isfinite(yaw) else None,
    )
    return ACCEPTED


def _pause_continue(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    if command.params[0] == 0.0:
        return flavour.choose(FlightMode.HOLD, now_s)
    if command.params[0] == 1.0:
        return flavour.choose(FlightMode.MISSION, now_s)
    return DENIED


def _start_mission(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    mission = flavour.aircraft.mission
    if not mission.has_items:
        flavour.refuse(FlightMode.MISSION, "no mission")
        return DENIED
    first = command.whole(1, default=0)
    if first is None or not 0 <= first < len(mission.items):
        return DENIED
    if first:
        mission.set_current(first)
    result = flavour.choose(FlightMode.MISSION, now_s)
    if result == ACCEPTED and not flavour.is_armed:
        flavour.intention = FlightMode.HOLD  # it arms by itself, through Hold
        result = flavour.arm(now_s)
        if result == ACCEPTED:
            flavour.settle(now_s, "commanded")
            flavour.intention = FlightMode.MISSION
    return result


def _change_speed(flavour: Px4Flavour, command: Command, _now_s: float) -> int:
    speed_mps = command.params[1]
    if not (math.isfinite(speed_mps) and (speed_mps > 0.0 or speed_mps in (-1.0, -2.0))):
        return DENIED
    flavour.aircraft.controller.hold_speed_mps = speed_mps if speed_mps > 0.0 else None
    return ACCEPTED


def _report_prearm(flavour: Px4Flavour, _command: Command, now_s: float) -> int:
    flavour.send_rejection("Arming denied", flavour.arming_refusal(now_s))
    return ACCEPTED


HANDLERS: Mapping[int, Handler] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_NAV_TAKEOFF: _take_off,
    mavlink.MAV_CMD_NAV_LAND: chooses(FlightMode.LAND),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: chooses(FlightMode.RETURN),
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: chooses(FlightMode.HOLD),
    mavlink.MAV_CMD_DO_REPOSITION: _reposition,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: _pause_continue,
    mavlink.MAV_CMD_MISSION_START: _start_mission,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    mavlink.MAV_CMD_DO_SET_HOME: set_home,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: terminate,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: _report_prearm,
}
"""Handler of each command in PX4; any other command is unsupported."""
