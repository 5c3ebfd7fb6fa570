"""A folder of map tiles, `z/x/y.png`: what is in it."""

from __future__ import annotations

from pathlib import Path

NO_TILE = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c489"
    "0000000b49444154789c6360000200000500017a5eab3f0000000049454e44ae426082"
)
"""One transparent pixel as PNG: what the map shows where there is no tile."""


def zooms_of(folder: Path) -> tuple[int, int] | None:
    """The least and the most zoom that there is a tile of; None: no tile at all.

    Args:
        folder: With `z/x/y.png` in it, z, x and y being numbers.
    """
    folders = [path for path in folder.iterdir() if path.name.isdecimal()]
    zooms = [int(path.name) for path in folders if _has_tile(path)]
    return (min(zooms), max(zooms)) if zooms else None


def _has_tile(zoom: Path) -> bool:
    return any(
        tile.stem.isdecimal() and tile.parent.name.isdecimal() for tile in zoom.glob("*/*.png")
    )


def tile(folder: Path, zoom: int, x: int, y: int) -> bytes:
    """A tile as PNG, a transparent one where there is none."""
    try:
        return (folder / str(zoom) / str(x) / f"{y}.png").read_bytes()
    except OSError:
        return NO_TILE
