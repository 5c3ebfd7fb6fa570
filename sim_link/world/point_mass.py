"""A point-mass multicopter: velocity commands in, position and attitude out.

Theory of operation. The velocity follows its command, which is limited to speed, climb and descent,
as a first-order lag whose change is limited to the acceleration that the tilt allows. The wind
shows as the share that a velocity controller lets through; gusts are a first-order Gauss-Markov
process per horizontal axis. The ground is flat; on it a vehicle stays until it climbs.

It leans as its thrust must point: against gravity, for the acceleration that it has, and against
the drag of the air, which is linear in the air speed, as that of rotors is (P. Martin, E. Salaun,
ICRA 2010). The drag shows in the attitude only; what it does to the motion is in the wind's share.

Positions are local east-north-up metres; yaw is clockwise from north.

Frames are forward, right, down (the body's, an antenna's) within north, east, down. A frame is
turned first by yaw about its third axis, then by pitch about its second, then by roll about its
first, as aircraft are: R = R_z(yaw) R_y(pitch) R_x(roll) takes a vector's components in the turned
frame to those in the outer one; `seen_from` is its transpose.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import msgspec

from companion.domain import NonNegative, Params, PositionEnu, Positive
from companion.geometry.coordinates import wrap_pi

Components = tuple[float, float, float]
"""Along the three axes of a frame."""


class EulerAngles(NamedTuple):
    """Euler angles of a turned frame in an outer one, rad; a body's yaw is clockwise from north."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0


LEVEL = EulerAngles()


def seen_from(attitude: EulerAngles, outer: Components) -> Components:
    """Return the components of an outer vector in the turned frame: R transposed, times it."""
    x, y, z = outer
    cos, sin = math.cos(attitude.yaw_rad), math.sin(attitude.yaw_rad)
    x, y = cos * x + sin * y, cos * y - sin * x
    cos, sin = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
    x, z = cos * x - sin * z, sin * x + cos * z
    cos, sin = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
    return (x, cos * y + sin * z, cos * z - sin * y)


def leaning(forward_mps2: float, right_mps2: float, down_mps2: float) -> tuple[float, float]:
    """Return roll and pitch of a multicopter whose thrust gives a horizontal acceleration.

    `down_mps2` is what the thrust holds against, gravity in steady flight. The roll leaves out that
    the pitch has shortened the upright part of the thrust: 1 degree at 20 degrees of both.
    """
    return math.atan2(right_mps2, down_mps2), -math.atan2(forward_mps2, down_mps2)


GRAVITY_MPS2 = 9.80665
GROUND_CONTACT_M = 1e-3
BRAKING_SHARE = 0.6
"""Share of the acceleration limit that an approach plans to brake with; the rest is reserve."""
DRAG_PER_S = 0.17
"""Deceleration per air speed: 10 m/s lean it by 10 degrees (PX4 EKF2_MCOEF: 0.15)."""

