"""PX4 on one aircraft: modes, checks, failsafes, setpoints, and what HEARTBEAT shows.

Source: PX4 1.15 as observed in SITL; PX4 user guide, "Safety Configuration" and "Offboard Mode".
Reasons are told as STATUSTEXT; PX4 sends EVENT (410) instead, which few clients read.
"""

from __future__ import annotations

import math

from companion.domain import FlightMode, PositionEnu
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.control_inputs import (
    NOTHING,
    Axes,
    Echo,
    Setpoint,
    TargetMessage,
)
from sim_link.autopilot.flavours.base import ACCEPTED, FenceState, Flavour, HeartbeatState, Identity
from sim_link.autopilot.flavours.px4 import firmware_profile, flight_modes
from sim_link.autopilot.flavours.px4.failsafes import (
    MODE_OF_REACTION,
    Cause,
    FailsafeMonitor,
    Px4Failsafes,
    Reaction,
)
from sim_link.autopilot.flavours.px4.firmware_profile import CUSTOM_RULES, RULES
from sim_link.autopilot.flavours.px4.flight_modes import (
    MODE_NAMES,
    STICK_MODES,
    WITHOUT_POSITION_CONTROL,
    ModeConditions,
    ModeLogic,
)
from sim_link.autopilot.flavours.px4.offboard import setpoint_from
from sim_link.autopilot.mission_executor import LegKind
from sim_link.autopilot.pilot import STEP_S, Task
from sim_link.autopilot.protocols.addressing import flags_of
from sim_link.autopilot.protocols.command_protocol import Command
from sim_link.autopilot.protocols.parameter_store import ParameterStore

PX4_VERSION = 0x010F_02FF
"""1.15.2, official release: the one whose behaviour is simulated."""
CAPABILITIES = flags_of(
    "MAV_PROTOCOL_CAPABILITY",
    "MISSION_FLOAT PARAM_FLOAT MISSION_INT COMMAND_INT PARAM_ENCODE_BYTEWISE SET_ATTITUDE_TARGET "
    "SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT MAVLINK2 MISSION_FENCE "
    "MISSION_RALLY",
)
"""GLOBAL_INT is set although PX4 1.15 leaves it out: it obeys that message."""
TASKS: dict[FlightMode, Task] = {
    FlightMode.HOLD: Task.STAY,
    FlightMode.TAKEOFF: Task.TAKE_OFF,
    FlightMode.LAND: Task.LAND,
    FlightMode.RETURN: Task.RETURN,
    FlightMode.MISSION: Task.FLY_MISSION,
    FlightMode.OFFBOARD: Task.FOLLOW,
}
OVERRIDE_AUTO, OVERRIDE_OFFBOARD = 1, 2
"""Bits of COM_RC_OVERRIDE."""


