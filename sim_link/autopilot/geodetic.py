"""Latitude, longitude and altitude of a vehicle that reports them fifty times a second.

Theory of operation. The exact conversion takes longer than everything else in such a report. Inside
a cube of 64 m it is linear to better than a millimetre, so the exact place of the cube's centre and
the slopes there are kept, and made anew when the vehicle leaves the cube. The result depends on the
place only, not on the way there.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import PositionEnu
from companion.geometry.frames import LocalOrigin

CUBE_M = 64.0
SLOPE_M = 16.0
"""Distance from the centre over which the slopes are taken."""

Place = tuple[float, float, float]
"""Latitude and longitude, degrees, and altitude, metres."""


@dataclass(frozen=True, slots=True)
class _Cube:
    number: tuple[int, int, int]
    centre_enu_m: PositionEnu
    place: Place
    by_east: Place
    by_north: Place
    by_up: Place


class GeodeticReports:
    """Converts places that follow each other.

    Args:
        origin: Zero of the local frame.
    """

    def __init__(self, origin: LocalOrigin) -> None:
        self._origin = origin
        self._cube = self._cube_of((0, 0, 0))

    def geodetic_from_enu(self, enu_m: PositionEnu) -> Place:
        """The place of a local point, to a millimetre."""
        east, north, up = enu_m
        number = (int(east // CUBE_M), int(north // CUBE_M), int(up // CUBE_M))
        if number != self._cube.number:
            self._cube = self._cube_of(number)
        cube = self._cube
        de = east - cube.centre_enu_m[0]
        dn = north - cube.centre_enu_m[1]
        du = up - cube.centre_enu_m[2]
        (lat, lon, alt), (lat_e, lon_e, alt_e) = cube.place, cube.by_east
        (lat_n, lon_n, alt_n), (lat_u, lon_u, alt_u) = cube.by_north, cube.by_up
        return (
            lat + de * lat_e + dn * lat_n + du * lat_u,
            lon + de * lon_e + dn * lon_n + du * lon_u,
            alt + de * alt_e + dn * alt_n + du * alt_u,
        )

    def _cube_of(self, number: tuple[int, int, int]) -> _Cube:
        east, north, up = ((n + 0.5) * CUBE_M for n in number)
        return _Cube(
            number,
            (east, north, up),
            self._origin.geodetic_from_enu((east, north, up)),
            self._slope((east - SLOPE_M, north, up), (east + SLOPE_M, north, up)),
            self._slope((east, north - SLOPE_M, up), (east, north + SLOPE_M, up)),
            self._slope((east, north, up - SLOPE_M), (east, north, up + SLOPE_M)),
        )

    def _slope(self, start_enu_m: PositionEnu, end_enu_m: PositionEnu) -> Place:
        starts = self._origin.geodetic_from_enu(start_enu_m)
        ends = self._origin.geodetic_from_enu(end_enu_m)
        lat, lon, alt = (
            (end - start) / (2.0 * SLOPE_M) for start, end in zip(starts, ends, strict=True)
        )
        return (lat, lon, alt)
