"""PX4 on one aircraft: modes, arming, checks, failsafes, setpoints, and what HEARTBEAT shows.

Theory of operation. Two modes are distinguished, as in PX4's commander: the *intention*, which an
operator chose, and the *mode* that is flown. They differ only during a failsafe: the mode is the
reaction, the intention is what it was. When the failsafe ends by itself (setpoints return), the
intention is flown again without any command; when the operator chooses a mode before then, that
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

Source: PX4 1.15 as observed in SITL; PX4 user guide, "Safety Configuration" and "Offboard Mode";
MAVLink common, MAV_MODE_FLAG and MAV_STATE. Reasons are sent as STATUSTEXT; PX4 sends EVENT (410)
instead, which few clients read.
"""

from __future__ import annotations

import math

from companion.domain import FlightMode, PositionEnu
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import CUSTOM_MODE_ENABLED, px4_custom_mode
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.control_inputs import MOVED, NOTHING, Axes, Echo, Setpoint, TargetMessage
from sim_link.autopilot.flavour import (
    ACCEPTED,
    DENIED,
    TEMPORARILY_REJECTED,
    AutopilotFlavour,
    FenceState,
    HeartbeatState,
)
from sim_link.autopilot.flight_controller import Task
from sim_link.autopilot.mission_executor import LegKind
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.autopilot.px4.control import Px4Failsafes, Reaction, setpoint_from
from sim_link.autopilot.px4.firmware_profile import (
    AUTO_FLAGS,
    BASE_MODE_FLAGS,
    ENDED_BY_DISARMING,
    FIRMWARE,
    STICK_MODES,
    TASKS,
    WITHOUT_POSITION_CONTROL,
    speed_limits,
)

OVERRIDE_AUTO, OVERRIDE_OFFBOARD = 1, 2
THROTTLE_LOW, THROTTLE_ABOVE_CENTRE = -0.8, 0.2
"""Deflections up to, and from, which PX4 counts the throttle as that."""
CRITICAL = mavlink.MAV_SEVERITY_CRITICAL


