"""Control of PX4 from outside and its end: offboard setpoints, and failsafes.

Offboard setpoints of PX4: their validity and meaning.

A field that is NaN or infinite counts as masked. A setpoint is refused, and is then no proof of
life, if its frame is not one of ours, if it sets the FORCE bit, or if it leaves neither position,
velocity nor acceleration. One that gives only some axes is a proof of life that asks to stay in
place.

SET_ATTITUDE_TARGET on a point mass: thrust along an attitude is an acceleration. Body rates are not
flown, because a point mass has no attitude of its own to turn: a message that masks the attitude is
refused, and is not proof of life.

Source: MAVLink common, messages 82, 84 and 86; PX4 user guide, offboard; PX4 1.15 as observed.

PX4's failsafes: the active faults, and the reaction that takes precedence.

Theory of operation. Every cause has a reaction while it is active, and the most severe reaction is
flown. Most reactions wait: PX4 holds for COM_FAIL_ACT_T first, so that the operator may take over,
by a mode but not by the sticks. Fallbacks (no setpoints, no position) and a hold at the fence do
not wait. The time to hold shrinks while it is used and grows back four times as slowly, so that an
intermittent cause eventually takes effect.

Some causes end with their condition (setpoints, position, battery), the others stay until the
operator chooses a mode or the vehicle disarms (sticks, station, fence). A choice of the operator
takes over from all of them: a cause that was taken over acts again only after its condition has
gone and come back.

Source: PX4 1.15, `commander/failsafe/framework.cpp` and `failsafe.cpp`; user guide, "Safety
Configuration"; Parameter Reference, COM_*, NAV_*, BAT_*, GF_*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from companion.domain import FlightMode, PositionEnu
from companion.geometry.coordinates import enu_from_ned, wrap_pi
from companion.mav import dialect
from companion.mav.dialect import mavlink
from sim_link.autopilot.aircraft import Aircraft
from sim_link.autopilot.control_inputs import (
    AttitudeTarget,
    GlobalTarget,
    LocalTarget,
    PositionTarget,
    Setpoint,
    TargetMessage,
    bits_of_non_finite,
    enu_of,
    is_on_earth,
)
from sim_link.autopilot.flight_controller import STEP_S
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore
from sim_link.world.point_mass import GRAVITY_MPS2

HORIZONTAL_POSITION_IGNORE = dialect.X_IGNORE | dialect.Y_IGNORE
HORIZONTAL_VELOCITY_IGNORE = dialect.VX_IGNORE | dialect.VY_IGNORE
MOTION_IGNORE = dialect.POSITION_IGNORE | dialect.VELOCITY_IGNORE | dialect.ACCELERATION_IGNORE
RELATIVE_FRAME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
TERRAIN_FRAME = mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL_INT,
    RELATIVE_FRAME,
    TERRAIN_FRAME,
)


def setpoint_from_local(message: LocalTarget, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of SET_POSITION_TARGET_LOCAL_NED, or None if it is refused.

    BODY_NED (8) is for velocities and accelerations only, forward, right and down of the nose.
    """
    position_ned = (message.x, message.y, message.z)
    mask = effective_mask(message, position_ned)
    if mask is None:
        return None
    has_position = mask & dialect.POSITION_IGNORE != dialect.POSITION_IGNORE
    match message.coordinate_frame:
        case mavlink.MAV_FRAME_LOCAL_NED:
            position = aircraft.estimator.world_from_local(enu_from_ned(position_ned))
            return _assemble(message, mask, position if has_position else None)
        case mavlink.MAV_FRAME_BODY_NED if not has_position:
            return _assemble(message, mask, None, aircraft.heading_ned_rad)
    return None


