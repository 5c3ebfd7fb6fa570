"""ArduCopter's flight modes as data (numbers, names, what each needs), and what each command does.

Where the real one does harm (a NaN altitude climbs without end, numbers wrap to 8 bits) this
refuses and says so in a text.

Source: ArduPilot `ArduCopter/mode.h`; MAVLink common, MAV_CMD; ArduCopter 4.5 as observed in SITL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED
from sim_link.autopilot.control_inputs import Setpoint
from sim_link.autopilot.flavours.ardupilot.guided import Target, TargetKind
from sim_link.autopilot.flavours.base import (
    ACCEPTED,
    DENIED,
    FAILED,
    MAX_HEIGHT_M,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    UNSUPPORTED_MAV_FRAME,
    Handler,
    chooses,
    is_altitude,
    is_force,
    is_place,
    may_change_mode,
    set_home,
    terminate,
)
from sim_link.autopilot.pilot import Task
from sim_link.autopilot.protocols.command_protocol import Command
from sim_link.autopilot.protocols.plan_items import GLOBAL_FRAMES

if TYPE_CHECKING:
    from sim_link.autopilot.flavours.ardupilot.flavour import ArduPilotFlavour


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
    CopterMode(16, "POSHOLD", FlightMode.POSITION, _STICKS),
    CopterMode(17, "BRAKE", FlightMode.HOLD, Task.STAY, is_armable=False),
    CopterMode(21, "SMART_RTL", FlightMode.RETURN, Task.RETURN, is_armable=False),
)
MODES: dict[int, CopterMode] = {mode.number: mode for mode in _TABLE}
STABILIZE, ALT_HOLD, AUTO, GUIDED, LOITER = (MODES[number] for number in (0, 2, 3, 4, 5))
RTL, LAND, BRAKE, SMART_RTL = (MODES[number] for number in (6, 9, 17, 21))
NOT_FLOWN = {18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS"}
"""Modes of the real one that are refused here, with a text."""
BY_WHAT_IT_DOES: dict[FlightMode, CopterMode] = {
    mode.mode: mode for mode in reversed(_TABLE) if mode.number not in (7, 16, 21)
}
"""The plain mode for each purpose: not CIRCLE, POSHOLD or SMART_RTL."""

TAKEOFF_FRAMES = (mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,)
WARNING, ERROR = mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_ERROR
HORIZONTAL = mavlink.SPEED_TYPE_GROUNDSPEED
CLIMB, DESCENT = mavlink.SPEED_TYPE_CLIMB_SPEED, mavlink.SPEED_TYPE_DESCENT_SPEED


def _arm_disarm(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    wanted, is_forced = command.params[0], is_force(command.params[1])
    if wanted == 1.0:
        return flavour.arm(now_s, is_forced=bool(is_forced))
    if wanted == 0.0:
        return flavour.disarm(is_forced=bool(is_forced))
    return UNSUPPORTED


def _set_mode(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    base, number = command.whole(1), command.whole(2)
    if base is None or number is None or not base & CUSTOM_MODE_ENABLED:
        return DENIED
    mode = MODES.get(number)
    if mode is not None:
        return flavour.choose(mode, now_s)
    name = NOT_FLOWN.get(number)
    text = f"No such mode {number}" if name is None else f"Mode {name} is not simulated"
    flavour.aircraft.say(WARNING, text)
    return FAILED


def _take_off(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
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
    place, altitude_m = command.place_e7, command.params[6]
    frame = -1 if command.frame is None else command.frame
    if frame not in GLOBAL_FRAMES or place is None or not is_place(place):
        return DENIED
    if not is_altitude(altitude_m):
        aircraft.say(ERROR, "Reposition: altitude is not a number")
        return DENIED
    if flavour.copter_mode is not GUIDED:
        if not may_change_mode(command) or flavour.choose(GUIDED, now_s) != ACCEPTED:
            return DENIED
        flavour.settle(now_s, "commanded")
    goal = aircraft.place_from(*place, altitude_m, frame)
    if goal is None or flavour.fence_margin_m(goal) < 0.0:
        return FAILED
    yaw = command.params[3]
    setpoint = Setpoint(goal[:2], goal[2], yaw_ned_rad=yaw if math.isfinite(yaw) else None)
    target, is_on_ground = Target(TargetKind.POSITION, setpoint), aircraft.body.is_on_ground
    flavour.guided.take(target, aircraft.time_s, is_on_ground=is_on_ground)
    return ACCEPTED


def _start_mission(flavour: ArduPilotFlavour, _command: Command, now_s: float) -> int:
    return flavour.choose(AUTO, now_s) if flavour.is_armed else FAILED


def _change_speed(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    """Of a SPEED_TYPE, where the mode has such a speed."""
    kind, speed_mps = command.params[:2]
    if flavour.copter_mode not in (GUIDED, AUTO, RTL) or not speed_mps > 0.0:
        return FAILED
    key = DESCENT if kind > CLIMB else CLIMB if kind > HORIZONTAL else HORIZONTAL
    flavour.commanded_mps[key] = speed_mps
    return ACCEPTED


def _condition_yaw(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    """Turn to a heading, or by an angle, degrees; only in GUIDED and AUTO."""
    angle_deg, _, direction, is_relative = command.params[:4]
    if not math.isfinite(angle_deg) or flavour.copter_mode not in (GUIDED, AUTO):
        return FAILED
    yaw = math.radians(angle_deg)
    if is_relative == 1.0:
        sign = -1.0 if direction == -1.0 else 1.0
        yaw = flavour.aircraft.heading_ned_rad + sign * yaw
    flavour.guided.turn_to(yaw)
    flavour.aircraft.pilot.hold_yaw_ned_rad = yaw
    return ACCEPTED


def _enable_fence(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    wanted = command.whole(1)
    if wanted not in (0, 1):
        return FAILED
    flavour.parameters.set("FENCE_ENABLE", float(wanted))
    return ACCEPTED


def _tell_prearm(flavour: ArduPilotFlavour, _command: Command, now_s: float) -> int:
    if flavour.is_armed:
        return TEMPORARILY_REJECTED
    flavour.send_rejection("PreArm", now_s)
    return ACCEPTED


HANDLERS: Mapping[int, Handler] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_NAV_TAKEOFF: _take_off,
    mavlink.MAV_CMD_NAV_LAND: chooses(LAND),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: chooses(RTL),
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: chooses(LOITER),
    mavlink.MAV_CMD_DO_REPOSITION: _reposition,
    mavlink.MAV_CMD_MISSION_START: _start_mission,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    mavlink.MAV_CMD_CONDITION_YAW: _condition_yaw,
    mavlink.MAV_CMD_DO_FENCE_ENABLE: _enable_fence,
    mavlink.MAV_CMD_DO_SET_HOME: set_home,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: terminate,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: _tell_prearm,
}
"""What ArduCopter does about each command; any other is unsupported."""