class Px4Flavour(AutopilotFlavour):
    """PX4 1.15 on one multicopter."""

    firmware = FIRMWARE

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        super().__init__(aircraft, parameters)
        self.intention = FlightMode.HOLD
        """The mode that the operator chose."""
        self._reaction: FlightMode | None = None
        """The mode that a failsafe puts in its place."""
        self._failsafes = Px4Failsafes(aircraft, parameters)
        self._limits_revision = -1

    @property
    def mode(self) -> FlightMode:
        """The mode that is flown."""
        return self.intention if self._reaction is None else self._reaction

    @property
    def is_failsafe(self) -> bool:
        """True if a failsafe chose the mode."""
        return self.is_armed and self._reaction is not None

    @property
    def reason(self) -> str:
        """Reason of the acting failsafe."""
        worst = self._failsafes.worst
        return "" if worst is None else worst[0].text

    @property
    def task(self) -> Task:
        """Task of the flight controller in this mode and state."""
        needs_position = self.mode not in STICK_MODES
        if needs_position and not self.aircraft.estimator.is_position_valid:
            return Task.DESCEND
        return TASKS.get(self.mode, Task.FLY_BY_STICKS)

    def arming_refusal(self, now_s: float) -> str | None:
        """Return the reason why it could not be armed now, or None."""
        refusal = self._check_refusal(now_s)
        if refusal is not None or self.mode in (FlightMode.HOLD, FlightMode.TAKEOFF):
            return refusal
        if self.mode is FlightMode.OFFBOARD:
            return None if self._is_stream_alive(now_s) else "no offboard setpoints"
        if self.mode in STICK_MODES:
            return self._choice_refusal(self.mode, now_s)
        return f"{name_of(self.mode)} mode cannot be armed in"

    def _throttle_refusal(self, now_s: float) -> str | None:
        """Return the reason why the throttle alone keeps it from being armed, or None.

        Source: PX4 1.16 `Commander::arm` and `Commander::manualControlCheck`.
        """
        sticks = self.aircraft.sticks.read(now_s)
        if sticks is None or self.mode not in STICK_MODES:
            return None
        if self.mode in (FlightMode.POSITION, FlightMode.ALTITUDE):
            return "throttle above center" if sticks.up > THROTTLE_ABOVE_CENTRE else None
        return None if sticks.up < THROTTLE_LOW else "high throttle"

    def _is_stream_alive(self, now_s: float) -> bool:
        return self.setpoints.is_alive(now_s, self.parameters["COM_OF_LOSS_T"])

    def _check_refusal(self, now_s: float) -> str | None:
        if now_s < self.aircraft.scenario.autopilot.ready_after_s:
            return "system is booting"
        if not self.aircraft.estimator.is_position_valid:
            return "no position estimate"
        if self.aircraft.battery.share <= self.parameters["BAT_CRIT_THR"]:
            return "battery too low"
        has_action = self.parameters["GF_ACTION"] >= 1
        if has_action and self.fence_margin_m(self.aircraft.motion.position_enu_m) < 0.0:
            return "outside the geofence"
        return None

    def fence_margin_m(self, position: PositionEnu) -> float:
        """Return the distance from a position to the nearest fence breach, negative in one."""
        margin = self.aircraft.fence.margin_m(position)
        home = self.aircraft.home_enu_m
        horizontal_m = self.parameters["GF_MAX_HOR_DIST"]
        vertical_m = self.parameters["GF_MAX_VER_DIST"]
        if horizontal_m > 0.0:
            margin = min(margin, horizontal_m - math.dist(position[:2], home[:2]))
        if vertical_m > 0.0:
            margin = min(margin, vertical_m - (position[2] - home[2]))
        return margin

    def fence_state(self, position: PositionEnu) -> FenceState:
        """Return the fence's state; it is present once uploaded, or a distance is set."""
        value = self.parameters
        has_limits = value["GF_MAX_HOR_DIST"] > 0.0 or value["GF_MAX_VER_DIST"] > 0.0
        is_present = has_limits or not self.aircraft.fence.is_empty
        is_enabled = is_present and value["GF_ACTION"] > 0
        return FenceState(is_present, is_enabled, self.fence_margin_m(position) < 0.0)

    def _choice_refusal(self, mode: FlightMode, now_s: float) -> str | None:
        """Return the reason why an armed vehicle would refuse a mode now, or None."""
        if mode is FlightMode.OFFBOARD and not self._is_stream_alive(now_s):
            return "no setpoints"
        if mode is FlightMode.MISSION and not self.aircraft.mission.has_items:
            return "no mission"
        if mode in STICK_MODES and self.aircraft.sticks.read(now_s) is None:
            return "no manual control"
        return None

    def choose(self, mode: FlightMode | None, now_s: float) -> int:
        """Apply the operator's choice of a mode (None: unknown mode); return a MAV_RESULT."""
        if mode in (None, FlightMode.READY, FlightMode.UNKNOWN):
            return DENIED
        assert mode is not None
        why = self._choice_refusal(mode, now_s) if self.is_armed else None
        if why is not None:
            self.refuse(mode, why)
            return TEMPORARILY_REJECTED
        is_same = mode is self.mode
        self.intention, self._reaction = mode, None
        self._failsafes.take_over()
        if is_same and mode is FlightMode.HOLD:
            self.aircraft.controller.enter(self.task, self.aircraft.motion)
        return ACCEPTED

    def pilot_chooses(self, mode: FlightMode, now_s: float) -> None:
        """Handle the pilot's mode switch."""
        self.choose(mode, now_s)
        self.settle(now_s, "pilot")

    def refuse(self, mode: FlightMode, why: str) -> None:
        """Send a text with the reason why a mode was not entered."""
        self.aircraft.notify(CRITICAL, f"Switching to {name_of(mode)} not available: {why}")

    def arm(self, now_s: float) -> int:
        """Arm on request, forced or not; return a MAV_RESULT, and send the reason of a refusal."""
        why = self.arming_refusal(now_s) or self._throttle_refusal(now_s)
        if not self.is_armed and why is not None:
            self.send_rejection("Arming denied", why)
            return TEMPORARILY_REJECTED
        self.aircraft.is_armed = True
        return ACCEPTED

    def disarm(self, *, is_forced: bool) -> int:
        """Handle a request to disarm; return a MAV_RESULT, and the reason as a text if refused."""
        if self.is_armed:
            if not (self.aircraft.body.is_on_ground or is_forced):
                self.aircraft.notify(CRITICAL, "Disarming denied: not landed")
                return TEMPORARILY_REJECTED
            if self.is_failsafe or self.mode in ENDED_BY_DISARMING:
                self.intention = FlightMode.HOLD
            self._reaction = None
            self.aircraft.is_armed = False
        self._failsafes.clear()
        return ACCEPTED

    def take_setpoint(self, message: TargetMessage, now_s: float) -> None:
        """Keep a valid setpoint in any mode."""
        is_flown = self.is_armed and self.mode is FlightMode.OFFBOARD
        self.setpoints.take(setpoint_from(message, self.aircraft), now_s, is_flown=is_flown)

    @property
    def flown_setpoint(self) -> Setpoint:
        """The newest valid setpoint."""
        return self.setpoints.setpoint

    def echo(self) -> Echo | None:
        """Return the target of the position controller; None in modes without a target."""
        if not self.is_armed or self.mode in WITHOUT_POSITION_CONTROL:
            return None
        controller, setpoint = self.aircraft.controller, self.setpoints.setpoint
        position: Axes = NOTHING if controller.goal_enu_m is None else controller.goal_enu_m
        yaw, yaw_rate = controller.hold_yaw_ned_rad, 0.0
        if self.task is Task.FOLLOW:
            position = (*(setpoint.position_en_m or (None, None)), setpoint.up_m)
            yaw, yaw_rate = setpoint.yaw_ned_rad, setpoint.yaw_rate_ned_radps or 0.0
        return Echo(
            position,
            controller.wanted_enu_mps,
            self.aircraft.body.acceleration_enu_mps2,
            self.aircraft.heading_ned_rad if yaw is None else yaw,
            yaw_rate,
            unused=math.nan,
        )

    def disarm_delay_s(self) -> float | None:
        """Return the delay after a landing, s; None in OFFBOARD, which never disarms by itself."""
        if self.mode is FlightMode.OFFBOARD and self.aircraft.has_flown:
            return None
        is_landing = self.mode in (FlightMode.LAND, FlightMode.RETURN)
        landed = self.aircraft.has_flown or is_landing
        delay_s = self.parameters["COM_DISARM_LAND" if landed else "COM_DISARM_PRFLT"]
        is_enabled = delay_s >= 0.0 if landed else delay_s > 0.0
        return delay_s if is_enabled else None

    def _after_flying(self, now_s: float) -> None:
        if not self.is_armed:
            return
        if self.mode is FlightMode.TAKEOFF:
            if self.aircraft.controller.has_taken_off(self.aircraft.motion):
                self.intention = FlightMode.HOLD
                self.settle(now_s, "takeoff complete")
        elif self.mode is FlightMode.MISSION:
            if self._is_mission_over or not self.aircraft.mission.has_items:
                self.intention = FlightMode.HOLD
                self.settle(now_s, "mission complete")
            elif self.leg is not None and self.leg.kind is LegKind.RETURN:
                self.aircraft.mission.finish_leg()
                self.leg = None
                self.choose(FlightMode.RETURN, now_s)
                self.settle(now_s, "mission")

    def _watch(self, now_s: float) -> None:
        self._failsafes.warn_of_battery()
        if self.parameters.revision != self._limits_revision:
            self._limits_revision = self.parameters.revision
            self.aircraft.controller.limits = speed_limits(self.parameters)
        if not self.is_armed:
            return
        sticks = self.aircraft.sticks.read(now_s)
        if sticks is not None and sticks.deflection > MOVED and self._sticks_override():
            self.choose(FlightMode.POSITION, now_s)
            self.settle(now_s, "sticks moved")
        fresh = self._failsafes.watch(
            self.intention,
            self.fence_margin_m(self.aircraft.motion.position_enu_m),
            now_s,
            is_stream_alive=self._is_stream_alive(now_s),
        )
        for cause in fresh:
            self.aircraft.notify(CRITICAL, f"Failsafe: {cause.text}")
            delay_s = self._failsafes.delay_s
            wait = f", entering Hold for {delay_s:.0f} seconds" if delay_s > 0.0 else ""
            # The tab marks that an EVENT has the same content.
            self.aircraft.notify(CRITICAL, f"Failsafe activated{wait}\t")
        reaction = self._failsafes.flown
        if reaction is Reaction.DISARM:
            self.disarm(is_forced=True)
        else:
            self._reaction = None if reaction is None else reaction.mode

    def settle(self, now_s: float, why: str = "") -> None:
        """Settle as the base does, with the height of a return known before it begins."""
        if self.mode is FlightMode.RETURN:
            height_m = self.parameters["RTL_RETURN_ALT"]
            self.aircraft.controller.return_up_m = self.aircraft.home_enu_m[2] + height_m
        super().settle(now_s, why)

    def _sticks_override(self) -> bool:
        """Return True if moved sticks end the mode; a failsafe that waits in Hold ignores them."""
        if self._failsafes.delay_s > 0.0:
            return False
        bits = int(self.parameters["COM_RC_OVERRIDE"])
        if self.intention is FlightMode.OFFBOARD:
            return bool(bits & OVERRIDE_OFFBOARD)
        return self.mode not in STICK_MODES and bool(bits & OVERRIDE_AUTO)

    def heartbeat_state(self, now_s: float) -> HeartbeatState:
        """Return the HEARTBEAT state; disarmed, without a stream, OFFBOARD has one flag only."""
        base_mode = CUSTOM_MODE_ENABLED
        if self.mode is not FlightMode.OFFBOARD:
            base_mode |= BASE_MODE_FLAGS.get(self.mode, AUTO_FLAGS)
        elif self.is_armed or self._is_stream_alive(now_s):
            base_mode |= mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        status = mavlink.MAV_STATE_UNINIT
        if self.is_armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            status = mavlink.MAV_STATE_CRITICAL if self.is_failsafe else mavlink.MAV_STATE_ACTIVE
        elif self.arming_refusal(now_s) is None:
            status = mavlink.MAV_STATE_STANDBY
        return HeartbeatState(base_mode, px4_custom_mode(self.mode), status)


def name_of(mode: FlightMode) -> str:
    """Return the name in PX4 and QGroundControl."""
    return mode.name.capitalize()
