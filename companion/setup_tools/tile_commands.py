"""`companion tiles`: a folder of map tiles for the live map, from a server."""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
import urllib.request
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from companion import __version__
from companion.errors import CompanionError, ConfigError
from companion.geometry.coordinates import LATITUDES_DEG, tile_at

MOST_TILES = 20_000
"""Most tiles of one fetch; more is a burden to a server that others pay for."""
PAUSE_S = 0.05
TIMEOUT_S = 20.0
MOST_BYTES = 2_000_000
"""Most bytes of one tile."""
METRES_PER_DEGREE = 111_319.5
SIGNATURES = (b"\x89PNG", b"\xff\xd8\xff", b"RIFF")
"""Magic numbers of PNG, JPEG and WebP."""


@dataclass(frozen=True, slots=True)
class Tile:
    """One picture; `y` counts from the north, as `z/x/y.png` does."""

    zoom: int
    x: int
    y: int
    picture: bytes


def run(arguments: argparse.Namespace) -> int:
    """Fetch missing tiles, and return the exit code."""
    places = wanted_tiles(arguments.around, arguments.radius, arguments.zoom)
    if not arguments.url.startswith(("http://", "https://")):
        raise ConfigError(f"{arguments.url}: must begin with http:// or https://")
    if not all(part in arguments.url for part in ("{z}", "{x}", "{y}")):
        raise ConfigError(f"{arguments.url}: must have {{z}}, {{x}} and {{y}} in it")
    url = arguments.url
    missing = [each for each in places if not _file(arguments.folder, *each).exists()]
    count, folder = _stored(_fetched(url, missing), arguments.folder), arguments.folder
    sys.stdout.write(f"{count} tiles in {folder}; show them with: --web-tiles {folder}\n")
    return 0


def wanted_tiles(around: str, radius_m: float, zooms: str) -> list[tuple[int, int, int]]:
    """Return zoom, x and y of every tile that a square about a place touches."""
    try:
        latitude_deg, longitude_deg = map(float, around.split(","))
    except ValueError:
        raise ConfigError(f"--around {around}: give LAT,LON in degrees, as in 47.4,8.55") from None
    if not (abs(latitude_deg) <= LATITUDES_DEG and abs(longitude_deg) <= 180.0):
        raise ConfigError(f"--around {around}: no such place on a map of tiles")

    match = re.fullmatch(r"(\d+)(?:-(\d+))?", zooms)
    least = int(match[1]) if match else -1
    most = int(match[2] or match[1]) if match else -1
    if not 0 <= least <= most <= 22:
        raise ConfigError(f"--zoom {zooms}: give MIN-MAX between 0 and 22, as in 13-17")

    if not 0.0 < radius_m <= 100_000.0:
        raise ConfigError(f"--radius {radius_m:g}: give metres, up to 100000")
    north_deg = radius_m / METRES_PER_DEGREE
    east_deg = north_deg / math.cos(math.radians(latitude_deg))
    wanted: list[tuple[int, int, int]] = []
    for zoom in range(least, most + 1):
        left, top = tile_at((latitude_deg + north_deg, longitude_deg - east_deg), zoom)
        right, bottom = tile_at((latitude_deg - north_deg, longitude_deg + east_deg), zoom)
        if len(wanted) + (right - left + 1) * (bottom - top + 1) > MOST_TILES:
            raise ConfigError(
                f"--zoom {zooms}: more than {MOST_TILES} tiles; choose a smaller --radius or zoom"
            )
        wanted += [(zoom, x, y) for x in range(left, right + 1) for y in range(top, bottom + 1)]
    return wanted


def _fetched(url: str, places: Iterable[tuple[int, int, int]]) -> Iterator[Tile]:
    """Yield tiles one after the other, unhurried; those before a failure are kept by the caller."""
    for zoom, x, y in places:
        address = url.replace("{z}", str(zoom)).replace("{x}", str(x)).replace("{y}", str(y))
        agent = {"User-Agent": f"companion-guidance/{__version__}"}
        try:
            request = urllib.request.Request(address, headers=agent)
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                picture = answer.read(MOST_BYTES + 1)
        except (OSError, ValueError) as error:
            reason = getattr(error, "reason", None) or error
            raise CompanionError(
                f"{address}: {reason}; what came before is kept, so run it again to go on"
            ) from error
        if len(picture) > MOST_BYTES:
            raise CompanionError(f"{address}: more than {MOST_BYTES} bytes, which is no map tile")
        yield Tile(zoom, x, y, picture)
        time.sleep(PAUSE_S)


def _stored(tiles: Iterable[Tile], folder: Path) -> int:
    """Write tiles as `z/x/y.png`, whatever their kind of picture; return their number."""
    count = 0
    for tile in tiles:
        if not tile.picture.startswith(SIGNATURES):
            raise CompanionError(f"tile {tile.zoom}/{tile.x}/{tile.y}: is no picture")
        file = _file(folder, tile.zoom, tile.x, tile.y)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            part.write_bytes(tile.picture)
            part.replace(file)
        except OSError as error:
            raise CompanionError(f"{file}: cannot be written ({error.strerror})") from error
        count += 1
    return count


def _file(folder: Path, zoom: int, x: int, y: int) -> Path:
    return folder / str(zoom) / str(x) / f"{y}.png"