class Px4Flavour(Flavour):
    """PX4 1.15, multicopter.

    Args:
        parameters: PX4's.
    """

    identity = Identity(mavlink.MAV_AUTOPILOT_PX4, PX4_VERSION, CAPABILITIES)
    rules = RULES

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        super().__init__(aircraft, parameters)
        if aircraft.scenario.autopilot.streams == "asked":
            self.rules = CUSTOM_RULES
        self.modes = ModeLogic()
        self._failsafes = Px4Failsafes()
        self._watcher = FailsafeMonitor(aircraft, parameters)
        self._limits_revision = -1

    # State

    @property
    def mode(self) -> FlightMode:
        """The mode that is flown."""
        return self.modes.mode

    @property
    def is_failsafe(self) -> bool:
        """Whether a failsafe chose the mode."""
        return self.modes.is_failsafe

    @property
    def reason(self) -> str:
        """Why a failsafe acts."""
        worst = self._failsafes.worst
        return "" if worst is None else worst[0].value

    @property
    def task(self) -> Task:
        """What the pilot is to do."""
        task = TASKS.get(self.mode, Task.FLY_BY_STICKS)
        needs_position = self.mode not in STICK_MODES
        if needs_position and not self.aircraft.estimator.is_position_valid:
            return Task.DESCEND
        return task

    def conditions(self, now_s: float) -> ModeConditions:
        """What the mode rules need to know."""
        return ModeConditions(
            check_refusal=self._check_refusal(now_s),
            is_stream_alive=self._is_stream_alive(now_s),
            is_on_ground=self.aircraft.body.is_on_ground,
            has_sticks=self.aircraft.sticks.read(now_s) is not None,
            has_mission=self.aircraft.mission.has_items,
        )

    def has_home(self, now_s: float) -> bool:  # noqa: ARG002  the base gives the time
        """Origin and home are known from the start."""
        return True

    def has_position(self, now_s: float) -> bool:  # noqa: ARG002  the base gives the time
        """The position is told before it can be armed, too."""
        return self.aircraft.estimator.is_position_valid

    def arming_refusal(self, now_s: float) -> str | None:
        """Why it could not be armed now, or None."""
        return self.modes.arming_refusal(self.conditions(now_s))

    def _is_stream_alive(self, now_s: float) -> bool:
        return self.setpoints.is_alive(now_s, self.parameters["COM_OF_LOSS_T"])

    def _check_refusal(self, now_s: float) -> str | None:
        """The checks that hold in every mode."""
        if now_s < self.aircraft.scenario.autopilot.ready_after_s:
            return "system is booting"
        if not self.aircraft.estimator.is_position_valid:
            return "no position estimate"
        if self.aircraft.battery.share <= self.parameters["BAT_CRIT_THR"]:
            return "battery too low"
        has_action = self.parameters["GF_ACTION"] >= 1
        if has_action and self.fence_margin_m(self.aircraft.body.position_enu_m) < 0.0:
            return "outside the geofence"
        return None

    def fence_margin_m(self, place: PositionEnu) -> float:
        """Distance from a place to the nearest breach of the fence, negative in one."""
        margin = self.aircraft.fence.margin_m(place)
        home = self.aircraft.home_enu_m
        horizontal_m = self.parameters["GF_MAX_HOR_DIST"]
        vertical_m = self.parameters["GF_MAX_VER_DIST"]
        if horizontal_m > 0.0:
            margin = min(margin, horizontal_m - math.dist(place[:2], home[:2]))
        if vertical_m > 0.0:
            margin = min(margin, vertical_m - (place[2] - home[2]))
        return margin

    def fence_state(self, place: PositionEnu) -> FenceState:
        """A fence is there once it is uploaded, or a distance is set."""
        value = self.parameters
        has_limits = value["GF_MAX_HOR_DIST"] > 0.0 or value["GF_MAX_VER_DIST"] > 0.0
        is_present = has_limits or not self.aircraft.fence.is_empty
        is_enabled = is_present and value["GF_ACTION"] > 0
        return FenceState(is_present, is_enabled, self.fence_margin_m(place) < 0.0)

    # Commands

    def _handle_command(self, command: Command, now_s: float) -> int:
        return flight_modes.handle_command(self, command, now_s)

    def choose(self, mode: FlightMode | None, now_s: float) -> int:
        """The operator chooses a mode; a MAV_RESULT, and the reason as a text if refused."""
        conditions = self.conditions(now_s)
        is_same = mode is self.mode
        result = self.modes.choose(mode, conditions)
        if result == ACCEPTED:
            self._failsafes.take_over()
            if is_same and mode is FlightMode.HOLD:
                self.aircraft.pilot.enter(self.task, self.aircraft.body)
        elif mode in MODE_NAMES:
            why = self.modes.choice_refusal(mode, conditions)
            self.refuse(MODE_NAMES[mode], why or "not now")
        return result

    def pilot_chooses(self, mode: FlightMode, now_s: float) -> None:
        """The pilot turns the mode switch."""
        self.choose(mode, now_s)
        self.settle(now_s, "pilot")

    def refuse(self, mode_name: str, why: str) -> None:
        """Say why a mode was not entered."""
        text = f"Switching to {mode_name} not available: {why}"
        self.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, text)

    def arm(self, now_s: float) -> int:
        """A request to arm; a MAV_RESULT, and the reason as a text if refused."""
        conditions = self.conditions(now_s)
        result = self.modes.arm(conditions)
        if result != ACCEPTED:
            self.send_rejection(now_s)
        self.aircraft.is_armed = self.modes.is_armed
        return result

    def arm_for_mission(self, now_s: float) -> int:
        """MISSION_START arms by itself, through Hold."""
        self.modes.intention = FlightMode.HOLD
        result = self.arm(now_s)
        if result == ACCEPTED:
            self.settle(now_s, "commanded")
            self.modes.intention = FlightMode.MISSION
        return result

    def send_rejection(self, now_s: float) -> None:
        """Say why it cannot be armed."""
        why = self.arming_refusal(now_s)
        if why is not None:
            self.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, f"Arming denied: {why}")

    def disarm(self, now_s: float, *, is_forced: bool) -> int:
        """A request to disarm; a MAV_RESULT."""
        conditions = self.conditions(now_s)
        result = self.modes.disarm(conditions, is_forced=is_forced)
        if result == ACCEPTED:
            self._failsafes.clear()
        else:
            self.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, "Disarming denied: not landed")
        self.aircraft.is_armed = self.modes.is_armed
        return result

    def set_origin(self, latitude_e7: int, longitude_e7: int, altitude_mm: int) -> bool:
        """A station sets the EKF origin; whether it moved."""
        self.aircraft.set_origin(latitude_e7, longitude_e7, altitude_mm)
        return True

    # Setpoints

    def take_setpoint(self, message: TargetMessage, now_s: float) -> None:
        """Kept if it is valid, whatever the mode."""
        self.setpoints.take(setpoint_from(message, self.aircraft), now_s)

    def echo(self) -> Echo | None:
        """What the position controller works with; nothing in modes without one."""
        if not self.is_armed or self.mode in WITHOUT_POSITION_CONTROL:
            return None
        pilot, setpoint = self.aircraft.pilot, self.setpoints.setpoint
        place: Axes = NOTHING if pilot.goal_enu_m is None else pilot.goal_enu_m
        yaw, yaw_rate = pilot.hold_yaw_ned_rad, 0.0
        if self.task is Task.FOLLOW:
            place = (*(setpoint.position_en_m or (None, None)), setpoint.up_m)
            yaw, yaw_rate = setpoint.yaw_ned_rad, setpoint.yaw_rate_ned_radps or 0.0
        return Echo(
            place,
            pilot.wanted_enu_mps,
            self.aircraft.body.acceleration_enu_mps2,
            self.aircraft.heading_ned_rad if yaw is None else yaw,
            yaw_rate,
            nothing=math.nan,
        )

    def _flown_setpoint(self, now_s: float) -> Setpoint:  # noqa: ARG002  it does not age
        return self.setpoints.setpoint

    # What happens by itself

    def disarm_delay_s(self) -> float | None:
        """After a landing; OFFBOARD never ends by itself, as on PX4."""
        if self.mode is FlightMode.OFFBOARD and self.aircraft.has_flown:
            return None
        is_landing = self.mode in (FlightMode.LAND, FlightMode.RETURN)
        landed = self.aircraft.has_flown or is_landing
        delay_s = self.parameters["COM_DISARM_LAND" if landed else "COM_DISARM_PRFLT"]
        is_enabled = delay_s >= 0.0 if landed else delay_s > 0.0
        return delay_s if is_enabled else None

    def disarm_landed(self, now_s: float) -> None:
        """It has stood long enough."""
        self.disarm(now_s, is_forced=True)

    def _after_flying(self, now_s: float) -> None:
        if not self.is_armed:
            return
        if self.mode is FlightMode.TAKEOFF:
            if self.aircraft.pilot.has_taken_off(self.aircraft.body):
                self.modes.finish(FlightMode.TAKEOFF)
                self.settle(now_s, "takeoff complete")
        elif self.mode is FlightMode.MISSION:
            if self._is_mission_over or not self.aircraft.mission.has_items:
                self.modes.finish(FlightMode.MISSION)
                self.settle(now_s, "mission complete")
            elif self.leg is not None and self.leg.kind is LegKind.RETURN:
                self.aircraft.mission.finish_leg()
                self.leg = None
                self.choose(FlightMode.RETURN, now_s)
                self.settle(now_s, "mission")

    def _watch(self, now_s: float) -> None:
        self._watcher.warn_of_battery()
        if self.parameters.revision != self._limits_revision:
            self._limits_revision = self.parameters.revision
            self.aircraft.pilot.limits = firmware_profile.speed_limits(self.parameters)
        if not self.is_armed:
            return
        sticks = self.aircraft.sticks.read(now_s)
        if sticks is not None and sticks.are_moved and self._sticks_override():
            self.choose(FlightMode.POSITION, now_s)
            self.settle(now_s, "sticks moved")
        findings = self._watcher.findings(
            self.modes.intention,
            self.fence_margin_m(self.aircraft.body.position_enu_m),
            now_s,
            is_stream_alive=self._is_stream_alive(now_s),
        )
        delay_s = self.parameters["COM_FAIL_ACT_T"]
        can_hold = self.aircraft.estimator.is_position_valid
        for cause in self._failsafes.watch(findings, STEP_S, delay_s, can_hold=can_hold):
            self._tell(cause)
        self._react(now_s)

    def _tell(self, cause: Cause) -> None:
        self.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, f"Failsafe: {cause.value}")
        if self._failsafes.delay_s > 0.0:
            text = f"Failsafe activated, entering Hold for {self._failsafes.delay_s:.0f} seconds"
            self.aircraft.say(mavlink.MAV_SEVERITY_CRITICAL, text)

    def _react(self, now_s: float) -> None:
        reaction = self._failsafes.flown
        if reaction is Reaction.DISARM:
            self.disarm(now_s, is_forced=True)
            return
        self.modes.reaction = None if reaction is None else MODE_OF_REACTION.get(reaction)

    def settle(self, now_s: float, why: str = "") -> None:
        """As the base does, with the height of a return known before it begins."""
        if self.mode is FlightMode.RETURN:
            height_m = self.parameters["RTL_RETURN_ALT"]
            self.aircraft.pilot.return_up_m = self.aircraft.home_enu_m[2] + height_m
        super().settle(now_s, why)

    def _sticks_override(self) -> bool:
        """Whether moved sticks end the mode; a failsafe that waits in Hold hears no sticks."""
        if self._failsafes.delay_s > 0.0:
            return False
        bits = int(self.parameters["COM_RC_OVERRIDE"])
        if self.modes.intention is FlightMode.OFFBOARD:
            return bool(bits & OVERRIDE_OFFBOARD)
        return self.mode not in STICK_MODES and bool(bits & OVERRIDE_AUTO)

    # HEARTBEAT

    def heartbeat_state(self, now_s: float) -> HeartbeatState:
        """What HEARTBEAT shows."""
        return flight_modes.heartbeat_state(
            self.mode,
            is_armed=self.is_armed,
            is_failsafe=self.is_failsafe,
            is_stream_alive=self._is_stream_alive(now_s),
            can_arm=not self.is_armed and self.arming_refusal(now_s) is None,
        )
