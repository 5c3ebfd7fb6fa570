"""True radio channel: errors of ranges and bearings, and the directions antennas report.

Paper, eq. (1): y = h(x; s) + delta + b + eps. One draw decides for a whole measurement whether the
path is obstructed (NLOS): then it is longer, never shorter (exponential), and bent to either side
(normal). Thermal noise comes on top; the offsets delta are constant. For shadows see `environment`.

Theory of operation of the antenna. An array measures phases between its elements, and so the
components of the unit vector u to the emitter in its own plane (direction cosines), each with a
noise sigma_0 that hardly depends on the direction; the data sheet gives it as an angle at
boresight. The antenna's frame is x boresight, y right, z down; with the mount (0, 0, 0) it is the
body's. So

    u = R_mount^T R_body(roll, pitch, yaw)^T (target - sensor) / slant

    planar     u_x, u_y: azimuth atan2(u_y, u_x) clockwise from x, sigma_0 / cos(elevation): nothing
               near the normal of its plane, the cone of silence
    line       u_y alone: it prints asin(u_y), which is not an azimuth once the target is out of
    level two_axis   u_y and u_z: asin(u_y), and asin(-u_z) as elevation

A line and a two-axis array do not see which side a signal comes from: what is behind is printed as
its mirror image in front. An angle is printed as a radio gives it, in the antenna's frame; the
receiving program knows the mount.

Source: H. L. Van Trees, Optimum Array Processing (2002), sections 2.2 and 8.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np

from companion.domain import Params, PositionEnu, RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from sim_link.world.environment import (
    NO_MEMORY,
    ChannelParams,
    Drawn,
    Emitter,
    Environment,
    OpenPath,
    ShadowMemory,
    obstruction,
    open_obstruction,
)
from sim_link.world.line_of_sight import Surroundings
from sim_link.world.point_mass import Components, EulerAngles, seen_from

MIN_RANGE_M = 0.01
"""Measured ranges stay positive, as in the paper."""


@dataclass(frozen=True, slots=True)
class ChannelDraw:
    """Errors of one measurement, from noise and obstacles."""

    range_bias_m: float
    """Excess of an obstructed path; never negative."""
    bearing_bias_rad: float
    range_noise_m: float
    bearing_noise_rad: float


class _Character(NamedTuple):
    """The parameters of a channel as it calculates with them."""

    range_offset_m: float
    bearing_offset_rad: float
    open_path: OpenPath
    range_sigma_m: float
    bearing_sigma_rad: float


@lru_cache(maxsize=64)
def _character_of(params: ChannelParams) -> _Character:
    bend_sigma_rad = math.radians(params.bearing_bias_sigma_deg)
    return _Character(
        params.range_offset_m,
        math.radians(params.bearing_offset_deg),
        OpenPath(params.p_nlos, params.range_bias_mean_m, bend_sigma_rad),
        params.range_sigma_m,
        math.radians(params.bearing_sigma_deg),
    )


class RadioChannel:
    """Measures an emitter through the true channel: its own, or else that of `params`."""

    def __init__(
        self,
        params: ChannelParams,
        rng: np.random.Generator,
        environment: Environment | None = None,
    ) -> None:
        self._rng = rng
        self._environment = environment
        self._surroundings: dict[PositionEnu, Surroundings] = {}
        self._memories: dict[PositionEnu, ShadowMemory] = {}
        self._params = params

    def prepare(self, emitter: Emitter) -> None:
        """Find the paths to `emitter`, and compile the kernels, before time counts."""
        self._obstruction((0.5, 1.0, 0.0), emitter, emitter.position_enu_m)

    def draw(self, emitter: Emitter, sensor_enu_m: PositionEnu) -> ChannelDraw:
        """Return the next random part; always consumes the same amount of randomness."""
        uniform = float(self._rng.random())
        exponential = float(self._rng.standard_exponential())
        bend, range_noise, bearing_noise = self._rng.standard_normal(3).tolist()
        range_bias_m, bearing_bias_rad, memory = self._obstruction(
            (uniform, exponential, bend), emitter, sensor_enu_m
        )
        self._memories[emitter.position_enu_m] = memory
        character = self._character(emitter)
        return ChannelDraw(
            range_bias_m=float(range_bias_m),
            bearing_bias_rad=float(bearing_bias_rad),
            range_noise_m=character.range_sigma_m * range_noise,
            bearing_noise_rad=character.bearing_sigma_rad * bearing_noise,
        )

    def measure(
        self, emitter: Emitter, sensor_enu_m: PositionEnu, time_s: float
    ) -> RangingMeasurement:
        """Measure `emitter`; the result does not show if the path was obstructed."""
        draw, character = self.draw(emitter, sensor_enu_m), self._character(emitter)
        range_m = (
            emitter.slant_range_m(sensor_enu_m)
            + character.range_offset_m
            + draw.range_bias_m
            + draw.range_noise_m
        )
        bearing_rad = (
            emitter.bearing_enu_rad(sensor_enu_m)
            + character.bearing_offset_rad
            + draw.bearing_bias_rad
            + draw.bearing_noise_rad
        )
        return RangingMeasurement(
            emitter_id=emitter.emitter_id,
            measured_at_s=time_s,
            range_m=max(MIN_RANGE_M, range_m),
            range_sigma_m=character.range_sigma_m,
            bearing_enu_rad=wrap_pi(bearing_rad),
            bearing_sigma_rad=character.bearing_sigma_rad,
            quality=emitter.quality,
        )

    def _params_of(self, emitter: Emitter) -> ChannelParams:
        return self._params if emitter.channel is None else emitter.channel

    def _character(self, emitter: Emitter) -> _Character:
        return _character_of(self._params_of(emitter))

    def _around(self, emitter: Emitter, environment: Environment) -> Surroundings:
        position = emitter.position_enu_m
        if position not in self._surroundings:
            self._surroundings[position] = environment.around(position)
        return self._surroundings[position]

    def _obstruction(
        self, drawn: Drawn, emitter: Emitter, sensor_enu_m: PositionEnu
    ) -> tuple[float, float, ShadowMemory]:
        """Return range excess, bearing bias and the shadow's memory."""
        position, open_path = emitter.position_enu_m, self._character(emitter).open_path
        memory = self._memories.get(position, NO_MEMORY)
        if self._environment is None:
            return *open_obstruction(*drawn, open_path), memory
        shadow, surroundings = self._environment.shadow, self._around(emitter, self._environment)
        return obstruction(drawn, sensor_enu_m, open_path, shadow, surroundings, memory)


