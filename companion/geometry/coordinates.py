"""Conversions between ENU, NED and geodetic coordinates.

The core works in local east-north-up metres about an origin; NED and degrees exist only at the
wire. Converters read target-from-source.

Tiles of web maps are spherical Mercator, `z/x/y` counted from the north-west. Source: OpenStreetMap
wiki, "Slippy map tilenames".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import pymap3d

Triple = tuple[float, float, float]


def ned_from_enu(enu: Triple) -> Triple:
    """Return north-east-down from east-north-up; the exchange is its own inverse."""
    east, north, up = enu
    return (north, east, -up)


def enu_from_ned(ned: Triple) -> Triple:
    """Return east-north-up from north-east-down."""
    north, east, down = ned
    return (east, north, -down)


def wrap_pi(radians: float) -> float:
    """Return the same direction in (-pi, pi]."""
    wrapped = math.remainder(radians, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def bearing_enu_from_ned(bearing_ned_rad: float) -> float:
    """Return the angle counter-clockwise from east, from clockwise from north; its own inverse."""
    return wrap_pi(math.pi / 2.0 - bearing_ned_rad)


def bearing_ned_from_enu(bearing_enu_rad: float) -> float:
    """Return the angle clockwise from north, from one counter-clockwise from east."""
    return wrap_pi(math.pi / 2.0 - bearing_enu_rad)


def body_axes_ned(attitude_rad: Triple) -> tuple[Triple, Triple, Triple]:
    """Return the body's forward, right and down axes in north-east-down, by roll, pitch and yaw.

    Source: MAVLink common, ATTITUDE (Tait-Bryan angles, turned in the order yaw, pitch, roll).
    """
    roll, pitch, yaw = attitude_rad
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return (
        (cp * cy, cp * sy, -sp),
        (sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp),
        (cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp),
    )


def combined(axes: tuple[Triple, Triple, Triple], components: Triple) -> Triple:
    """Return the vector with these components along three axes."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = axes
    a, b, c = components
    return (a * ax + b * bx + c * cx, a * ay + b * by + c * cy, a * az + b * bz + c * cz)


class Projection(Enum):
    """Projection of an autopilot's flat local frame onto the Earth; each has its own."""

    ELLIPSOID = "tangential plane of the WGS84 ellipsoid"
    """Used by no known autopilot; exact, and the default while the autopilot is unknown."""
    SPHERE = "azimuthal equidistant on a sphere"
    """PX4: `lib/geo`, MapProjection. 0.3 % from the ellipsoid: 0.36 m at 124 m."""
    FLAT = "degrees scaled by the middle latitude"
    """ArduPilot: `AP_Common/Location`, offset and get_distance_NE."""


