"""Antenna arrays: direction components that they measure, in axes that rotate with the vehicle.

Antenna frame: x is the boresight, y points to the right of it, z down; with a zero mount these are
the body's forward, right and down. A planar array lies in x and y and reports an azimuth in that
plane. A line of antennas along y reports the arcsine of the direction cosine along it. A two-axis
array in y and z reports azimuth and elevation, the arcsines of the cosines along y and along -z.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Literal

import msgspec

from companion.domain import ArrayDirection, Attitude, Params, PositionEnu, RangingMeasurement
from companion.estimation.measurement_model import AZIMUTH, COSINES, PLANAR
from companion.geometry.coordinates import (
    Triple,
    bearing_enu_from_ned,
    body_axes_ned,
    combined,
    enu_from_ned,
)

AntennaKind = Literal["auto", "azimuth", "planar", "line", "two_axis"]
MODELS: dict[AntennaKind, int] = {
    "auto": AZIMUTH,
    "azimuth": AZIMUTH,
    "planar": PLANAR,
    "line": COSINES,
    "two_axis": COSINES,
}
"""Measurement model of each kind, see `measurement_model`."""
Angle = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
ABOUT_VERTICAL: tuple[AntennaKind, ...] = ("auto", "azimuth")
"""Kinds whose bearing is an azimuth about the vertical: yaw alone turns it into the local frame."""
Axes = tuple[PositionEnu, PositionEnu, PositionEnu]
MAX_ELEVATION_RAD = 0.5 * math.pi + 1e-6
"""A right angle plus the rounding of 32 bits on the wire; no arcsine is larger."""
MAX_BEARING_RAD = math.pi + 1e-6
"""Half a turn plus the same rounding; more is most likely another unit."""

LEVEL: Axes = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""East, south and down: axes of the level planar array whose azimuth is a bearing from north."""


class AntennaParams(Params, frozen=True):
    """Antenna that measures bearings, and its mount."""

    kind: AntennaKind = "auto"
    """`azimuth`: about the vertical, equally accurate at any elevation (the paper's). `auto`:
    planar, until the bearings identify the antenna; filters alone assume `azimuth`."""
    mount_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the antenna's frame in the body's; (0, -90, 0) looks down."""
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 360.0
    """Full angle about the boresight within which its directions are used."""


def antenna_axes_enu(attitude_rad: Triple, mount_deg: Triple) -> Axes:
    """Return the antenna's x, y and z axes at this attitude, unit vectors in the local frame."""
    body = body_axes_ned(attitude_rad)
    roll, pitch, yaw = (math.radians(angle) for angle in mount_deg)
    x, y, z = body_axes_ned((roll, pitch, yaw))
    return (
        enu_from_ned(combined(body, x)),
        enu_from_ned(combined(body, y)),
        enu_from_ned(combined(body, z)),
    )


def seen_in_enu(
    measurement: RangingMeasurement, attitude: Attitude | None, antenna: AntennaParams
) -> RangingMeasurement:
    """Return the measurement with its direction in the local frame, where that is known.

    It takes the attitude at the time of measurement; an azimuth about the vertical needs its yaw
    alone. With `auto` it is filled in as an azimuth and as a planar array's. Outside the field of
    view there is no direction. The north-referenced azimuth of a planar array is treated as that of
    a level one. Absurd angles are returned unchanged: the wire may carry infinities, which the
    screen rejects.
    """
    m = measurement
    if antenna.kind in ABOUT_VERTICAL and m.bearing_enu_rad is not None:
        return m
    if antenna.kind != "azimuth" and _has_absurd_angle(m):
        return m
    if m.bearing_body_rad is None:
        if antenna.kind == "planar" and m.bearing_enu_rad is not None and not m.is_array_angle:
            return _with_azimuth(m, -m.bearing_enu_rad, LEVEL)
        return m
    printed_rad = m.bearing_body_rad
    if lost_direction(m, antenna) or attitude is None or not math.isfinite(printed_rad):
        return m
    if antenna.kind in ABOUT_VERTICAL:
        bearing_enu_rad = bearing_enu_from_ned(attitude.yaw_ned_rad + printed_rad)
        m = replace(m, bearing_enu_rad=bearing_enu_rad)
    if attitude.tilt_rad is None or antenna.kind == "azimuth":
        return m
    axes = antenna_axes_enu((*attitude.tilt_rad, attitude.yaw_ned_rad), antenna.mount_deg)
    if antenna.kind == "auto":
        return replace(m, array=ArrayDirection(*axes[:2], printed_rad))
    if antenna.kind == "planar":
        return _with_azimuth(m, printed_rad, axes)
    return _with_cosines(m, m.elevation_rad if antenna.kind == "two_axis" else None, axes)


def _has_absurd_angle(m: RangingMeasurement) -> bool:
    bearings = (m.bearing_enu_rad, m.bearing_body_rad)
    is_plausible = all(b is None or abs(b) <= MAX_BEARING_RAD for b in bearings)
    is_plausible &= m.elevation_rad is None or abs(m.elevation_rad) <= MAX_ELEVATION_RAD
    return not is_plausible


Loss = Literal["", "north", "array", "arcsine", "view"]


def lost_direction(m: RangingMeasurement, antenna: AntennaParams) -> Loss:
    """Return the reason why an angle gives no direction with this antenna; empty if it does."""
    is_azimuth = antenna.kind in (*ABOUT_VERTICAL, "planar")
    if m.bearing_body_rad is None:
        is_by_north = m.bearing_enu_rad is not None and m.array is None
        return "north" if is_by_north and antenna.kind not in ABOUT_VERTICAL else ""
    if m.is_array_angle and is_azimuth:
        return "array"
    if not is_azimuth and abs(m.bearing_body_rad) > MAX_ELEVATION_RAD:
        return "arcsine"
    if _off_boresight_rad(m, antenna) > math.radians(0.5 * antenna.field_of_view_deg):
        return "view"
    return ""


def _off_boresight_rad(m: RangingMeasurement, antenna: AntennaParams) -> float:
    """Return the angle from the boresight, by the angles that the antenna reports."""
    assert m.bearing_body_rad is not None
    if antenna.kind != "two_axis" or m.elevation_rad is None or _has_absurd_angle(m):
        return abs(m.bearing_body_rad)
    return math.asin(min(1.0, math.hypot(math.sin(m.bearing_body_rad), math.sin(m.elevation_rad))))


def _with_azimuth(m: RangingMeasurement, azimuth_rad: float, axes: Axes) -> RangingMeasurement:
    ahead, right, _ = axes
    pointed = combined(axes, (math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0))
    return replace(
        m,
        bearing_enu_rad=math.atan2(pointed[1], pointed[0]),
        array=ArrayDirection(ahead, right, azimuth_rad),
    )


def _with_cosines(
    m: RangingMeasurement, elevation_rad: float | None, axes: Axes
) -> RangingMeasurement:
    """Return the measurement with its cosines, and with a bearing (in front) if both exist."""
    assert m.bearing_body_rad is not None
    _, right, (east, north, up) = axes  # the third axis points down
    above = (-east, -north, -up)
    first = math.sin(m.bearing_body_rad)
    if elevation_rad is None:
        return replace(m, array=ArrayDirection(right, above, first))
    second = math.sin(elevation_rad)
    ahead = math.sqrt(max(0.0, 1.0 - first * first - second * second))
    pointed = combined(axes, (ahead, first, -second))
    bearing_enu_rad = math.atan2(pointed[1], pointed[0])
    array = ArrayDirection(right, above, first, second)
    return replace(m, bearing_enu_rad=bearing_enu_rad, array=array)
