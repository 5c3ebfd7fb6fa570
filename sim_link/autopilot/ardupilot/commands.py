"""ArduCopter's reaction to each MAV_CMD.

It is as permissive as real ArduCopter: a take-off to NaN climbs without end, mode numbers are cut
to 8 bits.

Source: MAVLink common, MAV_CMD; ArduCopter 4.5 as observed in SITL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED, OFFBOARD_NUMBER
from sim_link.autopilot.ardupilot.control import UNLIMITED_HEIGHT_M, Target
from sim_link.autopilot.ardupilot.firmware_profile import (
    ARDUPILOT_TABLES,
    AUTO,
    CLIMB,
    DESCENT,
    GUIDED,
    HORIZONTAL,
    LAND,
    LOITER,
    MODES,
    NEVER_ENTERED,
    RTL,
)
from sim_link.autopilot.ardupilot.flavour import ArduPilotFlavour
from sim_link.autopilot.control_inputs import Setpoint
from sim_link.autopilot.flavour import (
    ACCEPTED,
    DENIED,
    FAILED,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    UNSUPPORTED_MAV_FRAME,
    Handler,
    answers,
    chooses,
    is_altitude,
    is_force,
    is_valid_position,
    may_change_mode,
    set_home,
    terminate,
)
from sim_link.autopilot.protocols.command_protocol import Command
from sim_link.autopilot.protocols.message_streams import cast_to_uint32
from sim_link.autopilot.protocols.plan_items import GLOBAL_FRAMES
from sim_link.autopilot.protocols.plan_rules import commands_named

TAKEOFF_FRAMES = (mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,)
WARNING, ERROR = mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_ERROR


def _arm_disarm(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    wanted, is_forced = command.params[0], is_force(command.params[1])
    if wanted == 1.0:
        return flavour.arm(now_s, is_forced=bool(is_forced))
    if wanted == 0.0:
        return flavour.disarm(is_forced=bool(is_forced))
    return UNSUPPORTED


def _set_mode(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    base, number = command.whole(1), cast_to_uint32(command.params[1]) & 0xFF
    if base is None or not base & CUSTOM_MODE_ENABLED:
        return DENIED
    kind = flavour.aircraft.scenario.autopilot.vehicle_type
    table = ARDUPILOT_TABLES.get(kind)
    if table is not None:
        wanted = table.get(number)
        if wanted is None or wanted.copter_number is None:
            flavour.aircraft.notify(WARNING, f"No such mode {number}")
            return FAILED
        result = flavour.choose(MODES[wanted.copter_number], now_s)
        if result == ACCEPTED:
            flavour.chosen_number = number
        return result
    if number == OFFBOARD_NUMBER and flavour.aircraft.scenario.autopilot.offers_offboard:
        result = flavour.choose(GUIDED, now_s)
        if result == ACCEPTED:
            flavour.chosen_number = number
        return result
    mode = MODES.get(number)
    if mode is not None:
        return flavour.choose(mode, now_s)
    name = NEVER_ENTERED.get(number)
    refused = f"Mode change to {name} failed: init failed"
    text = f"No such mode {number}" if name is None else refused
    flavour.aircraft.notify(WARNING, text)
    return FAILED


def _take_off(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    """Take off to a height above home; only in GUIDED, armed and on the ground."""
    if command.frame is not None and command.frame not in TAKEOFF_FRAMES:
        return UNSUPPORTED_MAV_FRAME
    asked_m, aircraft = command.params[6], flavour.aircraft
    height_m = UNLIMITED_HEIGHT_M if math.isnan(asked_m) else min(asked_m, UNLIMITED_HEIGHT_M)
    is_ready = flavour.copter_mode is GUIDED and aircraft.is_armed and aircraft.body.is_on_ground
    if not is_ready or height_m <= 0.0:
        return FAILED
    up_m = aircraft.home_enu_m[2] + height_m
    if flavour.fence_margin_m((*aircraft.motion.position_enu_m[:2], up_m)) < 0.0:
        aircraft.notify(ERROR, "Takeoff: altitude is outside the fence")
        return FAILED
    aircraft.controller.takeoff_up_m = up_m
    flavour.guided.take_off()
    return ACCEPTED


def _reposition(flavour: ArduPilotFlavour, command: Command, now_s: float) -> int:
    aircraft = flavour.aircraft
    position, altitude_m = command.position_e7, command.params[6]
    frame = -1 if command.frame is None else command.frame
    if frame not in GLOBAL_FRAMES or position is None or not is_valid_position(position):
        return DENIED
    if not is_altitude(altitude_m):
        aircraft.notify(ERROR, "Reposition: altitude is not a number")
        return DENIED
    if flavour.copter_mode is not GUIDED:
        if not may_change_mode(command) or flavour.choose(GUIDED, now_s) != ACCEPTED:
            return DENIED
        flavour.settle(now_s, "commanded")
    goal = aircraft.position_from(*position, altitude_m, frame)
    if goal is None or flavour.fence_margin_m(goal) < 0.0:
        return FAILED
    yaw = command.params[3]
    setpoint = Setpoint(goal[:2], goal[2], yaw_ned_rad=yaw if math.isfinite(yaw) else None)
    is_on_ground = aircraft.body.is_on_ground
    flavour.guided.take(Target(setpoint), aircraft.time_s, is_on_ground=is_on_ground)
    return ACCEPTED


def _start_mission(flavour: ArduPilotFlavour, _command: Command, now_s: float) -> int:
    return flavour.choose(AUTO, now_s)


def _change_speed(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    """Change the speed of a SPEED_TYPE, if the mode has one."""
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
    flavour.aircraft.controller.hold_yaw_ned_rad = yaw
    return ACCEPTED


def _enable_fence(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    wanted = command.whole(1)
    if wanted not in (0, 1):
        return FAILED
    flavour.parameters.set("FENCE_ENABLE", float(wanted))
    return ACCEPTED


def _pause(flavour: ArduPilotFlavour, command: Command, _now_s: float) -> int:
    """Pause or continue GUIDED, which keeps its target; AUTO goes on here.

    Source: ArduCopter `ModeGuided::pause`.
    """
    wanted = command.whole(1)
    if wanted not in (0, 1):
        return DENIED
    if not flavour.is_armed or flavour.aircraft.body.is_on_ground:
        return FAILED
    flavour.guided.is_paused = wanted == 0
    return ACCEPTED


def _report_prearm(flavour: ArduPilotFlavour, _command: Command, now_s: float) -> int:
    if flavour.is_armed:
        return TEMPORARILY_REJECTED
    flavour.send_rejection("PreArm", flavour.arming_refusal(now_s))
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
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: _report_prearm,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: _pause,
    mavlink.MAV_CMD_PREFLIGHT_STORAGE: answers(DENIED),
    mavlink.MAV_CMD_DO_MOUNT_CONTROL: answers(FAILED),
    **dict.fromkeys(
        commands_named("DO_SET_RELAY DO_SET_SERVO DO_DIGICAM_CONTROL DO_SET_ROI"),
        answers(ACCEPTED),
    ),
}
"""Handler of each command in ArduCopter; any other command is unsupported."""
