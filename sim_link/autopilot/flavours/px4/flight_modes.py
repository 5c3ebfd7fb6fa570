"""Arming and flight modes of PX4: the rules, what HEARTBEAT shows, and what each command does.

Theory of operation. Two modes are kept apart, as in PX4's commander: the *intention*, which an
operator chose, and the *mode* that is flown. They differ only during a failsafe: the mode is the
reaction, the intention is what it was. When the failsafe ends by itself (setpoints return), the
intention is flown again without any command; when the operator chooses a mode meanwhile, that
choice replaces the intention and ends the failsafe.

    event                               | condition                 | result
    ------------------------------------+---------------------------+------------------------------
    choose HOLD, TAKEOFF, LAND, RETURN  | any                       | flown
    choose OFFBOARD                     | disarmed, or stream alive | flown
                                        | armed, no stream          | temporarily rejected
    choose MISSION                      | disarmed, or one is there | flown
                                        | armed, no mission         | temporarily rejected
    choose a mode for sticks            | disarmed, or sticks       | flown
                                        | armed, no sticks          | temporarily rejected
    choose READY, or no mode of PX4's   | any                       | denied
    arm                                 | armed                     | accepted, nothing happens
                                        | checks passed; HOLD,      | armed
                                        | TAKEOFF, a mode for sticks|
                                        | with sticks, or           |
                                        | OFFBOARD with a stream    |
                                        | otherwise, forced or not  | temporarily rejected
    disarm                              | on the ground, or forced  | disarmed
                                        | in the air                | temporarily rejected
    takeoff height reached              | TAKEOFF                   | HOLD
    mission complete                    | MISSION                   | HOLD

Disarming ends LAND, RETURN, TAKEOFF, MISSION and a failsafe in HOLD, so that the next flight can be
armed.

Where PX4 accepts nonsense (NaN to arm, main mode 99, wrong frames) this denies it.

Source: PX4 1.15 as observed in SITL; MAVLink common, MAV_CMD, MAV_MODE_FLAG and MAV_STATE.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED, px4_custom_mode, px4_mode
from sim_link.autopilot.flavours.base import (
    ACCEPTED,
    DENIED,
    MAX_HEIGHT_M,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    UNSUPPORTED_MAV_FRAME,
    HeartbeatState,
    is_altitude,
    is_force,
    is_place,
    may_change_mode,
    place_e7,
    set_home,
    whole,
)
from sim_link.autopilot.protocols.addressing import flags_of
from sim_link.autopilot.protocols.command_protocol import Command

AUTOMATIC_MODES = frozenset(
    {FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN}
)
WITHOUT_POSITION_CONTROL = frozenset({FlightMode.STABILIZED, FlightMode.ACRO, FlightMode.MANUAL})
STICK_MODES = WITHOUT_POSITION_CONTROL | {FlightMode.POSITION, FlightMode.ALTITUDE}
ENDED_BY_DISARMING = AUTOMATIC_MODES | {FlightMode.MISSION}
MODE_NAMES = {
    mode: mode.name.capitalize()
    for mode in (*AUTOMATIC_MODES, *STICK_MODES, FlightMode.MISSION, FlightMode.OFFBOARD)
}
"""As PX4 and QGroundControl call them."""


@dataclass(frozen=True, slots=True)
class ModeConditions:
    """What the rules need to know of the vehicle at one moment."""

    check_refusal: str | None
    """Why the checks that hold in every mode fail; None: they pass."""
    is_stream_alive: bool
    is_on_ground: bool
    has_sticks: bool
    has_mission: bool


class ModeLogic:
    """Who may arm, and which mode is flown."""

    def __init__(self) -> None:
        self.intention = FlightMode.HOLD
        """The mode that the operator chose."""
        self.reaction: FlightMode | None = None
        """The mode that a failsafe puts in its place."""
        self.is_armed = False

    @property
    def mode(self) -> FlightMode:
        """The mode that is flown and shown in HEARTBEAT."""
        return self.intention if self.reaction is None else self.reaction

    @property
    def is_failsafe(self) -> bool:
        """Whether a failsafe chose the mode that is flown."""
        return self.is_armed and self.reaction is not None

    def arming_refusal(self, conditions: ModeConditions) -> str | None:
        """Why a request to arm would be refused now, or None."""
        if conditions.check_refusal is not None:
            return conditions.check_refusal
        mode = self.mode
        if mode is FlightMode.OFFBOARD:
            return None if conditions.is_stream_alive else "no offboard setpoints"
        if mode in STICK_MODES:
            return None if conditions.has_sticks else "no manual control"
        if mode in (FlightMode.HOLD, FlightMode.TAKEOFF):
            return None
        return f"{MODE_NAMES[mode]} mode cannot be armed in"

    def choice_refusal(self, mode: FlightMode, conditions: ModeConditions) -> str | None:
        """Why an armed vehicle would not be switched to a mode now, or None."""
        if mode is FlightMode.OFFBOARD and not conditions.is_stream_alive:
            return "no setpoints"
        if mode is FlightMode.MISSION and not conditions.has_mission:
            return "no mission"
        if mode in STICK_MODES and not conditions.has_sticks:
            return "no manual control"
        return None

    def choose(self, mode: FlightMode | None, conditions: ModeConditions) -> int:
        """The operator's choice of a mode (None: PX4 has no such mode); a MAV_RESULT."""
        if mode is None or mode in (FlightMode.READY, FlightMode.UNKNOWN):
            return DENIED
        if self.is_armed and self.choice_refusal(mode, conditions) is not None:
            return TEMPORARILY_REJECTED
        self.intention = mode
        self.reaction = None
        return ACCEPTED

    def arm(self, conditions: ModeConditions) -> int:
        """A request to arm, forced or not; a MAV_RESULT."""
        if self.is_armed:
            return ACCEPTED
        if self.arming_refusal(conditions) is not None:
            return TEMPORARILY_REJECTED
        self.is_armed = True
        return ACCEPTED

    def disarm(self, conditions: ModeConditions, *, is_forced: bool) -> int:
        """A request to disarm; forced, it stops the motors in the air. A MAV_RESULT."""
        if not self.is_armed:
            return ACCEPTED
        if not conditions.is_on_ground and not is_forced:
            return TEMPORARILY_REJECTED
        if self.is_failsafe or self.mode in ENDED_BY_DISARMING:
            self.intention = FlightMode.HOLD
        self.reaction = None
        self.is_armed = False
        return ACCEPTED

    def finish(self, mode: FlightMode) -> None:
        """TAKEOFF has reached its height, or MISSION its end: stay there."""
        if self.intention is mode:
            self.intention = FlightMode.HOLD