AntennaKind = Literal["ideal", "planar", "line", "two_axis"]
Degrees = Annotated[float, msgspec.Meta(ge=-360.0, le=360.0)]


class AntennaModelParams(Params, frozen=True):
    """Antenna of a radio that measures directions."""

    kind: AntennaKind = "ideal"
    """ideal: the azimuth in the world's frame at any attitude, as in the paper."""
    sigma_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] | None = None
    """Noise of each direction cosine at boresight; None: the channel's `bearing_sigma_deg`."""
    mount_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the antenna on the body; pitch -90 looks straight down."""
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] | None = None
    """Full cone about boresight beyond which no direction is measured; None: everywhere."""
    folds: bool = True
    """True if an array reports directions from behind; otherwise it measures none there."""


class Printed(NamedTuple):
    """Angles as a radio prints them, in its antenna's frame; None: not measured."""

    bearing_rad: float
    """Bearing, clockwise from boresight, or the arcsine of the direction cosine to the right."""
    elevation_rad: float | None
    """Elevation, or the arcsine of the direction cosine upwards."""
    is_array_angle: bool
    """True if the bearing is an arcsine."""


def direction_enu(sensor_enu_m: PositionEnu, target_enu_m: PositionEnu) -> Components:
    """Return the unit vector from sensor to target, east, north, up; straight up at it."""
    e, n, u = (t - s for t, s in zip(target_enu_m, sensor_enu_m, strict=True))
    length = math.sqrt(e * e + n * n + u * u)
    return (e / length, n / length, u / length) if length > 0.0 else (0.0, 0.0, 1.0)


def bent(direction: Components, aside_rad: float, up_rad: float) -> Components:
    """Return a direction (east, north, up) turned in space, horizontally to the left and upwards.

    The angle is one in space: a bend to the left turns the azimuth by 1/cos(elevation) of it.
    """
    angle = math.hypot(aside_rad, up_rad)
    if angle == 0.0:
        return direction
    e, n, u = direction
    level = math.hypot(e, n)
    le, ln = (-n / level, e / level) if level > 0.0 else (0.0, 1.0)
    upwards = (-u * ln, u * le, e * ln - n * le)
    cos, sin = math.cos(angle), math.sin(angle) / angle
    left = (sin * aside_rad * le, sin * aside_rad * ln, 0.0)
    east, north, up = (
        cos * old + to_left + sin * up_rad * above
        for old, to_left, above in zip(direction, left, upwards, strict=True)
    )
    return (east, north, up)


def turned_about_vertical(direction: Components, angle_rad: float) -> Components:
    """Return a direction (east, north, up) with its azimuth turned counter-clockwise."""
    e, n, u = direction
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return (cos * e - sin * n, sin * e + cos * n, u)


def seen_by_antenna(
    direction: Components, attitude: EulerAngles, params: AntennaModelParams, offset_rad: float
) -> Components:
    """Return components along boresight, right and down of a direction given east, north, up.

    An offset (counter-clockwise positive, as the channel's) is an unknown error of the mount:
    the antenna stands that much farther clockwise about the body's vertical.
    """
    east, north, up = direction
    body = seen_from(attitude, (north, east, -up))
    roll, pitch, yaw = (math.radians(angle) for angle in params.mount_deg)
    return seen_from(EulerAngles(roll, pitch, yaw + offset_rad), body)


def printed(
    u: Components, params: AntennaModelParams, sigma_rad: float, normals: Components
) -> Printed | None:
    """Return the angles printed for a unit vector along boresight, right and down; None: nothing.

    Standard normals times `sigma_rad` are added to the measured components.
    """
    x, y, z = u
    is_flat = params.kind == "planar"
    if not is_flat:
        if x < 0.0 and not params.folds:
            return None
        x = abs(x)
    if params.field_of_view_deg is not None:
        off_rad = math.acos(max(-1.0, min(1.0, x)))
        if off_rad > 0.5 * math.radians(params.field_of_view_deg):
            return None
    x, y, z = (c + sigma_rad * normal for c, normal in zip((x, y, z), normals, strict=True))
    if is_flat:
        return Printed(math.atan2(y, x), None, is_array_angle=False)
    elevation_rad = _arcsine(-z) if params.kind == "two_axis" else None
    return Printed(_arcsine(y), elevation_rad, is_array_angle=True)


def _arcsine(component: float) -> float:
    """Return the arcsine of a value that noise may have pushed beyond 1."""
    return math.asin(max(-1.0, min(1.0, component)))
