"""Tiles of the usual web map: spherical Mercator, `z/x/y` counted from the north-west.

Source: OpenStreetMap wiki, "Slippy map tilenames".
"""

from __future__ import annotations

import math

LATITUDES_DEG = 85.0
"""Largest latitude used, slightly inside the edge of the square map."""
Degrees = tuple[float, float]
"""Latitude and longitude."""


def tile_at(place: Degrees, zoom: int) -> tuple[int, int]:
    """Return x and y of the tile that contains a position."""
    count = 2**zoom
    latitude_rad = math.radians(max(-LATITUDES_DEG, min(LATITUDES_DEG, place[0])))
    x = (place[1] + 180.0) / 360.0 * count
    y = (1.0 - math.asinh(math.tan(latitude_rad)) / math.pi) / 2.0 * count
    return min(max(int(x), 0), count - 1), min(max(int(y), 0), count - 1)


def corner_of(x: int, y: int, zoom: int) -> Degrees:
    """Return the north-west corner of a tile, which is the south-east one of (x - 1, y - 1)."""
    count = 2**zoom
    latitude_rad = math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / count)))
    return math.degrees(latitude_rad), 360.0 * x / count - 180.0
