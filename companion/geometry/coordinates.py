"""ENU, NED and geodetic coordinates.

The core works in local east-north-up metres about an origin; NED and degrees exist only at the
wire. Converters read target-from-source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pymap3d

Triple = tuple[float, float, float]


def ned_from_enu(enu: Triple) -> Triple:
    """North-east-down from east-north-up; the exchange is its own inverse."""
    east, north, up = enu
    return (north, east, -up)


def enu_from_ned(ned: Triple) -> Triple:
    """East-north-up from north-east-down."""
    north, east, down = ned
    return (east, north, -down)


def wrap_pi(radians: float) -> float:
    """The same direction in (-pi, pi]."""
    wrapped = math.remainder(radians, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def bearing_enu_from_ned(bearing_ned_rad: float) -> float:
    """Counter-clockwise from east, from clockwise from north; its own inverse."""
    return wrap_pi(math.pi / 2.0 - bearing_ned_rad)


def bearing_ned_from_enu(bearing_enu_rad: float) -> float:
    """Clockwise from north, from counter-clockwise from east."""
    return wrap_pi(math.pi / 2.0 - bearing_enu_rad)


@dataclass(frozen=True, slots=True)
class LocalOrigin:
    """Where local east, north and up are zero: the autopilot's EKF origin (not its home)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above mean sea level, as MAVLink reports it."""

    def geodetic_from_enu(self, enu_m: Triple) -> Triple:
        """Latitude and longitude in degrees and altitude in metres of a local point."""
        lat, lon, alt = pymap3d.enu2geodetic(
            *enu_m, self.latitude_deg, self.longitude_deg, self.altitude_m
        )
        return (float(lat), float(lon), float(alt))

    def enu_from_geodetic(
        self, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> Triple:
        """Local east, north and up in metres of a geodetic point."""
        east, north, up = pymap3d.geodetic2enu(
            latitude_deg,
            longitude_deg,
            altitude_m,
            self.latitude_deg,
            self.longitude_deg,
            self.altitude_m,
        )
        return (float(east), float(north), float(up))
