"""Tracks of search patterns: legs to fly in order, clipped to free space.

The patterns are those of the IAMSAR manual for one search unit:

    parallel track     lanes one spacing apart, the first half a spacing inside the area's border
    expanding square   from the datum, legs d, d, 2d, 2d, 3d, 3d, ... turning right by 90 degrees
    sector             from the datum, three triangles of equal legs turning right by 120 degrees,
                       through the datum between them

An area need not be convex: it is flown cell by cell, a cell being lanes that neighbour each other
one to one. Headings are clockwise from north, as is usual in search and rescue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.obstacles import FreeSpace
from companion.geometry.polygons import Point, Polygon, edges

Floats = NDArray[np.float64]
MIN_LEG_M = 0.5
"""Length below which the rest of a leg is dropped."""


@dataclass(frozen=True, slots=True)
class Leg:
    """Straight piece of a track."""

    start_enu_m: Point
    end_enu_m: Point

    @property
    def length_m(self) -> float:
        """Length from start to end."""
        return math.dist(self.start_enu_m, self.end_enu_m)

    def reversed(self) -> Leg:
        """Return the same leg in the opposite direction."""
        return Leg(self.end_enu_m, self.start_enu_m)


Track = tuple[Leg, ...]
_Cell = list[Leg]
"""Neighbouring lanes, all in the same direction."""


def clipped(legs: Sequence[Leg], spaces: Sequence[FreeSpace]) -> Track:
    """Return the parts of the legs that are free in every space."""
    for space in spaces:
        pieces = (space.pieces(leg.start_enu_m, leg.end_enu_m) for leg in legs)
        legs = [Leg(*piece) for found in pieces for piece in found]
    return tuple(leg for leg in legs if leg.length_m >= MIN_LEG_M)


def heading_of_fewest_lanes_rad(area_enu_m: Polygon) -> float:
    """Return the heading of the edge along which the area needs the fewest lanes."""
    headings = [math.atan2(b[0] - a[0], b[1] - a[1]) for a, b in edges(area_enu_m) if a != b]
    return min(headings, key=lambda heading_rad: round(_width_m(area_enu_m, heading_rad), 6))


def parallel_track(
    area_enu_m: Polygon,
    inset_m: float,
    spacing_m: float,
    heading_rad: float,
    spaces: Sequence[FreeSpace],
    entry_enu_m: Point,
) -> Track:
    """Return lanes over an area, a simple polygon whose border already lost `inset_m` to a margin.

    They are no farther apart than a spacing, and the track begins at the end of a lane that is
    nearest to the entry.
    """
    along = _unit(heading_rad)
    aside = (-along[1], along[0])
    across = [_dot(aside, corner) for corner in area_enu_m]
    reach = [_dot(along, corner) for corner in area_enu_m]
    low_m, width_m = min(across) + inset_m, max(across) - min(across) - 2.0 * inset_m
    if width_m <= 0.0:
        return ()
    count = math.ceil(width_m / spacing_m - 1e-9)
    rows: list[Track] = []
    for index in range(count):
        offset_m = low_m + (index + 0.5) * width_m / count
        ends = (_at(along, m, aside, offset_m) for m in (min(reach), max(reach)))
        rows.append(clipped([Leg(*ends)], spaces))
    return _joined(_cells(rows, along), entry_enu_m)


def lanes_over(
    centres_enu_m: Floats,
    cell_m: float,
    spacing_m: float,
    heading_rad: float,
    spaces: Sequence[FreeSpace],
    entry_enu_m: Point,
) -> Track:
    """Return lanes over square cells, (n, 2), as `parallel_track` does over a polygon."""
    along = _unit(heading_rad)
    aside = (-along[1], along[0])
    half_m = 0.5 * cell_m * (abs(along[0]) + abs(along[1]))
    reach, across = centres_enu_m @ np.array(along), centres_enu_m @ np.array(aside)
    low_m = float(across.min()) - half_m
    width_m = float(across.max()) + half_m - low_m
    count = max(1, math.ceil(width_m / spacing_m - 1e-9))
    lane_of = np.clip((across - low_m) / width_m * count, 0, count - 1).astype(int)
    rows: list[Track] = []
    for index in range(count):
        offset_m = low_m + (index + 0.5) * width_m / count
        along_m = np.sort(reach[lane_of == index])
        cuts = np.flatnonzero(np.diff(along_m) > 2.0 * max(cell_m, spacing_m)) + 1
        ends = [
            (float(p[0]) - half_m, float(p[-1]) + half_m) for p in np.split(along_m, cuts) if len(p)
        ]
        legs = [Leg(*(_at(along, m, aside, offset_m) for m in pair)) for pair in ends]
        rows.append(clipped(legs, spaces))
    return _joined(_cells(rows, along), entry_enu_m)


def _at(along: Point, along_m: float, aside: Point, aside_m: float) -> Point:
    return along_m * along[0] + aside_m * aside[0], along_m * along[1] + aside_m * aside[1]


def expanding_square(
    datum_enu_m: Point,
    spacing_m: float,
    radius_m: float,
    heading_rad: float,
    spaces: Sequence[FreeSpace],
) -> Track:
    """Return a square spiral; `radius_m`, half its width, is rounded down to whole spacings."""
    legs, corner = [], datum_enu_m
    rings = math.floor(radius_m / spacing_m + 1e-9)
    for index in range(4 * rings + 1):
        is_last = index == 4 * rings  # it closes the square instead of beginning the next ring
        length_m = spacing_m * (2 * rings if is_last else index // 2 + 1)
        end = _moved(corner, heading_rad + 0.5 * math.pi * index, length_m)
        legs.append(Leg(corner, end))
        corner = end
    return clipped(legs, spaces)


def sector_search(
    datum_enu_m: Point, radius_m: float, heading_rad: float, spaces: Sequence[FreeSpace]
) -> Track:
    """Return three triangles, nine legs of the same length, about the datum."""
    legs, corner, course_rad = [], datum_enu_m, heading_rad
    for _ in range(3):
        for turn in range(3):
            end = datum_enu_m if turn == 2 else _moved(corner, course_rad, radius_m)
            legs.append(Leg(corner, end))
            corner = end
            if turn < 2:  # it passes straight through the datum
                course_rad += math.radians(120.0)
    return clipped(legs, spaces)


def _width_m(area_enu_m: Polygon, heading_rad: float) -> float:
    """Return the extent of an area across a heading."""
    east, north = _unit(heading_rad)
    across = [_dot((-north, east), corner) for corner in area_enu_m]
    return max(across) - min(across)


def _cells(rows: Sequence[Track], along: Point) -> list[_Cell]:
    """Join the lanes of neighbouring rows that overlap one to one."""
    cells: list[_Cell] = []
    open_cells: list[_Cell] = []
    for row in rows:
        beside = [[cell for cell in open_cells if _overlap(cell[-1], leg, along)] for leg in row]
        following: list[_Cell] = []
        for leg, found in zip(row, beside, strict=True):
            is_alone = len(found) == 1 and sum(found[0] in other for other in beside) == 1
            cell = found[0] if is_alone else []
            if not is_alone:
                cells.append(cell)
            cell.append(leg)
            following.append(cell)
        open_cells = following
    return cells


def _overlap(one: Leg, other: Leg, along: Point) -> bool:
    return _dot(along, one.start_enu_m) < _dot(along, other.end_enu_m) and _dot(
        along, other.start_enu_m
    ) < _dot(along, one.end_enu_m)


def _joined(cells: Sequence[_Cell], entry_enu_m: Point) -> Track:
    """Return the cells in order, each time the one with the nearest entrance."""
    remaining, track, position = list(cells), list[Leg](), entry_enu_m
    while remaining:
        entrances = [(i, e) for i, cell in enumerate(remaining) for e in _entrances(cell)]
        index, entrance = min(
            entrances, key=lambda found: round(math.dist(found[1][0].start_enu_m, position), 6)
        )
        track += entrance
        position = track[-1].end_enu_m
        del remaining[index]
    return tuple(track)


def _entrances(cell: _Cell) -> Iterator[_Cell]:
    """Yield a cell, flown back and forth, from each of its four corners."""
    for lanes in (cell, cell[::-1]):
        for first in (0, 1):
            yield [leg.reversed() if (i + first) % 2 else leg for i, leg in enumerate(lanes)]


def _unit(heading_rad: float) -> Point:
    return (math.sin(heading_rad), math.cos(heading_rad))


def _moved(start: Point, heading_rad: float, by_m: float) -> Point:
    east, north = _unit(heading_rad)
    return (start[0] + by_m * east, start[1] + by_m * north)


def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1]
