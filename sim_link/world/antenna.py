"""Directions as the antennas of a radio measure and print them.

Theory of operation. An array measures phases between its elements, and so the components of the
unit vector u to the emitter in its own plane (direction cosines), each with a noise sigma_0 that
hardly depends on the direction; the data sheet gives it as an angle at boresight. The antenna's
frame is x boresight, y right, z down; with the mount (0, 0, 0) it is the body's. So

    u = R_mount^T R_body(roll, pitch, yaw)^T (target - sensor) / slant

    planar     u_x, u_y: azimuth atan2(u_y, u_x) clockwise from x, sigma_0 / cos(elevation): nothing
               near the normal of its plane, the cone of silence
    line       u_y alone: it prints asin(u_y), which is no azimuth once the target is out of level
    two_axis   u_y and u_z: asin(u_y), and asin(-u_z) as elevation

A line and a two-axis array do not see which side a signal comes from: what is behind is printed as
its mirror image in front. An angle is printed as a radio gives it, in the antenna's frame; the
receiving program knows the mount.

Source: H. L. Van Trees, Optimum Array Processing (2002), sections 2.2 and 8.4.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import msgspec

from companion.domain import Params, PositionEnu
from sim_link.world.point_mass import Components, EulerAngles, seen_from

AntennaKind = Literal["ideal", "planar", "line", "two_axis"]
Degrees = Annotated[float, msgspec.Meta(ge=-360.0, le=360.0)]


class AntennaModelParams(Params, frozen=True):
    """Antenna of a radio that measures directions."""

    kind: AntennaKind = "ideal"
    """ideal: the azimuth in the world's frame whatever the attitude, as the paper has it."""
    sigma_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] | None = None
    """Noise of each direction cosine at boresight; None: the channel's `bearing_sigma_deg`."""
    mount_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the antenna on the body; pitch -90 looks straight down."""
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] | None = None
    """Full cone about boresight beyond which no direction is measured; None: everywhere."""
    folds: bool = True
    """True if a line or two-axis array reports directions from behind; otherwise it measures none
    there."""


class Printed(NamedTuple):
    """Angles as a radio prints them, in its antenna's frame; None: not measured."""

    bearing_rad: float
    """Clockwise from boresight, or the arcsine of the direction cosine to the right."""
    elevation_rad: float | None
    """Arcsine of the direction cosine upwards."""
    is_array_angle: bool
    """True if the bearing is an arcsine."""


def direction_enu(sensor_enu_m: PositionEnu, target_enu_m: PositionEnu) -> Components:
    """Return the unit vector from sensor to target, east, north, up.

    Straight up where they coincide.
    """
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
    """Return the angles that the radio prints for a direction in its frame; None: nothing.

    Args:
        u: Unit vector along boresight, right and down.
        sigma_rad: Standard deviation of each measured component.
        normals: Standard normals, of the components.
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
