"""Archives of map tiles, read tile by tile: MBTiles and PMTiles.

Sources: MBTiles 1.3 (rows count from the south), PMTiles specification version 3 (directories of
variable-length integers, tiles along a Hilbert curve).
"""

from __future__ import annotations

import gzip
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from companion.errors import ConfigError

PMTILES = b"PMTiles"
SQLITE = b"SQLite format 3\x00"
PICTURES = {2: "png", 3: "jpg", 4: "webp"}
"""Tile types of PMTiles that a map of pictures can show."""
NOT_PICTURES = "has no pictures in it (vector tiles?); export it as PNG, JPEG or WebP"
NONE, GZIP = 1, 2
MOST_ENTRIES = 2_000_000
MOST_DEPTH = 4
MAX_ZOOM = 26


@dataclass(frozen=True, slots=True)
class Tile:
    """One picture; `y` counts from the north, as `z/x/y.png` does."""

    zoom: int
    x: int
    y: int
    picture: bytes


def tiles_in(path: Path) -> Iterator[Tile]:
    """Every tile of an archive; a `ConfigError` if it is none, is damaged, or has no pictures."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
            if head == SQLITE:
                yield from _of_mbtiles(path)
            elif head.startswith(PMTILES):
                file.seek(0)
                yield from _of_pmtiles(path, file)
            else:
                raise ConfigError(f"{path}: is neither MBTiles nor PMTiles")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (sqlite3.Error, struct.error, EOFError, IndexError, ValueError) as error:
        raise ConfigError(f"{path}: is damaged ({error})") from error


def _of_mbtiles(path: Path) -> Iterator[Tile]:
    with closing(sqlite3.connect(f"file:{path.absolute()}?mode=ro", uri=True)) as archive:
        told = archive.execute("SELECT value FROM metadata WHERE name = 'format'").fetchone()
        if told is not None and told[0] not in ("png", "jpg", "jpeg", "webp"):
            raise ConfigError(f"{path}: {NOT_PICTURES}")
        rows = archive.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles")
        for zoom, column, row, picture in rows:
            if not 0 <= zoom <= MAX_ZOOM:
                raise ValueError(f"zoom {zoom}")
            yield Tile(zoom, column, 2**zoom - 1 - row, bytes(picture))


@dataclass(frozen=True, slots=True)
class _Header:
    root: tuple[int, int]
    leaves_at: int
    tiles_at: int
    compression: int


def _of_pmtiles(path: Path, file: BinaryIO) -> Iterator[Tile]:
    head = file.read(127)
    root_at, root_size, _, _, leaves_at, _, tiles_at = struct.unpack_from("<7Q", head, 8)
    version, compression, kind = head[7], head[97], head[99]
    if version != 3:
        raise ConfigError(f"{path}: is PMTiles of version {version}; convert it to version 3")
    if kind not in PICTURES:
        raise ConfigError(f"{path}: {NOT_PICTURES}")
    if compression not in (NONE, GZIP):
        raise ConfigError(f"{path}: its directories are packed in a way that is not read here")
    header = _Header((root_at, root_size), leaves_at, tiles_at, compression)
    yield from _of_directory(file, header, header.root, 0)


def _of_directory(
    file: BinaryIO, header: _Header, place: tuple[int, int], depth: int
) -> Iterator[Tile]:
    if depth > MOST_DEPTH:
        raise ValueError("directories too deep")
    data = _read(file, *place)
    if header.compression == GZIP:
        data = gzip.decompress(data)
    for first, run, at, size in _entries(data):
        if run == 0:
            yield from _of_directory(file, header, (header.leaves_at + at, size), depth + 1)
            continue
        picture = _read(file, header.tiles_at + at, size)
        for tile_id in range(first, first + run):
            yield Tile(*_place_of(tile_id), picture)


def _read(file: BinaryIO, at: int, size: int) -> bytes:
    file.seek(at)
    data = file.read(size)
    if len(data) < size:
        raise EOFError("it ends too early")
    return data


def _entries(data: bytes) -> list[tuple[int, int, int, int]]:
    """Id of the first tile, how many show the same picture (0: a directory), offset, length."""
    numbers = _integers(data)
    count = next(numbers)
    if count > MOST_ENTRIES:
        raise ValueError("too many entries")
    ids, last = [], 0
    for _ in range(count):
        last += next(numbers)
        ids.append(last)
    runs = [next(numbers) for _ in range(count)]
    sizes = [next(numbers) for _ in range(count)]
    offsets: list[int] = []
    for index in range(count):
        told = next(numbers)
        offsets.append(told - 1 if told else offsets[-1] + sizes[index - 1])
    return list(zip(ids, runs, offsets, sizes, strict=True))


def _integers(data: bytes) -> Iterator[int]:
    """Numbers of seven bits a byte, the lowest first; the top bit says that more follow."""
    value, shift = 0, 0
    for byte in data:
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            yield value
            value, shift = 0, 0
    raise EOFError("a directory ends too early")


def _place_of(tile_id: int) -> tuple[int, int, int]:
    """Zoom, x and y of a number along the Hilbert curves of all zooms, one after the other."""
    zoom, before = 0, 0
    while before + 4**zoom <= tile_id:
        before += 4**zoom
        zoom += 1
        if zoom > MAX_ZOOM:
            raise ValueError(f"tile {tile_id}")
    x = y = 0
    rest = tile_id - before
    for level in range(zoom):
        side = 2**level
        right = 1 & (rest // 2)
        up = 1 & (rest ^ right)
        if up == 0:
            if right == 1:
                x, y = side - 1 - x, side - 1 - y
            x, y = y, x
        x, y = x + side * right, y + side * up
        rest //= 4
    return zoom, x, y
