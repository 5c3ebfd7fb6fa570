"""Control of ArduCopter from outside and its end: GUIDED, and failsafes.

GUIDED of ArduCopter: the meaning and effect of each target message.

A take-off has precedence, positions are latched indefinitely, motions time out silently. A position
with a velocity runs on by it until the time-out, and is latched where it is then.

One ignored axis ignores its whole group. Accepted are position, velocity, acceleration, position
with velocity (and acceleration), velocity with acceleration, each with or without yaw or yaw rate;
a force is ignored; anything else stops the vehicle, and so does a frame that is not known. As the
real one this flies to 0/0, to any height, and without terrain data down to the ground. That may end
on a NaN position: here it is refused, and a text says so.

Source: ArduPilot documentation, "Copter Commands in Guided Mode"; ArduCopter 4.5 as observed in
SITL; parameter GUID_TIMEOUT.

ArduCopter's failsafes: the fault, its beginning, and the requested mode.

A failsafe changes the mode once, on entering, and nothing changes it back.

Source: ArduPilot documentation, "Failsafe Functions", "EKF Failsafe", "Simple GeoFence";
`ArduCopter/ekf_check.cpp`; parameters FS_THR_ENABLE, FS_GCS_ENABLE, FS_OPTIONS, FS_EKF_ACTION,
BATT_FS_LOW_ACT, FENCE_ACTION.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

from companion.domain import PositionEnu
from companion.geometry.coordinates import enu_from_ned, wrap_pi
from companion.mav import dialect
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import CELLS, Aircraft
from sim_link.autopilot.ardupilot.firmware_profile import (
    ALT_HOLD,
    BRAKE,
    GUIDED,
    LAND,
    RTL,
    SMART_RTL,
    CopterMode,
)
from sim_link.autopilot.control_inputs import (
    NOTHING,
    Axes,
    Echo,
    GlobalTarget,
    LocalTarget,
    PositionTarget,
    Setpoint,
    enu_of,
    is_on_earth,
    turned,
)
from sim_link.autopilot.flight_controller import STEP_S, Task
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.autopilot.protocols.plan_items import GLOBAL_FRAMES

LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
LOCAL_OFFSET_NED = mavlink.MAV_FRAME_LOCAL_OFFSET_NED
BODY_NED = mavlink.MAV_FRAME_BODY_NED
BODY_OFFSET_NED = mavlink.MAV_FRAME_BODY_OFFSET_NED
LOCAL_FRAMES = (LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
UNLIMITED_HEIGHT_M = 1e9
"""Height beyond any flight, for an infinite one."""
BODY_FRAMES = (BODY_NED, BODY_OFFSET_NED)
TERRAIN_FRAMES = (mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT)


class Target(NamedTuple):
    """Target of GUIDED that a message sets, or its refusal."""

    setpoint: Setpoint | None
    """Position, held indefinitely once its velocity has timed out, or a motion, which times out
    after GUID_TIMEOUT. None: stop."""
    text: str = ""
    """Text for the operators about a refusal."""


def _refused(why: str) -> Target:
    return Target(None, f"Guided: {why}, stopping")


def target_from_local(message: LocalTarget, aircraft: Aircraft) -> Target:
    """Decode SET_POSITION_TARGET_LOCAL_NED."""
    frame = message.coordinate_frame
    if frame not in LOCAL_FRAMES:
        return _refused(f"frame {frame} not supported")
    position: PositionEnu | None = None
    if not message.type_mask & dialect.POSITION_IGNORE:
        if not (math.isfinite(message.x) and math.isfinite(message.y)) or math.isnan(message.z):
            return _refused("position is not a number")
        position = _local_position(message, aircraft)
    return _target(message, position, aircraft.heading_ned_rad if frame in BODY_FRAMES else None)


def _local_position(message: LocalTarget, aircraft: Aircraft) -> PositionEnu:
    """Return the position; any frame but LOCAL_NED is an offset from the vehicle."""
    z = max(-UNLIMITED_HEIGHT_M, min(UNLIMITED_HEIGHT_M, message.z))
    if message.coordinate_frame == LOCAL_NED:
        return aircraft.estimator.world_from_local(enu_from_ned((message.x, message.y, z)))
    own_east, own_north, own_up = aircraft.motion.position_enu_m
    east, north = float(message.y), float(message.x)
    if message.coordinate_frame in BODY_FRAMES:
        east, north = turned(message.x, message.y, aircraft.heading_ned_rad)
    return (own_east + east, own_north + north, own_up - z)


def target_from_global(message: GlobalTarget, aircraft: Aircraft) -> Target:
    """Decode SET_POSITION_TARGET_GLOBAL_INT."""
    frame = message.coordinate_frame
    if message.type_mask & dialect.POSITION_IGNORE:
        return _target(message, None, None)
    if frame not in (*GLOBAL_FRAMES, *TERRAIN_FRAMES):
        return _refused(f"frame {frame} not supported")
    if not is_on_earth(message.lat_int, message.lon_int):
        return _refused("latitude or longitude invalid")
    if not math.isfinite(message.alt):
        return _refused("altitude is not finite")
    altitude_m = message.alt
    if frame in TERRAIN_FRAMES:  # without terrain data it goes for the ground
        frame, altitude_m = mavlink.MAV_FRAME_GLOBAL, aircraft.estimator.world_origin.altitude_m
    position = aircraft.position_from(message.lat_int, message.lon_int, altitude_m, frame)
    return _target(message, position, None)


def target_from(message: PositionTarget, aircraft: Aircraft) -> Target | None:
    """Decode a position target; None: a force, which is ignored."""
    if (
        message.type_mask & dialect.FORCE_SET
        and not message.type_mask & dialect.ACCELERATION_IGNORE
    ):
        return None
    if isinstance(message, LocalTarget):
        return target_from_local(message, aircraft)
    return target_from_global(message, aircraft)


def _target(
    message: PositionTarget, position: PositionEnu | None, body_yaw_rad: float | None
) -> Target:
    """Return the target at a position (None: none), its vectors about a heading (None: north)."""
    mask = message.type_mask
    has_velocity = not mask & dialect.VELOCITY_IGNORE
    has_acceleration = not mask & dialect.ACCELERATION_IGNORE
    yaw = None if mask & dialect.YAW_IGNORE else float(message.yaw)
    yaw_rate = None if mask & dialect.YAW_RATE_IGNORE else float(message.yaw_rate)
    given = [yaw or 0.0, yaw_rate or 0.0]
    given += (message.vx, message.vy, message.vz) if has_velocity else ()
    given += (message.afx, message.afy, message.afz) if has_acceleration else ()
    is_understood = has_velocity or (position is not None) is not has_acceleration
    if not is_understood or not all(map(math.isfinite, given)):
        return Target(None)
    if yaw is not None:
        yaw = wrap_pi(yaw if body_yaw_rad is None else yaw + body_yaw_rad)
    east, north, climb_mps = enu_of(message.vx, message.vy, message.vz, body_yaw_rad)
    acceleration = enu_of(message.afx, message.afy, message.afz, body_yaw_rad)
    setpoint = Setpoint(
        position_en_m=None if position is None else position[:2],
        up_m=None if position is None else position[2],
        velocity_en_mps=(east, north) if has_velocity else None,
        climb_mps=climb_mps if has_velocity else None,
        acceleration_enu_mps2=acceleration if has_acceleration else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )
    return Target(setpoint)


def _run_on(setpoint: Setpoint, dt_s: float) -> Setpoint:
    """Return a position target moved on by its velocity; others unchanged."""
    position, velocity, up_m = setpoint.position_en_m, setpoint.velocity_en_mps, setpoint.up_m
    if position is None or velocity is None or up_m is None:
        return setpoint
    moved = (position[0] + velocity[0] * dt_s, position[1] + velocity[1] * dt_s)
    up_m += (setpoint.climb_mps or 0.0) * dt_s
    return replace(setpoint, position_en_m=moved, up_m=up_m)


STILL: PositionEnu = (0.0, 0.0, 0.0)


class GuidedState(Enum):
    """States of GUIDED."""

    IDLE = "idle"
    """Stays in place, in the air or on the ground."""
    CLIMBING = "climbing"
    FOLLOWING = "following"


class Guided:
    """The state of GUIDED; it is reset whenever the mode is entered."""

    def __init__(self) -> None:
        self.state = GuidedState.IDLE
        self.setpoint = Setpoint()
        self.is_paused = False
        """True while it stays in place and keeps its target, by MAV_CMD_DO_PAUSE_CONTINUE."""
        self._taken_s = 0.0

    @property
    def task(self) -> Task:
        """Task of the flight controller in this state."""
        if self.is_paused:
            return Task.STAY
        match self.state:
            case GuidedState.CLIMBING:
                return Task.TAKE_OFF
            case GuidedState.FOLLOWING:
                return Task.FOLLOW
        return Task.STAY

    @property
    def is_latched(self) -> bool:
        """True if it flies to a position and stays there indefinitely."""
        is_following = self.state is GuidedState.FOLLOWING
        return is_following and self.setpoint.position_en_m is not None and not self._is_moving

    def echo(self, climb_goal_enu_m: PositionEnu | None) -> Echo:
        """Return the target for POSITION_TARGET_*: a position, or a motion, 0 while it stays."""
        if self.state is GuidedState.CLIMBING and climb_goal_enu_m is not None:
            return Echo(climb_goal_enu_m)
        if self.state is not GuidedState.FOLLOWING:
            return Echo(NOTHING, STILL, STILL)
        setpoint = self.setpoint
        position: Axes = (*(setpoint.position_en_m or (None, None)), setpoint.up_m)
        if setpoint.velocity_en_mps is None:
            return Echo(position, NOTHING, setpoint.acceleration_enu_mps2 or NOTHING)
        velocity = (*setpoint.velocity_en_mps, setpoint.climb_mps or 0.0)
        return Echo(position, velocity, setpoint.acceleration_enu_mps2 or STILL)

    def stop(self) -> None:
        """Stay in place until something is commanded, as when the mode begins."""
        self.state = GuidedState.IDLE
        self.setpoint = Setpoint()

    def turn_to(self, yaw_ned_rad: float) -> None:
        """Set another heading."""
        self.setpoint = replace(self.setpoint, yaw_ned_rad=yaw_ned_rad, yaw_rate_ned_radps=None)

    def take_off(self) -> None:
        """Climb until the height is reached or a target takes over."""
        self.state = GuidedState.CLIMBING
        self.setpoint = Setpoint()

    def take(self, target: Target, now_s: float, *, is_on_ground: bool) -> None:
        """Take a target; it has no effect on the ground, because a take-off comes first."""
        if is_on_ground:
            return
        if target.setpoint is None:
            self.stop()
            return
        self.state = GuidedState.FOLLOWING
        self.setpoint = target.setpoint
        self._taken_s = now_s

    def watch(self, now_s: float, timeout_s: float, *, is_on_ground: bool) -> None:
        """Let a motion time out, and a target end on the ground."""
        if self.state is not GuidedState.FOLLOWING:
            return
        is_old, setpoint = now_s - self._taken_s >= timeout_s, self.setpoint
        if is_on_ground or (is_old and setpoint.position_en_m is None):
            self.stop()
        elif is_old:
            self.setpoint = Setpoint(
                setpoint.position_en_m, setpoint.up_m, yaw_ned_rad=setpoint.yaw_ned_rad
            )
        elif self._is_moving:
            self.setpoint = _run_on(setpoint, STEP_S)

    @property
    def _is_moving(self) -> bool:
        return self.setpoint.velocity_en_mps is not None


REACTIONS: dict[str, tuple[CopterMode | None, ...]] = {
    "FS_GCS_ENABLE": (None, RTL, RTL, SMART_RTL, SMART_RTL, LAND, RTL, BRAKE),
    "FS_THR_ENABLE": (None, RTL, RTL, LAND, SMART_RTL, SMART_RTL, RTL, BRAKE),
    "FENCE_ACTION": (None, RTL, LAND, SMART_RTL, BRAKE, SMART_RTL),
    "BATT_FS_LOW_ACT": (None, LAND, RTL, SMART_RTL, SMART_RTL, None, RTL, BRAKE),
    "BATT_FS_CRT_ACT": (None, LAND, RTL, SMART_RTL, SMART_RTL, None, RTL, BRAKE),
    "FS_EKF_ACTION": (None, LAND, ALT_HOLD, LAND),
}
"""The mode that each value of a parameter asks for; None: at most a text."""
TERMINATE = 5
"""Value of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT."""
EVEN_WITHOUT_POSITION = 3
"""Value of FS_EKF_ACTION: also in modes that need no position."""
CONTINUE_IN_GUIDED = 4
"""Bit of FS_OPTIONS: GUIDED continues without the transmitter."""
TWO_VOTES = 2
EKF_DEBOUNCE_S = 1.0
"""Time for which the estimate must be bad, and then good again."""
ROUNDING_S = 1e-6
FENCE, EKF, STATION, STICKS = "Fence breached", "EKF Failsafe", "GCS Failsafe", "Radio Failsafe"
BATTERY_LEVELS = (
    ("BATT_LOW_VOLT", "BATT_LOW_MAH", "Battery 1 is low", "BATT_FS_LOW_ACT"),
    ("BATT_CRT_VOLT", "BATT_CRT_MAH", "Battery 1 is critical", "BATT_FS_CRT_ACT"),
)
"""Parameters of the minimum voltage and charge, the failsafe's name, and its action."""