Speed = Annotated[float, msgspec.Meta(gt=0.0, le=100.0)]
WindSpeed = Annotated[float, msgspec.Meta(ge=-50.0, le=50.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class MulticopterParams(Params, frozen=True):
    """Limits and response of the multicopter."""

    max_speed_mps: Speed = 10.0
    max_climb_mps: Speed = 3.0
    max_descent_mps: Speed = 1.5
    landing_speed_mps: Speed = 0.7
    """Descent near the ground (PX4 MPC_LAND_SPEED)."""
    max_acceleration_mps2: Positive = 4.0
    velocity_time_constant_s: Positive = 0.3
    position_gain_per_s: Positive = 0.95
    """Commanded speed per metre of position error (PX4 MPC_XY_P)."""
    max_yaw_rate_radps: Positive = 0.8
    drag_per_s: NonNegative | None = None
    """Deceleration per air speed, against which it leans; None: 0.17 where a wind blows, otherwise
    0, as in the paper's still air."""


class WindParams(Params, frozen=True):
    """A wind by where it blows to, and its gusts."""

    east_mps: WindSpeed = 0.0
    north_mps: WindSpeed = 0.0
    gust_sigma_mps: Annotated[float, msgspec.Meta(ge=0.0, le=30.0)] = 0.0
    """Standard deviation per horizontal axis of the gusts on top of it."""
    gust_time_constant_s: Positive = 2.0
    """Time constant after which a gust's correlation has fallen to 1/e."""
    let_through: Share = 0.1
    """Share of the wind that the velocity controller fails to cancel."""

    @property
    def blows(self) -> bool:
        """True if there is any wind."""
        return (self.east_mps, self.north_mps, self.gust_sigma_mps) != (0.0, 0.0, 0.0)


class PointMass:
    """The vehicle's true motion."""

    def __init__(
        self,
        params: MulticopterParams,
        wind: WindParams,
        position_enu_m: PositionEnu,
        ground_up_m: float = 0.0,
    ) -> None:
        self._params = params
        self.wind = wind
        """Wind; `set_wind` changes it."""
        self._gust = (0.0, 0.0)
        self._drift = self._drift_of_wind()
        self.ground_up_m = ground_up_m
        self.position_enu_m: PositionEnu = position_enu_m
        self.velocity_enu_mps: PositionEnu = (0.0, 0.0, 0.0)
        self.acceleration_enu_mps2: PositionEnu = (0.0, 0.0, 0.0)
        self.yaw_ned_rad = 0.0

    @property
    def drift_mps(self) -> float:
        """Horizontal speed that the wind adds to every command."""
        return math.hypot(*self._drift)

    def blow(self, normals: tuple[float, float], dt_s: float) -> None:
        """Let the gusts change for `dt_s` seconds."""
        wind = self.wind
        kept = math.exp(-dt_s / wind.gust_time_constant_s)
        fresh = wind.gust_sigma_mps * math.sqrt(1.0 - kept * kept)
        east, north = (
            kept * old + fresh * new for old, new in zip(self._gust, normals, strict=True)
        )
        self._gust = (east, north)
        self._drift = self._drift_of_wind()

    def set_wind(self, wind: WindParams) -> None:
        """Set another wind; the current gust continues."""
        self.wind = wind
        self._drift = self._drift_of_wind()

    def _drift_of_wind(self) -> PositionEnu:
        wind, (east, north) = self.wind, self._gust
        return (
            wind.let_through * (wind.east_mps + east),
            wind.let_through * (wind.north_mps + north),
            0.0,
        )

    @property
    def attitude(self) -> EulerAngles:
        """The true one: leaning for its acceleration and against the air, level on the ground."""
        east, north, _ = self.acceleration_enu_mps2
        drag_per_s = self._params.drag_per_s
        if drag_per_s is None:
            drag_per_s = DRAG_PER_S if self.wind.blows else 0.0
        if drag_per_s > 0.0 and not self.is_on_ground:
            (ve, vn, _), (ge, gn) = self.velocity_enu_mps, self._gust
            east += drag_per_s * (ve - self.wind.east_mps - ge)
            north += drag_per_s * (vn - self.wind.north_mps - gn)
        cos_yaw, sin_yaw = math.cos(self.yaw_ned_rad), math.sin(self.yaw_ned_rad)
        forward = north * cos_yaw + east * sin_yaw
        right = east * cos_yaw - north * sin_yaw
        return EulerAngles(*leaning(forward, right, GRAVITY_MPS2), self.yaw_ned_rad)

    @property
    def height_m(self) -> float:
        """Height above the ground."""
        return self.position_enu_m[2] - self.ground_up_m

    @property
    def is_on_ground(self) -> bool:
        """True if the vehicle touches the ground."""
        return self.height_m <= GROUND_CONTACT_M

    def step(
        self, command_enu_mps: PositionEnu | None, yaw_ned_rad: float | None, dt_s: float
    ) -> None:
        """Move for `dt_s` by a velocity (None stops the motors) and a heading (None keeps it)."""
        if self.is_on_ground and (command_enu_mps is None or command_enu_mps[2] <= 0.0):
            self._rest()
            return
        if yaw_ned_rad is not None:
            limit = self._params.max_yaw_rate_radps * dt_s
            turn = wrap_pi(yaw_ned_rad - self.yaw_ned_rad)
            self.yaw_ned_rad = wrap_pi(self.yaw_ned_rad + min(limit, max(-limit, turn)))
        change = self._velocity_change(command_enu_mps, dt_s)
        (e, n, u), (ve, vn, vu) = self.position_enu_m, self.velocity_enu_mps
        half = 0.5 * dt_s
        e += (2.0 * ve + change[0]) * half
        n += (2.0 * vn + change[1]) * half
        u += (2.0 * vu + change[2]) * half
        ve, vn, vu = ve + change[0], vn + change[1], vu + change[2]
        if u <= self.ground_up_m:
            u, ve, vn, vu = self.ground_up_m, 0.0, 0.0, 0.0
        self.position_enu_m = (e, n, u)
        self.velocity_enu_mps = (ve, vn, vu)
        self.acceleration_enu_mps2 = (change[0] / dt_s, change[1] / dt_s, change[2] / dt_s)

    def _velocity_change(self, command_enu_mps: PositionEnu | None, dt_s: float) -> PositionEnu:
        if command_enu_mps is None:
            return (0.0, 0.0, -GRAVITY_MPS2 * dt_s)
        target = limited_velocity(command_enu_mps, self._params)
        response = 1.0 - math.exp(-dt_s / self._params.velocity_time_constant_s)
        ve, vn, vu = self.velocity_enu_mps
        de = (target[0] + self._drift[0] - ve) * response
        dn = (target[1] + self._drift[1] - vn) * response
        du = (target[2] - vu) * response
        size = math.sqrt(de * de + dn * dn + du * du)
        limit = self._params.max_acceleration_mps2 * dt_s
        scale = 1.0 if size <= limit else limit / size
        return (de * scale, dn * scale, du * scale)

    def _rest(self) -> None:
        e, n, _ = self.position_enu_m
        self.position_enu_m = (e, n, self.ground_up_m)
        self.velocity_enu_mps = (0.0, 0.0, 0.0)
        self.acceleration_enu_mps2 = (0.0, 0.0, 0.0)


def limited_velocity(velocity_enu_mps: PositionEnu, params: MulticopterParams) -> PositionEnu:
    """Return the velocity within the vehicle's limits, its horizontal direction kept."""
    ve, vn, vu = velocity_enu_mps
    speed = math.hypot(ve, vn)
    scale = 1.0 if speed <= params.max_speed_mps else params.max_speed_mps / speed
    vu = min(params.max_climb_mps, max(-params.max_descent_mps, vu))
    return (ve * scale, vn * scale, vu)


def approach_speed_mps(distance_m: float, params: MulticopterParams) -> float:
    """Return the approach speed: proportional when near, limited by braking when far."""
    gain = params.position_gain_per_s
    braking = BRAKING_SHARE * params.max_acceleration_mps2
    knee_m = braking / gain**2
    if distance_m <= knee_m:
        return gain * distance_m
    return math.sqrt(2.0 * braking * (distance_m - 0.5 * knee_m))


def approach_velocity(
    position_enu_m: PositionEnu, goal_enu_m: PositionEnu, params: MulticopterParams
) -> PositionEnu:
    """Return the velocity command that flies to a goal and stops there, within the limits."""
    e = goal_enu_m[0] - position_enu_m[0]
    n = goal_enu_m[1] - position_enu_m[1]
    u = goal_enu_m[2] - position_enu_m[2]
    distance = math.hypot(e, n)
    scale = 0.0
    if distance > 0.0:
        scale = min(params.max_speed_mps, approach_speed_mps(distance, params)) / distance
    climb = math.copysign(approach_speed_mps(abs(u), params), u)
    return limited_velocity((e * scale, n * scale, climb), params)


def stopping_point(
    position_enu_m: PositionEnu, velocity_enu_mps: PositionEnu, params: MulticopterParams
) -> PositionEnu:
    """Predict where a vehicle that brakes now comes to rest."""
    speed = math.sqrt(sum(v * v for v in velocity_enu_mps))
    time_s = params.velocity_time_constant_s + 0.5 * speed / params.max_acceleration_mps2
    e, n, u = (p + v * time_s for p, v in zip(position_enu_m, velocity_enu_mps, strict=True))
    return (e, n, u)
