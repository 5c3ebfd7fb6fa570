"""ArduCopter's flight modes: numbers, names, what each needs and does; and what each command does.

Where the real one does harm (a NaN altitude climbs without end, numbers wrap to 8 bits) this
refuses and says so in a text.

Source: ArduPilot `ArduCopter/mode.h`; MAVLink common, MAV_CMD; ArduCopter 4.5 as observed in SITL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED
from sim_link.autopilot.aircraft import AMSL_FRAMES, RELATIVE_FRAMES
from sim_link.autopilot.control_inputs import Setpoint
from sim_link.autopilot.flavours.base import (
    ACCEPTED,
    DENIED,
    FAILED,
    MAX_HEIGHT_M,
    UNSUPPORTED,
    UNSUPPORTED_MAV_FRAME,
    is_altitude,
    is_force,
    is_place,
    may_change_mode,
    place_e7,
    set_home,
    whole,
)
from sim_link.autopilot.pilot import Task
from sim_link.autopilot.protocols.command_protocol import Command

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
    needs_position: bool = True
    is_armable: bool = True
    flags: int = GUIDED_FLAGS
    """HEARTBEAT.base_mode while disarmed."""


_STICKS = Task.FLY_BY_STICKS
STABILIZE = CopterMode(
    0, "STABILIZE", FlightMode.STABILIZED, _STICKS, needs_position=False, flags=PLAIN_FLAGS
)
AUTO = CopterMode(3, "AUTO", FlightMode.MISSION, Task.FLY_MISSION, is_armable=False)
GUIDED = CopterMode(4, "GUIDED", FlightMode.OFFBOARD, Task.FOLLOW)
LOITER = CopterMode(5, "LOITER", FlightMode.POSITION, _STICKS)
RTL = CopterMode(6, "RTL", FlightMode.RETURN, Task.RETURN, is_armable=False)
LAND = CopterMode(
    9,
    "LAND",
    FlightMode.LAND,
    Task.LAND,
    needs_position=False,
    is_armable=False,
    flags=PLAIN_FLAGS,
)
ALT_HOLD = CopterMode(
    2, "ALT_HOLD", FlightMode.ALTITUDE, _STICKS, needs_position=False, flags=PLAIN_FLAGS
)
SMART_RTL = CopterMode(21, "SMART_RTL", FlightMode.RETURN, Task.RETURN, is_armable=False)
BRAKE = CopterMode(17, "BRAKE", FlightMode.HOLD, Task.STAY, is_armable=False)

MODES: dict[int, CopterMode] = {
    mode.number: mode
    for mode in (
        STABILIZE,
        CopterMode(1, "ACRO", FlightMode.ACRO, _STICKS, needs_position=False, flags=PLAIN_FLAGS),
        ALT_HOLD,
        AUTO,
        GUIDED,
        LOITER,
        RTL,
        CopterMode(7, "CIRCLE", FlightMode.HOLD, Task.CIRCLE, is_armable=False),
        LAND,
        CopterMode(16, "POSHOLD", FlightMode.POSITION, _STICKS),
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


if TYPE_CHECKING:
    from sim_link.autopilot.flavours.ardupilot.flavour import ArduPilotFlavour

TAKEOFF_FRAMES = (mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,)
ERROR = mavlink.MAV_SEVERITY_ERROR


def handle_command(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    """Obey a command; a MAV_RESULT."""
    match command.number:
        case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            return _arm_disarm(flavour, command, now_s)
        case mavlink.MAV_CMD_DO_SET_MODE:
            return _set_mode(flavour, command, now_s)
        case mavlink.MAV_CMD_NAV_TAKEOFF:
            return _take_off(flavour, command)
        case mavlink.MAV_CMD_NAV_LAND:
            return flavour.choose(LAND, now_s)
        case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            return flavour.choose(RTL, now_s)
        case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
            return flavour.choose(LOITER, now_s)
        case mavlink.MAV_CMD_DO_REPOSITION:
            return _reposition(flavour, command, now_s)
        case mavlink.MAV_CMD_MISSION_START:
            return flavour.choose(AUTO, now_s) if flavour.is_armed else FAILED
        case mavlink.MAV_CMD_DO_SET_HOME:
            return set_home(flavour.aircraft, command, FAILED, lasts=False)
    return _handle_other_command(flavour, command, now_s)


def _handle_other_command(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    match command.number:
        case mavlink.MAV_CMD_DO_CHANGE_SPEED:
            is_changed = flavour.change_speed(command.params[0], command.params[1])
            return ACCEPTED if is_changed else FAILED
        case mavlink.MAV_CMD_CONDITION_YAW:
            return _condition_yaw(flavour, command)
        case mavlink.MAV_CMD_DO_FENCE_ENABLE:
            return _enable_fence(flavour, command)
        case mavlink.MAV_CMD_DO_FLIGHTTERMINATION:
            if command.params[0] != 1.0:
                return FAILED
            flavour.aircraft.say(mavlink.MAV_SEVERITY_EMERGENCY, "Flight termination")
            return flavour.disarm(is_forced=True)
        case mavlink.MAV_CMD_RUN_PREARM_CHECKS:
            if flavour.is_armed:
                return mavlink.MAV_RESULT_TEMPORARILY_REJECTED
            flavour.send_rejection("PreArm", now_s)
            return ACCEPTED
    return UNSUPPORTED


def _arm_disarm(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    wanted, is_forced = command.params[0], is_force(command.params[1])
    if wanted == 1.0:
        return flavour.arm(now_s, is_forced=bool(is_forced))
    if wanted == 0.0:
        return flavour.disarm(is_forced=bool(is_forced))
    return UNSUPPORTED


def _set_mode(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    base, number = whole(command.params[0]), whole(command.params[1])
    if base is None or number is None or not base & CUSTOM_MODE_ENABLED:
        return DENIED
    mode = MODES.get(number)
    if mode is not None:
        return flavour.choose(mode, now_s)
    name = NOT_FLOWN.get(number)
    text = f"No such mode {number}" if name is None else f"Mode {name} is not simulated"
    flavour.aircraft.say(mavlink.MAV_SEVERITY_WARNING, text)
    return FAILED


def _take_off(flavour: ArduPilotFlavour, command: Command) -> int:
    """Above home; only in GUIDED, armed and on the ground."""
    if command.frame is not None and command.frame not in TAKEOFF_FRAMES:
        return UNSUPPORTED_MAV_FRAME
    height_m = command.params[6]
    aircraft = flavour.aircraft
    if not math.isfinite(height_m) or height_m > MAX_HEIGHT_M:
        aircraft.say(ERROR, "Takeoff: altitude is not a usable number")
        return FAILED
    is_ready = flavour.copter_mode is GUIDED and aircraft.is_armed and aircraft.body.is_on_ground
    if not is_ready or height_m <= 0.0:
        return FAILED
    up_m = aircraft.home_enu_m[2] + height_m
    if flavour.fence_margin_m((*aircraft.body.position_enu_m[:2], up_m)) < 0.0:
        aircraft.say(ERROR, "Takeoff: altitude is outside the fence")
        return FAILED
    aircraft.pilot.takeoff_up_m = up_m
    flavour.guided.take_off()
    return ACCEPTED


def _reposition(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    aircraft = flavour.aircraft
    place, altitude_m = place_e7(command), command.params[6]
    frame = -1 if command.frame is None else command.frame
    if frame not in AMSL_FRAMES + RELATIVE_FRAMES or place is None or not is_place(place):
        return DENIED
    if not is_altitude(altitude_m):
        aircraft.say(ERROR, "Reposition: altitude is not a number")
        return DENIED
    is_changing = may_change_mode(command)
    if flavour.copter_mode is not GUIDED:
        if not is_changing:
            return DENIED
        if flavour.choose(GUIDED, now_s) != ACCEPTED:
            return DENIED
        flavour.settle(now_s, "commanded")
    goal = aircraft.place_from(*place, altitude_m, frame)
    if goal is None or flavour.fence_margin_m(goal) < 0.0:
        return FAILED
    yaw = command.params[3]
    flavour.fly_to(Setpoint(goal[:2], goal[2], yaw_ned_rad=yaw if math.isfinite(yaw) else None))
    return ACCEPTED


def _condition_yaw(flavour: ArduPilotFlavour, command: Command) -> int:
    """Turn to a heading, or by an angle, degrees; only in GUIDED and AUTO."""
    angle_deg, _, direction, is_relative = command.params[:4]
    if not math.isfinite(angle_deg) or flavour.copter_mode not in (GUIDED, AUTO):
        return FAILED
    yaw = math.radians(angle_deg)
    if is_relative == 1.0:
        sign = -1.0 if direction == -1.0 else 1.0
        yaw = flavour.aircraft.heading_ned_rad + sign * yaw
    flavour.turn_to(yaw)
    return ACCEPTED


def _enable_fence(flavour: ArduPilotFlavour, command: Command) -> int:
    wanted = whole(command.params[0])
    if wanted not in (0, 1):
        return FAILED
    flavour.parameters.set("FENCE_ENABLE", float(wanted))
    return ACCEPTED
