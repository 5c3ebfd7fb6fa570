"""Outlines and gaps of a search grid: where something holds, as polygons and in words.

Outlines run along the sides of cells and claim nothing finer than the grid does. The outside is
counter-clockwise and holes are clockwise, as RFC 7946 wants it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.geometry.polygons import Corners, Point, contains, signed_area_m2
from companion.search.search_grid import Bools, SearchGrid
from companion.search.searched_area import SearchState

Node = tuple[int, int]
"""Row and column of a corner of cells."""
LEFT_TO_RIGHT = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Directions (rows, columns): east, north, west, south; each is to the left of the one before."""


@dataclass(frozen=True, slots=True)
class Outline:
    """A polygon with its holes."""

    outside_enu_m: Corners
    holes_enu_m: tuple[Corners, ...] = ()


def outlines(grid: SearchGrid, wanted: Bools) -> list[Outline]:
    """Return the polygons about the cells, of those inside, for which `wanted` holds."""
    image = np.zeros(grid.inside.shape, dtype=bool)
    image[grid.inside] = wanted
    rings = [_in_metres(grid, ring) for ring in _rings(image)]
    outsides = [ring for ring in rings if signed_area_m2(ring) > 0.0]
    holes = [ring for ring in rings if signed_area_m2(ring) < 0.0]
    return [
        Outline(outside, tuple(hole for hole in holes if _is_around(outside, hole, grid, outsides)))
        for outside in outsides
    ]


def _is_around(outside: Corners, hole: Corners, grid: SearchGrid, outsides: list[Corners]) -> bool:
    """Return True if this outside is the smallest one around a hole."""
    east, north = min(hole)  # westernmost, then southernmost: the cell west of it is wanted
    inside = (east - 0.5 * grid.cell_m, north + 0.5 * grid.cell_m)
    around = [each for each in outsides if contains(each, inside)]
    return min(around, key=lambda each: abs(signed_area_m2(each))) is outside


def _rings(image: Bools) -> Iterator[list[Node]]:
    """Closed ways along sides, what is wanted on their left; where two meet, they stay apart."""
    padded = np.pad(image, 1)
    leaving: dict[Node, list[int]] = {}

    def add(sides: Bools, direction: int, shift: Node) -> None:
        for row, column in np.argwhere(sides):
            node = (int(row) + shift[0], int(column) + shift[1])
            leaving.setdefault(node, []).append(direction)

    inner = padded[1:-1, 1:-1]
    add(inner & ~padded[:-2, 1:-1], 0, (0, 0))  # nothing to the south: its side runs east
    add(inner & ~padded[1:-1, 2:], 1, (0, 1))
    add(inner & ~padded[2:, 1:-1], 2, (1, 1))
    add(inner & ~padded[1:-1, :-2], 3, (1, 0))
    while leaving:
        yield from _followed(leaving)


def _followed(leaving: dict[Node, list[int]]) -> Iterator[list[Node]]:
    """The rings of one way around, taken out; a way that meets itself at a corner is cut there."""
    node, before = min(leaving), 0
    way: list[Node] = []
    position: dict[Node, int] = {}
    while True:
        if node in position:
            ring = way[position[node] :]
            del way[position[node] :]
            for passed in ring:
                del position[passed]
            yield _corners(ring)
            if node not in leaving:
                return
        position[node] = len(way)
        way.append(node)
        choices = leaving[node]
        # Turning left where two cells touch at a corner keeps their polygons apart.
        before = min(choices, key=lambda d: (before + 1 - d) % 4)
        choices.remove(before)
        if not choices:
            del leaving[node]
        rows, columns = LEFT_TO_RIGHT[before]
        node = (node[0] + rows, node[1] + columns)


def _corners(ring: list[Node]) -> list[Node]:
    """The nodes of a ring at which it turns."""
    sides = zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1], strict=True)
    return [at for a, at, b in sides if not a[0] == at[0] == b[0] and not a[1] == at[1] == b[1]]


def _in_metres(grid: SearchGrid, ring: list[Node]) -> tuple[Point, ...]:
    return tuple(
        (grid.west_m + column * grid.cell_m, grid.south_m + row * grid.cell_m)
        for row, column in ring
    )


GAP_POD = 0.5
"""Cells of a gap: there it would rather have been missed than heard."""
LEAST_GAP_SHARE = 0.02
"""Least share of the probability; smaller gaps are not reported."""
MOST_GAPS = 3
COMPASS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")


@dataclass(frozen=True, slots=True)
class Gap:
    """Cells that hang together and were hardly searched."""

    name: str
    """Name for the radio, such as "NE corner"."""
    share_of_area: float
    poa: float
    """Probability that the emitter is in it, before the search."""
    cells: Bools


def gaps_of(state: SearchState) -> list[Gap]:
    """Return the gaps that are worth a word, that with the greatest chance first."""
    grid = state.grid
    found = [
        Gap(place_name(grid, cells), float(cells.mean()), float(grid.poa[cells].sum()), cells)
        for cells in pieces_of(grid, state.pod < GAP_POD)
    ]
    worthy = [gap for gap in found if gap.poa >= LEAST_GAP_SHARE]
    return sorted(worthy, key=lambda gap: -gap.poa)[:MOST_GAPS]


def pieces_of(grid: SearchGrid, wanted: Bools) -> Iterator[Bools]:
    """Groups of cells that share sides."""
    padded = np.pad(grid.inside, 1)
    width, where = padded.shape[1], np.flatnonzero(padded).tolist()
    number = np.where(padded, np.cumsum(padded).reshape(padded.shape) - 1, -1).ravel().tolist()
    left = set(np.flatnonzero(wanted).tolist())
    while left:
        begin = left.pop()
        group, queue = [begin], deque([begin])
        while queue:
            here = where[queue.popleft()]
            for to in (1, width, -1, -width):
                beside = number[here + to]
                if beside in left:
                    left.remove(beside)
                    group.append(beside)
                    queue.append(beside)
        cells = np.zeros(len(wanted), dtype=bool)
        cells[group] = True
        yield cells


def place_name(grid: SearchGrid, cells: Bools) -> str:
    """Return where in the area cells lie, as a person says it: `NE corner`, `W side`, `centre`."""
    if cells.mean() > 0.5:
        return "most of the area"
    centres = grid.centres_enu_m
    low, high = centres.min(axis=0), centres.max(axis=0)
    half = np.maximum(0.5 * (high - low), grid.cell_m)
    east, north = (centres[cells].mean(axis=0) - 0.5 * (low + high)) / half
    if max(abs(east), abs(north)) < 1.0 / 3.0:
        return "centre"
    sector = COMPASS[round(float(np.arctan2(north, east)) / (0.25 * np.pi)) % 8]
    return f"{sector} corner" if len(sector) == 2 else f"{sector} side"