AUTO_FLAGS = flags_of("MAV_MODE_FLAG", "STABILIZE_ENABLED GUIDED_ENABLED AUTO_ENABLED")
MANUAL_FLAGS = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
STICK_FLAGS = MANUAL_FLAGS | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
BASE_MODE_FLAGS: dict[FlightMode, int] = {
    **dict.fromkeys((FlightMode.POSITION, FlightMode.ALTITUDE, FlightMode.STABILIZED), STICK_FLAGS),
    **dict.fromkeys((FlightMode.MANUAL, FlightMode.ACRO), MANUAL_FLAGS),
}
"""What a mode adds to CUSTOM_MODE_ENABLED; modes not listed are automatic (OFFBOARD apart)."""


def heartbeat_state(
    mode: FlightMode, *, is_armed: bool, is_failsafe: bool, is_stream_alive: bool, can_arm: bool
) -> HeartbeatState:
    """What HEARTBEAT shows: disarmed, OFFBOARD without a stream has no flag but the first."""
    base_mode = CUSTOM_MODE_ENABLED
    if mode is FlightMode.OFFBOARD:
        if is_armed or is_stream_alive:
            base_mode |= mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    else:
        base_mode |= BASE_MODE_FLAGS.get(mode, AUTO_FLAGS)
    if is_armed:
        base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        status = mavlink.MAV_STATE_CRITICAL if is_failsafe else mavlink.MAV_STATE_ACTIVE
    else:
        status = mavlink.MAV_STATE_STANDBY if can_arm else mavlink.MAV_STATE_UNINIT
    return HeartbeatState(base_mode, px4_custom_mode(mode), status)


if TYPE_CHECKING:
    from sim_link.autopilot.flavours.px4.flavour import Px4Flavour

GLOBAL = mavlink.MAV_FRAME_GLOBAL


