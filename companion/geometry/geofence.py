"""Geofence in degrees: polygons and circles, and their conversion to local metres.

Theory of operation. A file or an autopilot gives areas, each with its path in that source. The one
inclusion is the fence, every exclusion a keep-out. Circles become polygons on the safe side: the
fence's inside its circle, a keep-out's around it. Positions are converted through geocentric
coordinates (pymap3d), so the antimeridian needs no special case; near the poles east and north are
ill-defined, and 0/0 is a common placeholder for an unknown position, so both are rejected.

An autopilot's own local frame is simpler than that: PX4 projects from a sphere of 6371.0 km,
ArduPilot scales degrees by 111.319 km, while the ellipsoid's radii of curvature are 6335 to 6400
km. A local fence may therefore be off by 0.7 % of its distance from the origin; `distortion_m` is
that distance in metres, for the margin.

Several inclusions are rejected: MAVLink, PX4 and ArduPilot do not agree on whether a vehicle must
be inside one or inside all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.obstacles import MAX_CORNERS
from companion.geometry.polygons import (
    Corners,
    Point,
    area_m2,
    edges,
    is_simple,
    nearest_on_segment,
)

LatLon = tuple[float, float]

MAX_LATITUDE_DEG = 85.0
"""Latitude beyond which east and north are ill-defined."""
MAX_REACH_M = 20_000.0
"""Largest distance of a fence from the origin of a flat local frame."""
MIN_RADIUS_M = 1.0
"""Smallest circle, metres, and smallest polygon, square metres, that a vehicle can use."""
MIN_AREA_M2 = 1.0
"""Smallest area of a polygon."""
CIRCLE_CORNERS = 36
"""Corners of a circle's polygon, which is at most 0.4 % of the radius inside its circle."""
DISTORTION = 0.007
"""Largest relative error of an autopilot's local frame, from the radii above."""
COMPARED_EVERY_M = 5.0
"""Distance between compared points along a border."""
COMPARED_POINTS = 400
"""Approximate limit of compared points on a long border."""


@dataclass(frozen=True, slots=True)
class GeoArea:
    """Polygon, or circle about its only corner."""

    corners_deg: tuple[LatLon, ...]
    radius_m: float | None = None
    """Radius of a circle; None: a polygon."""


@dataclass(frozen=True, slots=True)
class NamedArea:
    """Area with its path in the file or plan."""

    path: str
    is_inclusion: bool
    area: GeoArea


@dataclass(frozen=True, slots=True)
class LocalFence:
    """Fence in local east and north."""

    polygon_enu_m: Corners
    keep_out_enu_m: tuple[Corners, ...] = ()
    distortion_m: float = 0.0
    """Largest distance between this fence and the one in the autopilot's own frame."""


@dataclass(frozen=True, slots=True)
class GeoFence:
    """Inclusion that a vehicle stays inside, and exclusions that it stays outside."""

    inclusion: GeoArea
    exclusions: tuple[GeoArea, ...] = ()

    def local(self, origin: LocalOrigin) -> LocalFence:
        """Return the fence in the local frame of an origin; `ValueError` if it is too far away."""
        polygon = _local_area(self.inclusion, origin, is_inside=True)
        keep_outs = tuple(_local_area(area, origin, is_inside=False) for area in self.exclusions)
        reach_m = max(math.hypot(*corner) for corner in polygon)
        if reach_m > MAX_REACH_M:
            raise ValueError(
                f"a corner of the fence is {reach_m / 1000.0:.0f} km from the autopilot's origin "
                f"(at most {MAX_REACH_M / 1000.0:g} km)"
            )
        return LocalFence(polygon, keep_outs, DISTORTION * reach_m)

    @property
    def centre(self) -> LocalOrigin:
        """Nearby origin: the first corner."""
        return LocalOrigin(*self.inclusion.corners_deg[0], 0.0)


def corner_problem(latitude_deg: float, longitude_deg: float) -> str | None:
    """Return the reason why a latitude and longitude are no valid corner, or None."""
    if not (math.isfinite(latitude_deg) and math.isfinite(longitude_deg)):
        return "is not a finite number"
    if latitude_deg == 0.0 and longitude_deg == 0.0:
        return "0/0 means that the position is unknown"
    if abs(latitude_deg) > 90.0 or abs(longitude_deg) > 180.0:
        return f"{latitude_deg:g}/{longitude_deg:g} is not a latitude and longitude in degrees"
    if abs(latitude_deg) > MAX_LATITUDE_DEG:
        return f"latitude {latitude_deg:g} is too near to a pole (at most {MAX_LATITUDE_DEG:g})"
    return None


def area_problem(area: GeoArea) -> str | None:
    """Return the reason why an area, its corners checked, encloses no usable space, or None."""
    if area.radius_m is not None:
        if MIN_RADIUS_M <= area.radius_m <= MAX_REACH_M:
            return None
        return f"a radius of {area.radius_m:g} m is not from {MIN_RADIUS_M:g} to {MAX_REACH_M:g} m"
    if len(area.corners_deg) < 3:
        return f"has {len(area.corners_deg)} corners, at least 3 make a polygon"
    if len(area.corners_deg) > MAX_CORNERS:
        return f"has {len(area.corners_deg)} corners, at most {MAX_CORNERS} can be checked in time"
    origin = LocalOrigin(*area.corners_deg[0], 0.0)
    polygon = _local_area(area, origin, is_inside=True)
    reach_m = max(math.hypot(*corner) for corner in polygon)
    if reach_m > 2.0 * MAX_REACH_M:
        return f"is {reach_m / 1000.0:.0f} km wide"
    if not is_simple(polygon):
        return "two of its edges touch or cross each other"
    return None if area_m2(polygon) >= MIN_AREA_M2 else "encloses no area"


