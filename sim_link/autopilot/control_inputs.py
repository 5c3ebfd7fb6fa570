"""Control inputs of the vehicle: streamed setpoints, the pilot's sticks, and the echoed target.

Sticks are the scenario's transmitter, or a station's joystick over MAVLink. Of setpoints the module
has what both autopilots decode in the same way. Source: MAVLink common, POSITION_TARGET_TYPEMASK
and messages 84 and 86.

`Echo` is the target that POSITION_TARGET_LOCAL_NED and _GLOBAL_INT report. The two autopilots
report it differently. PX4 shows what its position controller works with, in every mode that has
one: the position if there is one, and always the velocity and acceleration that follow from it, the
yaw and the yaw rate; unused fields are NaN. ArduCopter shows only the target of GUIDED; unused
fields are 0, and yaw is never used.

Source: PX4 `mavlink/streams/POSITION_TARGET_LOCAL_NED.hpp` and `mc_pos_control/PositionControl`;
ArduCopter `GCS_Mavlink.cpp`, `send_position_target_local_ned`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.domain import PositionEnu
from companion.geometry.polygons import Point
from companion.mav import dialect
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import RcParams

LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message
AttitudeTarget = mavlink.MAVLink_set_attitude_target_message
PositionTarget = LocalTarget | GlobalTarget
TargetMessage = PositionTarget | AttitudeTarget

FIELD_BITS = (
    *(dialect.X_IGNORE, dialect.Y_IGNORE, dialect.Z_IGNORE),
    *(dialect.VX_IGNORE, dialect.VY_IGNORE, dialect.VZ_IGNORE),
    *(dialect.AX_IGNORE, dialect.AY_IGNORE, dialect.AZ_IGNORE),
    *(dialect.YAW_IGNORE, dialect.YAW_RATE_IGNORE),
)
"""Mask bits in the order of the fields."""
MAX_LATITUDE_E7 = 900_000_000
MAX_LONGITUDE_E7 = 1_800_000_000


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Target position and speed; None in a field that is not commanded. All None: stay in place."""

    position_en_m: Point | None = None
    """Position in the world's frame."""
    up_m: float | None = None
    velocity_en_mps: Point | None = None
    climb_mps: float | None = None
    acceleration_enu_mps2: PositionEnu | None = None
    yaw_ned_rad: float | None = None
    yaw_rate_ned_radps: float | None = None
    """Yaw rate, clockwise positive."""


class SetpointMonitor:
    """Keeps the newest valid setpoint and its time of arrival."""

    def __init__(self) -> None:
        self.arrived_s: float | None = None
        """Arrival time of the newest valid one; None before the first."""
        self.setpoint = Setpoint()
        self.received = 0
        """Setpoint messages addressed to us, the refused ones included."""
        self.refused = 0
        self.longest_gap_s = 0.0
        """Longest time between two valid setpoints while they were flown."""

    def take(self, setpoint: Setpoint | None, now_s: float, *, is_flown: bool) -> None:
        """Count a message and keep its setpoint; None means that it was refused."""
        self.received += 1
        if setpoint is None:
            self.refused += 1
            return
        if is_flown and self.arrived_s is not None:
            self.longest_gap_s = max(self.longest_gap_s, now_s - self.arrived_s)
        self.setpoint = setpoint
        self.arrived_s = now_s

    def is_alive(self, now_s: float, timeout_s: float) -> bool:
        """Return True if the newest valid setpoint is younger than `timeout_s`."""
        return self.arrived_s is not None and now_s - self.arrived_s < timeout_s


def bits_of_non_finite(message: PositionTarget, position: tuple[float, float, float]) -> int:
    """Return the POSITION_TARGET_TYPEMASK bits of the fields that are NaN or infinite."""
    velocity = (message.vx, message.vy, message.vz)
    acceleration = (message.afx, message.afy, message.afz)
    values = (*position, *velocity, *acceleration, message.yaw, message.yaw_rate)
    fields = zip(FIELD_BITS, values, strict=True)
    return sum(bit for bit, value in fields if not math.isfinite(value))


def enu_of(x: float, y: float, z: float, heading_rad: float | None) -> tuple[float, float, float]:
    """Return east, north, up of a vector forward, right, down of a heading; None: of north."""
    if heading_rad is None or not (math.isfinite(x) and math.isfinite(y)):
        return (float(y), float(x), -float(z))
    return (*turned(x, y, heading_rad), -float(z))


def is_on_earth(latitude_e7: int, longitude_e7: int) -> bool:
    """Return True if latitude and longitude in 1e-7 degrees are in range."""
    return abs(latitude_e7) <= MAX_LATITUDE_E7 and abs(longitude_e7) <= MAX_LONGITUDE_E7


def turned(forward: float, right: float, yaw_ned_rad: float) -> Point:
    """Return east and north of a vector that is given forward and right of a heading."""
    cos_yaw, sin_yaw = math.cos(yaw_ned_rad), math.sin(yaw_ned_rad)
    return (forward * sin_yaw + right * cos_yaw, forward * cos_yaw - right * sin_yaw)


STICK_RANGE = 1000.0
JOYSTICK_TIMEOUT_S = 0.5
"""Silence after which a joystick is gone (PX4 COM_RC_LOSS_T); ArduPilot has RC_OVERRIDE_TIME."""
MOVED = 0.3
"""Deflection that takes over from an automatic mode (PX4 COM_RC_STICK_OV, 30 %)."""
DEAD_ZONE = 0.1
"""Largest deflection at which a stick counts as released (PX4 MPC_HOLD_DZ)."""