@dataclass(frozen=True, slots=True)
class LocalOrigin:
    """Zero of local east, north and up: the autopilot's EKF origin (not its home).

    It converts positions with the autopilot's own projection, and up is the difference of
    altitudes: an autopilot's local frame follows the curvature of the Earth.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Altitude of the origin above mean sea level, as MAVLink reports it."""
    projection: Projection = Projection.ELLIPSOID
    offset_enu_m: Triple = (0.0, 0.0, 0.0)
    """Fitted offset and scale of the autopilot's pairs of local and global positions: local is
    scale times projected, plus the offset."""
    scale_en: tuple[float, float] = (1.0, 1.0)

    def zero_of(self, other: LocalOrigin) -> Triple:
        """Return another reported origin in this one's frame; a fit does not move a frame."""
        plain = replace(self, offset_enu_m=(0.0, 0.0, 0.0), scale_en=(1.0, 1.0))
        return plain.enu_from_geodetic(other.latitude_deg, other.longitude_deg, other.altitude_m)

    def geodetic_from_enu(self, enu_m: Triple) -> Triple:
        """Return latitude and longitude in degrees and altitude in metres of a local point."""
        (east, north, up), (de, dn, du) = enu_m, self.offset_enu_m
        local = ((east - de) / self.scale_en[0], (north - dn) / self.scale_en[1], up - du)
        match self.projection:
            case Projection.SPHERE:
                return _sphere_geodetic(self, local)
            case Projection.FLAT:
                return _flat_geodetic(self, local)
        lat, lon, alt = pymap3d.enu2geodetic(
            *local, self.latitude_deg, self.longitude_deg, self.altitude_m
        )
        return (float(lat), float(lon), float(alt))

    def enu_from_geodetic(
        self, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> Triple:
        """Return local east, north and up in metres of a geodetic point."""
        geodetic = (latitude_deg, longitude_deg, altitude_m)
        match self.projection:
            case Projection.SPHERE:
                east, north, up = _sphere_enu(self, geodetic)
            case Projection.FLAT:
                east, north, up = _flat_enu(self, geodetic)
            case _:
                east, north, up = map(
                    float,
                    pymap3d.geodetic2enu(
                        *geodetic, self.latitude_deg, self.longitude_deg, self.altitude_m
                    ),
                )
        de, dn, du = self.offset_enu_m
        return (self.scale_en[0] * east + de, self.scale_en[1] * north + dn, up + du)


SPHERE_M = 6_371_000.0
"""Radius of the Earth in PX4, CONSTANTS_RADIUS_OF_EARTH."""
METRES_PER_DEGREE = 0.011131884502145034 * 1e7
"""ArduPilot: LOCATION_SCALING_FACTOR, of 1e-7 degrees."""
MIN_COSINE = 0.01
"""Lower limit of the cosine of latitude, as in ArduPilot's `longitude_scale`."""


def _sphere_enu(origin: LocalOrigin, geodetic: Triple) -> Triple:
    lat0, lat = math.radians(origin.latitude_deg), math.radians(geodetic[0])
    east_rad = math.radians(geodetic[1] - origin.longitude_deg)
    cosine = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(east_rad)
    # near the origin the arc cosine is ill-conditioned; the haversine gives the same angle
    half = math.sin((lat - lat0) / 2.0) ** 2
    half += math.cos(lat0) * math.cos(lat) * math.sin(east_rad / 2.0) ** 2
    angle = 2.0 * math.asin(min(1.0, math.sqrt(half))) if half < 0.5 else math.acos(cosine)
    stretch = SPHERE_M * (angle / math.sin(angle) if angle > 0.0 else 1.0)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(east_rad)
    east = math.cos(lat) * math.sin(east_rad)
    return (stretch * east, stretch * north, geodetic[2] - origin.altitude_m)


def _sphere_geodetic(origin: LocalOrigin, local: Triple) -> Triple:
    east, north, up = local
    x, y = north / SPHERE_M, east / SPHERE_M
    angle = math.hypot(x, y)
    altitude_m = origin.altitude_m + up
    if angle == 0.0:
        return (origin.latitude_deg, origin.longitude_deg, altitude_m)
    lat0 = math.radians(origin.latitude_deg)
    sine, cosine = math.sin(angle), math.cos(angle)
    lat = math.asin(cosine * math.sin(lat0) + x * sine * math.cos(lat0) / angle)
    east_rad = math.atan2(y * sine, angle * math.cos(lat0) * cosine - x * math.sin(lat0) * sine)
    return (math.degrees(lat), _wrapped_deg(origin, math.degrees(east_rad)), altitude_m)


def _flat_enu(origin: LocalOrigin, geodetic: Triple) -> Triple:
    east_deg = math.remainder(geodetic[1] - origin.longitude_deg, 360.0)
    north = (geodetic[0] - origin.latitude_deg) * METRES_PER_DEGREE
    east = east_deg * METRES_PER_DEGREE * _cosine((geodetic[0] + origin.latitude_deg) / 2.0)
    return (east, north, geodetic[2] - origin.altitude_m)


def _flat_geodetic(origin: LocalOrigin, local: Triple) -> Triple:
    east, north, up = local
    north_deg = north / METRES_PER_DEGREE
    east_deg = east / METRES_PER_DEGREE / _cosine(origin.latitude_deg + north_deg / 2.0)
    latitude_deg = origin.latitude_deg + north_deg
    return (latitude_deg, _wrapped_deg(origin, east_deg), origin.altitude_m + up)


def _cosine(latitude_deg: float) -> float:
    return max(MIN_COSINE, math.cos(math.radians(latitude_deg)))


def _wrapped_deg(origin: LocalOrigin, east_deg: float) -> float:
    """Return the longitude `east_deg` from the origin, in the origin's range unless it wraps."""
    longitude_deg = origin.longitude_deg + east_deg
    is_inside = -180.0 <= longitude_deg <= 180.0
    return longitude_deg if is_inside else math.remainder(longitude_deg, 360.0)


LATITUDES_DEG = 85.0
"""Largest latitude used, slightly inside the edge of the square map."""
Degrees = tuple[float, float]
"""Latitude and longitude."""


def tile_at(position_deg: Degrees, zoom: int) -> tuple[int, int]:
    """Return x and y of the tile that contains a position."""
    count = 2**zoom
    latitude_rad = math.radians(max(-LATITUDES_DEG, min(LATITUDES_DEG, position_deg[0])))
    x = (position_deg[1] + 180.0) / 360.0 * count
    y = (1.0 - math.asinh(math.tan(latitude_rad)) / math.pi) / 2.0 * count
    return min(max(int(x), 0), count - 1), min(max(int(y), 0), count - 1)


def corner_of(x: int, y: int, zoom: int) -> Degrees:
    """Return the north-west corner of a tile, which is the south-east one of (x - 1, y - 1)."""
    count = 2**zoom
    latitude_rad = math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / count)))
    return math.degrees(latitude_rad), 360.0 * x / count - 180.0