@dataclass(frozen=True, slots=True)
class FailsafeEvent:
    """A failsafe begins or ends."""

    text: str
    reaction: CopterMode | None = None
    stops_motors: bool = False
    names_mode: bool = False
    """True if a second text names the new mode."""


def cleared(name: str) -> FailsafeEvent:
    """Return the event of a failsafe that ended."""
    return FailsafeEvent(f"{name} Cleared")


class CopterFailsafes:
    """Set of active failsafes."""

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self.active: set[str] = set()
        self._aircraft = aircraft
        self._parameters = parameters
        self._had_sticks = False
        self._bad_estimate_s = 0.0

    def clear(self) -> None:
        """Clear failsafes when the vehicle disarms."""
        self.active.clear()
        self._bad_estimate_s = 0.0

    def watch(self, mode: CopterMode, margin_m: float, now_s: float) -> Iterator[FailsafeEvent]:
        """Yield the failsafes that begin or end in this physics step of an armed vehicle."""
        heard_s = self._aircraft.stations_s.get(int(self._parameters["SYSID_MYGCS"]))
        is_silent = heard_s is not None and now_s - heard_s > self._parameters["FS_GCS_TIMEOUT"]
        station, sticks = self._reaction("FS_GCS_ENABLE"), self._reaction("FS_THR_ENABLE")
        if self._changes(STATION, is_silent and station is not None):
            yield self._event(STATION, station)
        has_sticks = self._aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        if mode is GUIDED and int(self._parameters["FS_OPTIONS"]) & CONTINUE_IN_GUIDED:
            sticks = None
        if self._changes(STICKS, self._had_sticks and not has_sticks and sticks is not None):
            yield self._event(STICKS, sticks)
        value, battery = self._parameters, self._aircraft.battery
        volts = CELLS * battery.cell_mv / 1e3
        left_mah = battery.share * value["BATT_CAPACITY"]
        for least_v, least_mah, name, action in BATTERY_LEVELS:
            is_under = volts <= value[least_v] or 0.0 < value[least_mah] >= left_mah
            if self._changes(name, is_under):
                text = f"{name} {volts:.2f}V used {battery.consumed_mah} mAh"
                event = FailsafeEvent(text, self._reaction(action), value[action] == TERMINATE)
                yield event if is_under else cleared(name)
        if self._changes(FENCE, margin_m < 0.0):
            yield self._event(FENCE, self._reaction("FENCE_ACTION"))
        estimator, value = self._aircraft.estimator, self._parameters
        is_bad = not estimator.is_position_valid or self._is_over_threshold()
        change_s = STEP_S if is_bad else -STEP_S
        self._bad_estimate_s = min(EKF_DEBOUNCE_S, max(0.0, self._bad_estimate_s + change_s))
        limit_s = ROUNDING_S if EKF in self.active else EKF_DEBOUNCE_S - ROUNDING_S
        concerns = mode.needs_position or value["FS_EKF_ACTION"] == EVEN_WITHOUT_POSITION
        reaction = self._reaction("FS_EKF_ACTION") if concerns else None
        if self._changes(EKF, self._bad_estimate_s >= limit_s):
            yield self._event(EKF, reaction, names_mode=reaction is not None)

    def _is_over_threshold(self) -> bool:
        """Return True if two of three ratios, or the velocity at twice the threshold, are bad."""
        ratio, threshold = self._aircraft.estimator.test_ratio, self._parameters["FS_EKF_THRESH"]
        votes = sum(ratio(of) >= threshold for of in ("velocity", "position", "compass"))
        return votes >= TWO_VOTES or ratio("velocity") >= 2.0 * threshold

    def _reaction(self, parameter: str) -> CopterMode | None:
        reactions, number = REACTIONS[parameter], int(self._parameters[parameter])
        return reactions[number] if 0 <= number < len(reactions) else None

    def _changes(self, name: str, is_present: bool) -> bool:
        """Record if a failsafe is active; return True if that changed."""
        if is_present == (name in self.active):
            return False
        (self.active.add if is_present else self.active.discard)(name)
        return True

    def _event(
        self, name: str, reaction: CopterMode | None, *, names_mode: bool = False
    ) -> FailsafeEvent:
        """Return the event of a failsafe that has just begun or ended."""
        if name in self.active:
            return FailsafeEvent(name, reaction, names_mode=names_mode)
        return cleared(name)