def fence_of(areas: Sequence[NamedArea]) -> GeoFence:
    """Return the fence that areas form; a `ValueError` begins with the path of a wrong one."""
    for named in areas:
        for index, (latitude_deg, longitude_deg) in enumerate(named.area.corners_deg):
            problem = corner_problem(latitude_deg, longitude_deg)
            if problem is not None:
                raise ValueError(f"{named.path}: corner {index + 1}: {problem}")
        problem = area_problem(named.area)
        if problem is not None:
            raise ValueError(f"{named.path}: {problem}")
    inclusions = [named for named in areas if named.is_inclusion]
    if not inclusions:
        raise ValueError("no inclusion area: nothing says where the vehicle may be")
    if len(inclusions) > 1:
        raise ValueError(
            f"{inclusions[1].path}: a second inclusion area; autopilots do not agree on what "
            "several mean, so give one, and areas to avoid as exclusions"
        )
    corners = sum(CIRCLE_CORNERS if a.area.radius_m else len(a.area.corners_deg) for a in areas)
    if corners > MAX_CORNERS:
        raise ValueError(
            f"{corners} corners in all (a circle counts as {CIRCLE_CORNERS}); at most "
            f"{MAX_CORNERS} can be checked in time"
        )
    exclusions = tuple(named.area for named in areas if not named.is_inclusion)
    return GeoFence(inclusions[0].area, exclusions)


def difference(
    own: LocalFence,
    other: LocalFence,
    tolerance_m: float,
    more_keep_out_enu_m: Sequence[Corners] = (),
) -> str | None:
    """Describe the difference of two fences beyond a tolerance; None if there is none.

    Borders are compared both ways, at every corner and every 5 m between (on long ones, at about
    400 points). `more_keep_out_enu_m` are keep-outs of ours that the autopilot may lack.
    """
    apart_m, point = _apart(own.polygon_enu_m, other.polygon_enu_m)
    if apart_m > tolerance_m:
        return f"borders up to {apart_m:.1f} m apart, at {_named(point)}"
    ours = (*own.keep_out_enu_m, *more_keep_out_enu_m)
    for some, others, lacks in (
        (own.keep_out_enu_m, other.keep_out_enu_m, "the autopilot's has no such exclusion"),
        (other.keep_out_enu_m, ours, "ours has no such exclusion"),
    ):
        for keep_out in some:
            nearest = min((_apart(keep_out, another) for another in others), default=None)
            if nearest is None or nearest[0] > tolerance_m:
                by = "" if nearest is None else f" (the nearest is {nearest[0]:.1f} m off)"
                return f"exclusion at {_named(keep_out[0])}: {lacks}{by}"
    return None


def _named(point: Point) -> str:
    return f"{point[0]:.0f} m east, {point[1]:.0f} m north"


def _apart(one: Corners, other: Corners) -> tuple[float, Point]:
    """Return the largest distance of either border from the other, and where (Hausdorff)."""
    return max(_reach(one, other), _reach(other, one))


def _reach(one: Corners, other: Corners) -> tuple[float, Point]:
    sides = tuple(edges(other))

    def off_m(point: Point) -> float:
        return min(math.dist(point, nearest_on_segment(a, b, point)) for a, b in sides)

    return max((off_m(point), point) for point in _along(one))


def _along(border: Corners) -> list[Point]:
    points, length_m = [], sum(math.dist(a, b) for a, b in edges(border))
    every_m = max(COMPARED_EVERY_M, length_m / COMPARED_POINTS)
    for (e0, n0), (e1, n1) in edges(border):
        steps = max(1, math.ceil(math.hypot(e1 - e0, n1 - n0) / every_m))
        shares = [step / steps for step in range(steps)]
        points += [(e0 + share * (e1 - e0), n0 + share * (n1 - n0)) for share in shares]
    return points


def _local_area(area: GeoArea, origin: LocalOrigin, *, is_inside: bool) -> Corners:
    corners = tuple(
        origin.enu_from_geodetic(latitude_deg, longitude_deg, origin.altitude_m)[:2]
        for latitude_deg, longitude_deg in area.corners_deg
    )
    if area.radius_m is None:
        return corners
    half_rad = math.pi / CIRCLE_CORNERS
    radius_m = area.radius_m if is_inside else area.radius_m / math.cos(half_rad)
    return circle_about(corners[0], radius_m)


def circle_about(middle: Point, radius_m: float) -> Corners:
    """Return a polygon whose corners lie on a circle."""
    east, north = middle
    turns = [2.0 * (math.pi / CIRCLE_CORNERS) * index for index in range(CIRCLE_CORNERS)]
    return tuple(
        (east + radius_m * math.cos(turn), north + radius_m * math.sin(turn)) for turn in turns
    )
