"""GUIDED of ArduCopter: what each target message asks for, and what becomes of it.

Take-off comes first, positions are latched for ever, motions time out without a word. A position
with a velocity runs on by it until the time-out, and is latched where it is then.

One ignored axis ignores its whole group. Accepted are position, velocity, acceleration, position
with velocity (and acceleration), velocity with acceleration, each with or without yaw or yaw rate;
a force is ignored; anything else stops the vehicle, and so does a frame that is not known. As the
real one this flies to 0/0, to any height, and without terrain data down to the ground. That may end
on a NaN position: here it is refused, and a text says so.

Source: ArduPilot documentation, "Copter Commands in Guided Mode"; ArduCopter 4.5 as observed in
SITL; parameter GUID_TIMEOUT.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

from companion.domain import PositionEnu
from companion.geometry.coordinates import enu_from_ned, wrap_pi
from companion.mav import dialect
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
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
from sim_link.autopilot.pilot import STEP_S, Task
from sim_link.autopilot.protocols.plan_items import GLOBAL_FRAMES

LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
LOCAL_OFFSET_NED = mavlink.MAV_FRAME_LOCAL_OFFSET_NED
BODY_NED = mavlink.MAV_FRAME_BODY_NED
BODY_OFFSET_NED = mavlink.MAV_FRAME_BODY_OFFSET_NED
LOCAL_FRAMES = (LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
OUT_OF_SIGHT_M = 1e9
"""Stands for an infinite height."""
BODY_FRAMES = (BODY_NED, BODY_OFFSET_NED)
TERRAIN_FRAMES = (mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT)


class Target(NamedTuple):
    """Target of GUIDED that a message sets, or its refusal."""

    setpoint: Setpoint | None
    """A position is held for ever, once its velocity has timed out; without one it times out after
    GUID_TIMEOUT. None: stop."""
    text: str = ""
    """Text for the operators about a refusal."""


def _refused(why: str) -> Target:
    return Target(None, f"Guided: {why}, stopping")


def target_from_local(message: LocalTarget, aircraft: Aircraft) -> Target:
    """Decode SET_POSITION_TARGET_LOCAL_NED."""
    frame = message.coordinate_frame
    if frame not in LOCAL_FRAMES:
        return _refused(f"frame {frame} not supported")
    place: PositionEnu | None = None
    if not message.type_mask & dialect.POSITION_IGNORE:
        if not (math.isfinite(message.x) and math.isfinite(message.y)) or math.isnan(message.z):
            return _refused("position is not a number")
        place = _local_place(message, aircraft)
    return _target(message, place, aircraft.heading_ned_rad if frame in BODY_FRAMES else None)


def _local_place(message: LocalTarget, aircraft: Aircraft) -> PositionEnu:
    """Return the position; any frame but LOCAL_NED is an offset from the vehicle."""
    z = max(-OUT_OF_SIGHT_M, min(OUT_OF_SIGHT_M, message.z))
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
    place = aircraft.place_from(message.lat_int, message.lon_int, altitude_m, frame)
    return _target(message, place, None)


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
    message: PositionTarget, place: PositionEnu | None, body_yaw_rad: float | None
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
    is_understood = has_velocity or (place is not None) is not has_acceleration
    if not is_understood or not all(map(math.isfinite, given)):
        return Target(None)
    if yaw is not None:
        yaw = wrap_pi(yaw if body_yaw_rad is None else yaw + body_yaw_rad)
    east, north, climb_mps = enu_of(message.vx, message.vy, message.vz, body_yaw_rad)
    acceleration = enu_of(message.afx, message.afy, message.afz, body_yaw_rad)
    setpoint = Setpoint(
        position_en_m=None if place is None else place[:2],
        up_m=None if place is None else place[2],
        velocity_en_mps=(east, north) if has_velocity else None,
        climb_mps=climb_mps if has_velocity else None,
        acceleration_enu_mps2=acceleration if has_acceleration else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )
    return Target(setpoint)


def _run_on(setpoint: Setpoint, dt_s: float) -> Setpoint:
    """Return a position target moved on by its velocity; others unchanged."""
    place, velocity, up_m = setpoint.position_en_m, setpoint.velocity_en_mps, setpoint.up_m
    if place is None or velocity is None or up_m is None:
        return setpoint
    moved = (place[0] + velocity[0] * dt_s, place[1] + velocity[1] * dt_s)
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
        self._taken_s = 0.0

    @property
    def task(self) -> Task:
        """Task that the state gives to the pilot."""
        match self.state:
            case GuidedState.CLIMBING:
                return Task.TAKE_OFF
            case GuidedState.FOLLOWING:
                return Task.FOLLOW
        return Task.STAY

    @property
    def is_latched(self) -> bool:
        """True if it flies to a position and stays there for ever."""
        is_following = self.state is GuidedState.FOLLOWING
        return is_following and self.setpoint.position_en_m is not None and not self._is_moving

    def echo(self, climb_goal_enu_m: PositionEnu | None) -> Echo:
        """Return the target for POSITION_TARGET_*: a position, or a motion, 0 while it stays."""
        if self.state is GuidedState.CLIMBING and climb_goal_enu_m is not None:
            return Echo(climb_goal_enu_m)
        if self.state is not GuidedState.FOLLOWING:
            return Echo(NOTHING, STILL, STILL)
        setpoint = self.setpoint
        place: Axes = (*(setpoint.position_en_m or (None, None)), setpoint.up_m)
        if setpoint.velocity_en_mps is None:
            return Echo(place, NOTHING, setpoint.acceleration_enu_mps2 or NOTHING)
        velocity = (*setpoint.velocity_en_mps, setpoint.climb_mps or 0.0)
        return Echo(place, velocity, setpoint.acceleration_enu_mps2 or STILL)

    def stop(self) -> None:
        """Stay in place until something is asked, as when the mode begins."""
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