def setpoint_from_global(message: GlobalTarget, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of SET_POSITION_TARGET_GLOBAL_INT, or None if it is refused.

    Frame 5 has its altitude above sea level, frame 11 above the flat ground. Frame 6 should have it
    above home; PX4 1.15 adds the height of the origin above home instead of subtracting it.
    """
    if message.coordinate_frame not in GLOBAL_FRAMES:
        return None
    mask = effective_mask(message, (message.lat_int, message.lon_int, message.alt))
    if mask is None:
        return None
    if mask & dialect.POSITION_IGNORE:
        return _assemble(message, mask, None)
    if not is_on_earth(message.lat_int, message.lon_int):
        return None
    frame, altitude_m = message.coordinate_frame, message.alt
    if frame == TERRAIN_FRAME:
        altitude_m += aircraft.estimator.world_origin.altitude_m + aircraft.motion.ground_up_m
    elif frame == RELATIVE_FRAME:
        altitude_m += 2.0 * aircraft.estimator.origin.altitude_m - aircraft.home_altitude_m
    position = aircraft.position_from(
        message.lat_int, message.lon_int, altitude_m, mavlink.MAV_FRAME_GLOBAL
    )
    return _assemble(message, mask, position)


def effective_mask(message: PositionTarget, position: tuple[float, float, float]) -> int | None:
    """Return the type mask, with the bits of NaN fields added; None if the setpoint is refused."""
    mask = int(message.type_mask) | bits_of_non_finite(message, position)
    is_empty = mask & MOTION_IGNORE == MOTION_IGNORE
    return None if mask & dialect.FORCE_SET or is_empty else mask


def _assemble(
    message: PositionTarget,
    mask: int,
    enu_m: PositionEnu | None,
    body_yaw_rad: float | None = None,
) -> Setpoint:
    """Return the setpoint at a position (None: not given), its vectors by heading (None: north)."""
    has_en = enu_m is not None and not mask & HORIZONTAL_POSITION_IGNORE
    has_up = enu_m is not None and not mask & dialect.Z_IGNORE
    has_velocity_en = not mask & HORIZONTAL_VELOCITY_IGNORE
    has_climb = not mask & dialect.VZ_IGNORE
    yaw = None if mask & dialect.YAW_IGNORE else float(message.yaw)
    if yaw is not None and body_yaw_rad is not None:
        yaw = wrap_pi(yaw + body_yaw_rad)
    yaw_rate = None if mask & dialect.YAW_RATE_IGNORE else float(message.yaw_rate)
    acceleration = None
    if not mask & dialect.ACCELERATION_IGNORE:
        acceleration = enu_of(message.afx, message.afy, message.afz, body_yaw_rad)
    if not ((has_en or has_velocity_en) and (has_up or has_climb)):
        return Setpoint(
            acceleration_enu_mps2=acceleration, yaw_ned_rad=yaw, yaw_rate_ned_radps=yaw_rate
        )
    east, north, climb_mps = enu_of(message.vx, message.vy, message.vz, body_yaw_rad)
    return Setpoint(
        position_en_m=enu_m[:2] if enu_m is not None and has_en else None,
        up_m=enu_m[2] if enu_m is not None and has_up else None,
        velocity_en_mps=(east, north) if has_velocity_en else None,
        climb_mps=climb_mps if has_climb else None,
        yaw_ned_rad=yaw,
        yaw_rate_ned_radps=yaw_rate,
    )


CANNOT_BE_LEFT_OUT = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
)
HOVER_THRUST = 0.5
SHORTEST_QUATERNION = 0.1


def setpoint_from_attitude(message: AttitudeTarget) -> Setpoint | None:
    """Return the setpoint of SET_ATTITUDE_TARGET, or None if it is refused."""
    values = (*message.q, message.thrust)
    if message.type_mask & CANNOT_BE_LEFT_OUT or not all(map(math.isfinite, values)):
        return None
    length = math.hypot(*message.q)
    if length < SHORTEST_QUATERNION or not 0.0 <= message.thrust <= 1.0:
        return None
    w, x, y, z = (part / length for part in message.q)
    thrust_mps2 = message.thrust / HOVER_THRUST * GRAVITY_MPS2
    north = -2.0 * (x * z + w * y) * thrust_mps2
    east = -2.0 * (y * z - w * x) * thrust_mps2
    up = (1.0 - 2.0 * (x * x + y * y)) * thrust_mps2 - GRAVITY_MPS2
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return Setpoint(acceleration_enu_mps2=(east, north, up), yaw_ned_rad=yaw)


def setpoint_from(message: TargetMessage, aircraft: Aircraft) -> Setpoint | None:
    """Return the setpoint of a message, or None if it is refused."""
    if isinstance(message, LocalTarget):
        return setpoint_from_local(message, aircraft)
    if isinstance(message, GlobalTarget):
        return setpoint_from_global(message, aircraft)
    return setpoint_from_attitude(message)


REGROWTH = 0.25
"""Rate at which the delay recovers, in s per s."""


class Reaction(Enum):
    """Reactions in order of severity, each with the mode that carries it out."""

    WARN = (0, None)
    POSITION = (1, FlightMode.POSITION)
    ALTITUDE = (2, FlightMode.ALTITUDE)
    MANUAL = (3, FlightMode.STABILIZED)
    HOLD = (4, FlightMode.HOLD)
    RETURN = (5, FlightMode.RETURN)
    LAND = (6, FlightMode.LAND)
    DISARM = (7, None)

    def __init__(self, severity: int, mode: FlightMode | None) -> None:
        self.severity = severity
        self.mode = mode


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """Cause of a failsafe, and PX4's reaction to it."""

    text: str
    """Text of the report."""
    parameter: str | None
    """Parameter that selects the reaction; None: the first one."""
    reactions: tuple[Reaction | None, ...]
    """Reactions by the parameter's value; None: this is not watched."""
    waits: bool = True
    """True if it waits for COM_FAIL_ACT_T first."""
    ends: bool = False
    """True if it ends with its condition."""


WARN, HOLD, RETURN = Reaction.WARN, Reaction.HOLD, Reaction.RETURN
LAND, DISARM = Reaction.LAND, Reaction.DISARM
FALLBACKS = (Reaction.POSITION, Reaction.ALTITUDE, Reaction.MANUAL)
LINK_LOSS = (None, HOLD, RETURN, LAND, None, DISARM, DISARM)
CAUSES = (
    Cause(
        "no setpoints",
        "COM_OBL_RC_ACT",
        (*FALLBACKS, RETURN, LAND, HOLD, DISARM, DISARM),
        waits=False,
        ends=True,
    ),
    Cause("no sticks", "NAV_RCL_ACT", LINK_LOSS),
    Cause("no ground station", "NAV_DLL_ACT", LINK_LOSS),
    Cause("no position", None, (LAND,)),
    Cause("fence breached", "GF_ACTION", (None, WARN, HOLD, RETURN, DISARM, LAND)),
    Cause("battery critical", "COM_LOW_BAT_ACT", (WARN, WARN, LAND, RETURN), ends=True),
    Cause("battery emergency", "COM_LOW_BAT_ACT", (WARN, LAND, LAND, LAND), ends=True),
)
EXCEPTION_OF = {FlightMode.MISSION: 1, FlightMode.HOLD: 2, FlightMode.OFFBOARD: 4}


class Px4Failsafes:
    """Active failsafe causes of one aircraft, and the reaction that is flown."""

    def __init__(self, aircraft: Aircraft, parameters: ParameterStore) -> None:
        self._aircraft = aircraft
        self._parameters = parameters
        self.delay_s = 0.0
        """Time for which it holds before the reaction; 0 once that time has passed."""
        self._active: dict[Cause, Reaction] = {}
        self._taken_over: set[Cause] = set()
        self._spent_s = 0.0
        """Time by which the next such hold is shorter than COM_FAIL_ACT_T."""
        self._had_sticks = False
        self._has_warned = False

    def watch(
        self, intention: FlightMode, fence_margin_m: float, now_s: float, *, is_stream_alive: bool
    ) -> list[Cause]:
        """Check an armed vehicle; return the causes that became active just now."""
        before, delay_s = self.flown, self._parameters["COM_FAIL_ACT_T"]
        is_reacting = before is not None and before.severity > HOLD.severity
        self.delay_s = max(0.0, self.delay_s - STEP_S)
        has_sticks = self._aircraft.sticks.read(now_s) is not None
        self._had_sticks = self._had_sticks or has_sticks
        excepted = int(self._parameters["COM_RCL_EXCEPT"])
        is_excepted = bool(excepted & EXCEPTION_OF.get(intention, 0))
        heard_s = max(self._aircraft.stations_s.values(), default=None)
        present = (
            intention is FlightMode.OFFBOARD and not is_stream_alive,
            (self._had_sticks and not has_sticks and not is_excepted),
            (heard_s is not None and now_s - heard_s > self._parameters["COM_DL_LOSS_T"]),
            not self._aircraft.estimator.is_position_valid,
            fence_margin_m < 0.0,
            self._aircraft.battery.share <= self._parameters["BAT_CRIT_THR"],
            self._aircraft.battery.share <= self._parameters["BAT_EMERGEN_THR"],
        )
        found = zip(CAUSES, present, strict=True)
        fresh = [cause for cause, is_present in found if self._note(cause, is_present)]
        if any(each.waits and self._active[each] is not WARN for each in fresh):
            self.delay_s = self.delay_s or max(0.0, delay_s - self._spent_s)
        can_hold = self._aircraft.estimator.is_position_valid
        if is_reacting or not can_hold or not self._active:
            self.delay_s = 0.0
        change_s = STEP_S if self.delay_s else -REGROWTH * STEP_S
        self._spent_s = min(delay_s, max(0.0, self._spent_s + change_s))
        return fresh

    def _note(self, cause: Cause, is_present: bool) -> bool:
        number = 0 if cause.parameter is None else int(self._parameters[cause.parameter])
        is_known = 0 <= number < len(cause.reactions)
        reaction = (cause.reactions[number] if is_known else WARN) if is_present else None
        if reaction is None:
            self._taken_over.discard(cause)
            if cause.ends:
                self._active.pop(cause, None)
            return False
        if cause in self._taken_over or cause in self._active:
            return False
        self._active[cause] = reaction
        return True

    def warn_of_battery(self) -> None:
        """Send a text when the charge falls below BAT_LOW_THR."""
        is_low = self._aircraft.battery.share <= self._parameters["BAT_LOW_THR"]
        if is_low and not self._has_warned:
            self._aircraft.notify(mavlink.MAV_SEVERITY_WARNING, "Low battery level")
        self._has_warned = is_low

    def take_over(self) -> None:
        """Handle the operator's choice of a mode."""
        self._taken_over |= self._active.keys()
        self._active.clear()
        self.delay_s = 0.0

    def clear(self) -> None:
        """Clear failsafes when the vehicle disarms."""
        self._active.clear()
        self._taken_over.clear()
        self.delay_s = 0.0

    @property
    def worst(self) -> tuple[Cause, Reaction] | None:
        """The cause with the most severe reaction, or None."""
        return max(self._active.items(), key=lambda item: item[1].severity, default=None)

    @property
    def flown(self) -> Reaction | None:
        """Reaction in force now: a hold while the worst one is delayed; None: no failsafe."""
        if self.worst is None:
            return None
        _, reaction = self.worst
        waits = self.delay_s > 0.0 and reaction not in (WARN, DISARM)
        return HOLD if waits else reaction
