"""Map tiles from a folder, embedded below the map of a report."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

from companion.geometry.coordinates import LocalOrigin, corner_of, tile_at
from companion.geometry.polygons import Point
from companion.web.settings import zooms_of

MOST_TILES = 24
"""Most tiles of a page; at some 20 kB each, as much as the rest of a long report."""
KINDS = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg", b"RIFF": "webp"}
"""Magic numbers of pictures, whatever the names of their files."""
MOST_BYTES = 2_000_000


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture on the map, from its north-western to its south-eastern corner, local metres."""

    url: str
    north_west_enu_m: Point
    south_east_enu_m: Point


def pictures_of(
    folder: Path, origin: LocalOrigin, bounds: tuple[float, float, float, float]
) -> list[Picture]:
    """Return the tiles under a map (west, east, south, north; local metres), finest first."""
    zooms = zooms_of(folder)
    if zooms is None:
        return []
    west, east, south, north = bounds
    first = origin.geodetic_from_enu((west, north, 0.0))[:2]
    last = origin.geodetic_from_enu((east, south, 0.0))[:2]
    for zoom in range(zooms[1], zooms[0] - 1, -1):
        (left, top), (right, bottom) = tile_at(first, zoom), tile_at(last, zoom)
        if (right - left + 1) * (bottom - top + 1) > MOST_TILES:
            continue
        found = [
            _picture(folder, origin, x, y, zoom)
            for x in range(left, right + 1)
            for y in range(top, bottom + 1)
        ]
        if pictures := [each for each in found if each is not None]:
            return pictures
    return []


def _picture(folder: Path, origin: LocalOrigin, x: int, y: int, zoom: int) -> Picture | None:
    path = folder / str(zoom) / str(x) / f"{y}.png"
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES)
    except OSError:
        return None
    kind = next((kind for head, kind in KINDS.items() if data.startswith(head)), None)
    if kind is None:
        return None
    url = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    corners = (corner_of(x, y, zoom), corner_of(x + 1, y + 1, zoom))
    places = [origin.enu_from_geodetic(*corner, origin.altitude_m) for corner in corners]
    return Picture(url, places[0][:2], places[1][:2])
