"""ArduCopter on one aircraft: modes, arming, GUIDED, failsafes and HEARTBEAT.

A failsafe of ArduPilot changes the mode like an operator would, and nothing changes it back.

Source: ArduCopter 4.5 as observed in SITL; ArduPilot documentation, "Failsafe Functions".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.domain import FlightMode, PositionEnu
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import OFFBOARD_NUMBER
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.ardupilot.control import (
    FENCE,
    CopterFailsafes,
    FailsafeEvent,
    Guided,
    GuidedState,
    target_from,
)
from sim_link.autopilot.ardupilot.firmware_profile import (
    AUTO,
    CLIMB,
    DESCENT,
    FIRMWARE,
    GUIDED,
    HORIZONTAL,
    IGNORES_LOCAL_SETPOINTS,
    LAND,
    MODE_BY_PURPOSE,
    RTL,
    STABILIZE,
    CopterMode,
    available_modes,
    shown_number,
)
from sim_link.autopilot.control_inputs import (
    THROTTLE_DOWN,
    AttitudeTarget,
    Echo,
    Setpoint,
    TargetMessage,
)
from sim_link.autopilot.flavour import (
    ACCEPTED,
    FAILED,
    AutopilotFlavour,
    FenceState,
    HeartbeatState,
)
from sim_link.autopilot.flight_controller import SpeedLimits, Task
from sim_link.autopilot.mission_executor import LegKind
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.world.point_mass import stopping_point

ALTITUDE_MAX, CIRCLE, POLYGON = 1, 2, 4
LANDED_DELAY_S = 1.0
"""LAND and RTL disarm this long after a touchdown."""
THROTTLE_DEAD_ZONE = 0.06
"""RC3_DZ, 30 us of 500."""
IDLE_DETECTION_S = 0.5
"""ArduCopter takes this much longer than DISARM_DELAY."""
MIN_SPEED_CMPS, MIN_TIMEOUT_S = 10.0, 0.1
"""Lowest effective values of the speed parameters (WPNAV_SPEED and others) and GUID_TIMEOUT."""
ATTITUDE_SHARE = 0.5
"""Share of the boot after which modes without a position can be armed."""
CRITICAL, WARNING = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_WARNING
INFO = mavlink.MAV_SEVERITY_INFO


class ArduPilotFlavour(AutopilotFlavour):
    """ArduCopter 4.5 on one aircraft."""

    firmware = FIRMWARE

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        super().__init__(aircraft, parameters)
        self.guided = Guided()
        self.copter_mode: CopterMode = STABILIZE
        self.chosen_number: int | None = None
        """The last requested mode, where its class or a script numbers it otherwise."""
        self.commanded_mps: dict[int, float] = {}
        """Commanded speeds by SPEED_TYPE, until the mode changes."""
        self._failsafes = CopterFailsafes(aircraft, parameters)
        if aircraft.sticks.resting is None:
            aircraft.sticks.resting = THROTTLE_DOWN  # SITL's RC3 is 1000

    @property
    def mode(self) -> FlightMode:
        """The mode that is flown."""
        return self.copter_mode.mode

    @property
    def is_failsafe(self) -> bool:
        """True if a failsafe is active on the armed vehicle."""
        return bool(self._failsafes.active) and self.is_armed

    @property
    def reason(self) -> str:
        """Names of the active failsafes."""
        return ", ".join(sorted(self._failsafes.active))

    @property
    def task(self) -> Task:
        """Task of the flight controller in this mode and state."""
        mode = self.copter_mode
        if not self.aircraft.estimator.is_position_valid and mode.task is not Task.FLY_BY_STICKS:
            return Task.DESCEND
        if mode is GUIDED:
            return self.guided.task
        if mode is AUTO:
            is_returning = self.leg is not None and self.leg.kind is LegKind.RETURN
            return Task.RETURN if is_returning else Task.FLY_MISSION
        return mode.task

    @property
    def available_modes(self) -> Sequence[Message]:
        """Empty, as of ArduCopter 4.5, unless a script registered another mode."""
        is_scripted = self.aircraft.scenario.autopilot.offers_offboard
        return available_modes() if is_scripted else ()

    def has_home(self, now_s: float) -> bool:
        """Return True once origin and home are known, before it can be armed in GUIDED."""
        return now_s >= ATTITUDE_SHARE * self.aircraft.scenario.autopilot.ready_after_s

    def has_position(self, now_s: float) -> bool:
        """Return True if the position is reported: not before the estimator has settled."""
        is_settled = now_s >= self.aircraft.scenario.autopilot.ready_after_s
        return is_settled and self.aircraft.estimator.is_position_valid

    def arming_refusal(self, now_s: float) -> str | None:
        """Return the reason why it could not be armed in the current mode, or None."""
        if not self.copter_mode.is_armable:
            return f"{self.copter_mode.name} mode not armable"
        if not self.has_home(now_s):
            return "AHRS: waiting for home"
        if self.copter_mode.needs_position and not self.has_position(now_s):
            return "Need Position Estimate"
        if self.fence_margin_m(self.aircraft.motion.position_enu_m) < 0.0:
            return "vehicle outside fence"
        return None

    def _throttle_refusal(self, now_s: float) -> str | None:
        """Return the reason why a held throttle prevents arming, or None; at rest it is down.

        Source: ArduPilot `AP_Arming::rc_arm_checks` (4.5), with RC_OPTIONS as by default.
        """
        sticks = self.aircraft.sticks.held(now_s)
        is_down = sticks is None or sticks.up <= -1.0 + THROTTLE_DEAD_ZONE
        return None if is_down else "Throttle (RC3) is not neutral"

    def fence_margin_m(self, position: PositionEnu) -> float:
        """Return the distance to the nearest breach, negative in one, infinite while it is off."""
        value, home = self.parameters, self.aircraft.home_enu_m
        parts = int(value["FENCE_TYPE"]) if value["FENCE_ENABLE"] else 0
        margin = math.inf
        if parts & ALTITUDE_MAX:
            margin = min(margin, value["FENCE_ALT_MAX"] - (position[2] - home[2]))
        if parts & CIRCLE:
            margin = min(margin, value["FENCE_RADIUS"] - math.dist(position[:2], home[:2]))
        if parts & POLYGON:
            margin = min(margin, self.aircraft.fence.margin_m(position))
        return margin

    def fence_state(self, position: PositionEnu) -> FenceState:
        """Return the fence's state: FENCE_TYPE has its parts, FENCE_ENABLE activates them.

        One that only reports is not enabled in SYS_STATUS. Source: ArduPilot `AC_Fence`.
        """
        parts = int(self.parameters["FENCE_TYPE"])
        has_areas = bool(parts & POLYGON) and not self.aircraft.fence.is_empty
        is_present = has_areas or bool(parts & ~POLYGON)
        value = self.parameters
        is_enabled = is_present and bool(value["FENCE_ENABLE"]) and bool(value["FENCE_ACTION"])
        return FenceState(is_present, is_enabled, self.fence_margin_m(position) < 0.0)

    def choose(self, mode: CopterMode, now_s: float) -> int:
        """Change the mode; return a MAV_RESULT, and send the reason as a text if refused."""
        why = self._mode_refusal(mode, now_s)
        if why is not None:
            self.aircraft.notify(WARNING, f"Mode change to {mode.name} failed: {why}")
            return FAILED
        self.chosen_number = None
        if mode is not self.copter_mode:
            self.guided = Guided()
            self.changes += mode.mode is self.copter_mode.mode  # any other is noted by `settle`
            self.copter_mode = mode
            self.commanded_mps.clear()
            self.leg = None
        return ACCEPTED

    def pilot_chooses(self, mode: FlightMode, now_s: float) -> None:
        """Handle the pilot's mode switch; modes unknown to ArduPilot change nothing."""
        wanted = MODE_BY_PURPOSE.get(mode)
        if wanted is not None:
            self.choose(wanted, now_s)
            self.settle(now_s, "pilot")

    def _mode_refusal(self, mode: CopterMode, now_s: float) -> str | None:
        """Return the reason to refuse a mode; None also while disarmed, as arming checks follow."""
        if not self.is_armed:
            return None
        if mode.needs_position and not self.has_position(now_s):
            return "requires position"
        mission = self.aircraft.mission
        if mode is AUTO:
            if not mission.has_items:
                return "init failed"
            first = mission.items[max(mission.current, 1)].command
            if self.aircraft.body.is_on_ground and first != mavlink.MAV_CMD_NAV_TAKEOFF:
                return "missing takeoff cmd"
        return None

    def arm(self, now_s: float, *, is_forced: bool) -> int:
        """Handle a request to arm; return a MAV_RESULT, and the reason as a text if refused."""
        if self.is_armed:
            return ACCEPTED
        why = self.arming_refusal(now_s) or self._throttle_refusal(now_s)
        if why is not None and not (is_forced and self.copter_mode.is_armable):
            self.send_rejection("Arm", why)
            return FAILED
        self.aircraft.is_armed = True
        self.guided.stop()
        self.aircraft.notify(INFO, "Arming motors")
        return ACCEPTED

    def disarm(self, *, is_forced: bool) -> int:
        """Handle a request to disarm; return a MAV_RESULT."""
        if not self.is_armed:
            return ACCEPTED
        if not self.aircraft.body.is_on_ground and not is_forced:
            return FAILED
        self.aircraft.is_armed = False
        self._failsafes.clear()
        self.guided.stop()
        self.aircraft.notify(INFO, "Disarming motors")
        return ACCEPTED

    def take_setpoint(self, message: TargetMessage, now_s: float) -> None:
        """Take a setpoint, in GUIDED only, and ignore it outside the fence, as ArduCopter does.

        GUIDED's angles (SET_ATTITUDE_TARGET) are not simulated: nothing moves.
        """
        is_deaf = self.aircraft.scenario.autopilot.vehicle_type in IGNORES_LOCAL_SETPOINTS
        if is_deaf or isinstance(message, AttitudeTarget):
            return
        target = target_from(message, self.aircraft)
        is_flown = self.copter_mode is GUIDED and self.is_armed
        self.setpoints.take(None if target is None else target.setpoint, now_s, is_flown=is_flown)
        if target is None or not is_flown:
            return
        if target.text:
            self.aircraft.notify(WARNING, target.text)
        setpoint = target.setpoint or Setpoint()
        position, up_m = setpoint.position_en_m, setpoint.up_m
        if (
            position is not None
            and up_m is not None
            and self.fence_margin_m((*position, up_m)) < 0.0
        ):
            return
        self.guided.take(target, now_s, is_on_ground=self.aircraft.body.is_on_ground)
        self.settle(now_s)

    def echo(self) -> Echo | None:
        """Return the target of GUIDED; None in any other mode."""
        if self.copter_mode is not GUIDED:
            return None
        return self.guided.echo(self.aircraft.controller.goal_enu_m)

    @property
    def flown_setpoint(self) -> Setpoint:
        """GUIDED's target; `_watch` lets it age."""
        return self.guided.setpoint

    def disarm_delay_s(self) -> float | None:
        """Return a second after LAND and RTL, else DISARM_DELAY; None while it takes off."""
        if self.task is Task.TAKE_OFF:
            return None
        is_landing = self.copter_mode in (LAND, RTL) or self._is_mission_over
        if is_landing or (self.copter_mode is AUTO and self.task is Task.RETURN):
            return LANDED_DELAY_S
        if self.copter_mode is AUTO:
            return None
        delay_s = self.parameters["DISARM_DELAY"]
        return delay_s + IDLE_DETECTION_S if delay_s > 0.0 else None

    def settle(self, now_s: float, why: str = "") -> None:
        """Settle as the base does, with the heights of a return known before it begins."""
        if self.task is Task.CIRCLE:
            self.aircraft.controller.circle_radius_m = self.parameters["CIRCLE_RADIUS"] / 100.0
            rate_radps = math.radians(self.parameters["CIRCLE_RATE"])
            self.aircraft.controller.circle_rate_radps = rate_radps
        if self.task is Task.RETURN:
            controller, home_up_m = self.aircraft.controller, self.aircraft.home_enu_m[2]
            final_m = self.parameters["RTL_ALT_FINAL"] / 100.0
            controller.return_up_m = home_up_m + self.parameters["RTL_ALT"] / 100.0
            controller.final_up_m = home_up_m + final_m if final_m > 0.0 else None
            controller.return_loiter_s = self.parameters["RTL_LOIT_TIME"] / 1e3
        super().settle(now_s, why)

    def _after_flying(self, now_s: float) -> None:
        is_climbing = self.guided.state is GuidedState.CLIMBING and self.is_armed
        if is_climbing and self.aircraft.controller.has_taken_off(self.aircraft.motion):
            self.guided.stop()
            self.settle(now_s)

    def _watch(self, now_s: float) -> None:
        override_s = self.parameters["RC_OVERRIDE_TIME"]
        self.aircraft.sticks.joystick_timeout_s = override_s if override_s >= 0.0 else math.inf
        body = self.aircraft.motion
        timeout_s = max(MIN_TIMEOUT_S, self.parameters["GUID_TIMEOUT"])
        self.guided.watch(now_s, timeout_s, is_on_ground=body.is_on_ground)
        value, commanded_mps = self.parameters, self.commanded_mps
        home_cmps = value["RTL_SPEED"] if self.task is Task.RETURN else 0.0
        across_cmps = home_cmps or value["WPNAV_SPEED"]
        self.aircraft.controller.limits = SpeedLimits(
            commanded_mps.get(HORIZONTAL, max(MIN_SPEED_CMPS, across_cmps) / 100.0),
            commanded_mps.get(CLIMB, max(MIN_SPEED_CMPS, value["WPNAV_SPEED_UP"]) / 100.0),
            commanded_mps.get(DESCENT, max(MIN_SPEED_CMPS, value["WPNAV_SPEED_DN"]) / 100.0),
        )
        if not self.is_armed:
            return
        if self.guided.state is GuidedState.FOLLOWING and self._runs_into_the_fence():
            self.guided.stop()
        margin_m = self.fence_margin_m(body.position_enu_m)
        for event in self._failsafes.watch(self.copter_mode, margin_m, now_s):
            self._react(event, now_s)

    def _react(self, event: FailsafeEvent, now_s: float) -> None:
        """Announce the event; on entering a failsafe, change the mode once."""
        self.aircraft.notify(CRITICAL, event.text)
        if event.stops_motors:
            self.disarm(is_forced=True)
        if event.reaction is None or self.aircraft.body.is_on_ground:
            return
        if self.choose(event.reaction, now_s) != ACCEPTED:
            self.choose(LAND, now_s)
        if event.names_mode:
            self.aircraft.notify(CRITICAL, f"{event.text}: changed to {self.copter_mode.name} Mode")

    def _runs_into_the_fence(self) -> bool:
        """Return True if the motion leads out of the fence: it is stopped FENCE_MARGIN inside."""
        if not self.parameters["FENCE_ENABLE"] or self.guided.is_latched:
            return False
        body, setpoint = self.aircraft.motion, self.guided.setpoint
        position = body.position_enu_m
        rest = stopping_point(position, body.velocity_enu_mps, self.aircraft.scenario.vehicle)
        if self.fence_margin_m(rest) >= self.parameters["FENCE_MARGIN"]:
            return False
        east, north = setpoint.velocity_en_mps or (0.0, 0.0)
        wanted = (east, north, setpoint.climb_mps or 0.0)
        if setpoint.velocity_en_mps is None:
            wanted = setpoint.acceleration_enu_mps2 or wanted
        ahead = (position[0] + wanted[0], position[1] + wanted[1], position[2] + wanted[2])
        return self.fence_margin_m(ahead) < self.fence_margin_m(position)

    def heartbeat_state(self, now_s: float) -> HeartbeatState:  # noqa: ARG002  the base gives the time
        """Return the state for HEARTBEAT: on the ground STANDBY, also when armed."""
        base_mode = self.copter_mode.flags | (
            mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.is_armed else 0
        )
        status = mavlink.MAV_STATE_STANDBY
        if self.is_armed and self._failsafes.active - {FENCE}:  # a breach is in SYS_STATUS only
            status = mavlink.MAV_STATE_CRITICAL
        elif self.is_armed and not self.aircraft.body.is_on_ground:
            status = mavlink.MAV_STATE_ACTIVE
        kind = self.aircraft.scenario.autopilot.vehicle_type
        number = self.chosen_number
        if number != OFFBOARD_NUMBER:
            number = shown_number(kind, self.copter_mode.number, number)
        return HeartbeatState(base_mode, number, status)