@dataclass(frozen=True, slots=True)
class Sticks:
    """Deflections, -1 to 1; all of them 0 when released."""

    forward: float = 0.0
    right: float = 0.0
    up: float = 0.0
    yaw: float = 0.0
    """Deflection of yaw, clockwise positive."""

    @property
    def deflection(self) -> float:
        """Return the deflection of the stick that is moved most."""
        return max(abs(self.forward), abs(self.right), abs(self.up), abs(self.yaw))


CENTRED = Sticks()
THROTTLE_DOWN = Sticks(up=-1.0)


def sticks_from(message: mavlink.MAVLink_manual_control_message) -> Sticks:
    """Return the deflections of MANUAL_CONTROL; an axis beyond its range is absent, and centred.

    Source: MAVLink common, MANUAL_CONTROL (INT16_MAX: the axis is invalid; z is thrust, 500 is
    half); PX4 `handle_message_manual_control` takes no axis beyond 1000 either.
    """
    forward, right, thrust, yaw = (
        value / STICK_RANGE if abs(value) <= STICK_RANGE else math.nan
        for value in (message.x, message.y, message.z, message.r)
    )
    axes = (forward, right, 2.0 * thrust - 1.0, yaw)
    forward, right, up, yaw = (0.0 if math.isnan(axis) else max(-1.0, axis) for axis in axes)
    return Sticks(forward, right, up, yaw)


def sticks_at(pulses: tuple[float, float, float, float]) -> Sticks:
    """Return the deflections of roll, pitch, throttle and yaw pulses, -1 to 1."""
    roll, pitch, throttle, yaw = pulses
    return Sticks(-pitch, roll, throttle, yaw)


class StickInput:
    """Stick deflections from the transmitter or from a joystick, if there is either."""

    def __init__(self, params: RcParams) -> None:
        self.joystick_timeout_s = JOYSTICK_TIMEOUT_S
        """Silence after which a joystick or an override has ended."""
        self.resting = CENTRED if params.is_present else None
        """Rest positions of the transmitter's sticks; None without a transmitter."""
        self._joystick: Sticks = CENTRED
        self._joystick_s: float | None = None
        self._moved: Sticks = CENTRED
        self._moved_until_s = -math.inf
        self._lost_until_s = -math.inf
        self._lost_pulses: Sticks | None = None

    def take_joystick(self, sticks: Sticks, now_s: float) -> None:
        """Take deflections from MANUAL_CONTROL or RC_CHANNELS_OVERRIDE."""
        self._joystick = sticks
        self._joystick_s = now_s

    def move(self, sticks: Sticks, until_s: float) -> None:
        """Hold the transmitter's sticks at a deflection for some time."""
        self._moved, self._moved_until_s = sticks, until_s

    def lose(self, until_s: float, pulses: Sticks | None = None) -> None:
        """Lose the transmitter for some time; its receiver may output a failsafe position.

        The autopilot never takes these pulses for the pilot's, but it reports them.
        """
        self._lost_until_s, self._lost_pulses = until_s, pulses

    def is_joystick_alive(self, now_s: float) -> bool:
        """Return True if a station's joystick still reports."""
        return self._joystick_s is not None and now_s - self._joystick_s < self.joystick_timeout_s

    def pulses(self, now_s: float) -> Sticks | None:
        """Return RC_CHANNELS: the sticks, or a receiver's failsafe position; None: no receiver."""
        held = self.read(now_s)
        return self._lost_pulses if held is None and now_s < self._lost_until_s else held

    def held(self, now_s: float) -> Sticks | None:
        """Return the deflections while a joystick or the pilot deflects; None at rest."""
        is_held = self.is_joystick_alive(now_s) or now_s < self._moved_until_s
        return self.read(now_s) if is_held else None

    def read(self, now_s: float) -> Sticks | None:
        """Return the deflections, or None if there are no sticks."""
        if self.is_joystick_alive(now_s):
            return self._joystick
        if now_s < self._lost_until_s:
            return None
        return self._moved if now_s < self._moved_until_s else self.resting


Axes = tuple[float | None, float | None, float | None]
"""Vector east, north and up; None on an axis that is not commanded."""
NOTHING: Axes = (None, None, None)
AXIS_BITS = (
    *(dialect.Y_IGNORE, dialect.X_IGNORE, dialect.Z_IGNORE),
    *(dialect.VY_IGNORE, dialect.VX_IGNORE, dialect.VZ_IGNORE),
    *(dialect.AY_IGNORE, dialect.AX_IGNORE, dialect.AZ_IGNORE),
)
"""Mask bits of position, velocity and acceleration, each east, north and up."""


@dataclass(frozen=True, slots=True)
class Echo:
    """Target that the autopilot reports following."""

    position_enu_m: Axes = NOTHING
    """Position in the world's frame."""
    velocity_enu_mps: Axes = NOTHING
    acceleration_enu_mps2: Axes = NOTHING
    yaw_ned_rad: float | None = None
    yaw_rate_ned_radps: float | None = None
    """Yaw rate, clockwise positive."""
    unused: float = 0.0
    """Value of an unused field."""

    @property
    def type_mask(self) -> int:
        """Mask of ignored fields, POSITION_TARGET_TYPEMASK."""
        axes = (*self.position_enu_m, *self.velocity_enu_mps, *self.acceleration_enu_mps2)
        mask = sum(bit for axis, bit in zip(axes, AXIS_BITS, strict=True) if axis is None)
        mask |= 0 if self.yaw_ned_rad is not None else dialect.YAW_IGNORE
        return mask | (0 if self.yaw_rate_ned_radps is not None else dialect.YAW_RATE_IGNORE)

    @property
    def whole_position(self) -> PositionEnu | None:
        """The position; None unless all three axes are commanded."""
        east, north, up = self.position_enu_m
        return None if east is None or north is None or up is None else (east, north, up)