def _arm_disarm(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    wanted, is_forced = command.params[0], is_force(command.params[1])
    if wanted not in (0.0, 1.0) or is_forced is None:
        return DENIED
    if wanted == 1.0:
        return flavour.arm(now_s)
    return flavour.disarm(now_s, is_forced=is_forced)


def _set_mode(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    base, main = whole(command.params[0]), whole(command.params[1])
    sub = 0 if math.isnan(command.params[2]) else whole(command.params[2])
    if base is None or main is None or sub is None or not base & CUSTOM_MODE_ENABLED:
        return DENIED
    mode = px4_mode(main, sub)
    if mode is FlightMode.TAKEOFF:
        flavour.aircraft.pilot.takeoff_up_m = _default_takeoff_up_m(flavour)
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
    flavour.aircraft.pilot.takeoff_up_m = up_m
    return flavour.choose(FlightMode.TAKEOFF, now_s)


def _default_takeoff_up_m(flavour: Px4Flavour) -> float:
    return flavour.aircraft.home_enu_m[2] + flavour.parameters["MIS_TAKEOFF_ALT"]


def _reposition(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    """Go to a place and stay there; what is left open stays as it is."""
    aircraft, pilot = flavour.aircraft, flavour.aircraft.pilot
    frame = GLOBAL if command.frame is None else command.frame
    altitude_m = command.params[6]
    up_m = aircraft.up_from(altitude_m, frame)
    if up_m is None:
        return UNSUPPORTED_MAV_FRAME
    place = place_e7(command)
    if place is not None and not is_place(place):
        return DENIED
    if not aircraft.is_armed or aircraft.body.is_on_ground:
        return TEMPORARILY_REJECTED
    east, north, own_up = aircraft.body.position_enu_m
    if place is not None:
        located = aircraft.place_from(*place, 0.0, GLOBAL)
        assert located is not None
        east, north, _ = located
    up_m = own_up if math.isnan(altitude_m) else up_m
    if not is_altitude(up_m) or up_m - aircraft.home_enu_m[2] > MAX_HEIGHT_M:
        return DENIED
    if flavour.fence_margin_m((east, north, up_m)) < 0.0:
        aircraft.say(mavlink.MAV_SEVERITY_ERROR, "Reposition is outside geofence")
        return DENIED
    is_changing = may_change_mode(command)
    if flavour.mode is not FlightMode.HOLD and not is_changing:
        return TEMPORARILY_REJECTED
    flavour.choose(FlightMode.HOLD, now_s)
    flavour.settle(now_s, "commanded")
    speed_mps, yaw = command.params[0], command.params[3]
    pilot.go_to(
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
        flavour.refuse(MODE_NAMES[FlightMode.MISSION], "no mission")
        return TEMPORARILY_REJECTED
    first = 0 if math.isnan(command.params[0]) else whole(command.params[0])
    if first is None or not 0 <= first < len(mission.items):
        return DENIED
    if first:
        mission.set_current(first)
    result = flavour.choose(FlightMode.MISSION, now_s)
    if result == ACCEPTED and not flavour.aircraft.is_armed:
        result = flavour.arm_for_mission(now_s)
    return result


def _change_speed(flavour: Px4Flavour, command: Command) -> int:
    speed_mps = command.params[1]
    if not (math.isfinite(speed_mps) and (speed_mps > 0.0 or speed_mps in (-1.0, -2.0))):
        return DENIED
    flavour.aircraft.pilot.hold_speed_mps = speed_mps if speed_mps > 0.0 else None
    return ACCEPTED


def _terminate(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    if command.params[0] != 1.0:
        return DENIED
    flavour.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, "Flight termination: motors stopped")
    return flavour.disarm(now_s, is_forced=True)


def _tell_prearm(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    del command
    flavour.send_rejection(now_s)
    return ACCEPTED


CHOSEN_MODES = {
    mavlink.MAV_CMD_NAV_LAND: FlightMode.LAND,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: FlightMode.RETURN,
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: FlightMode.HOLD,
}
"""Commands that only choose a mode."""
HANDLERS: dict[int, Callable[[Px4Flavour, Command, float], int]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mavlink.MAV_CMD_DO_SET_MODE: _set_mode,
    mavlink.MAV_CMD_NAV_TAKEOFF: _take_off,
    mavlink.MAV_CMD_DO_REPOSITION: _reposition,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: _pause_continue,
    mavlink.MAV_CMD_MISSION_START: _start_mission,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: lambda flavour, command, _: _change_speed(flavour, command),
    mavlink.MAV_CMD_DO_SET_HOME: (
        lambda flavour, command, _: set_home(flavour.aircraft, command, DENIED, lasts=True)
    ),
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: _tell_prearm,
}


def handle_command(flavour: Px4Flavour, command: Command, now_s: float) -> int:
    """Do what a command asks; a MAV_RESULT."""
    mode = CHOSEN_MODES.get(command.number)
    if mode is not None:
        return flavour.choose(mode, now_s)
    handler = HANDLERS.get(command.number)
    return UNSUPPORTED if handler is None else handler(flavour, command, now_s)
