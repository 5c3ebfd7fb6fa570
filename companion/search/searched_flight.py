"""Searched area of one flight: its configuration, its file and its sentence for the radio.

It also describes the outlines and gaps of a search grid, as polygons and as text.

Outlines run along the sides of cells and claim nothing finer than the grid does. The outside is
counter-clockwise and holes are clockwise, as RFC 7946 requires.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from companion.domain import Params, PositionEnu, Positive
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Corners, Point, contains, signed_area_m2
from companion.search.detection_model import DetectionModel, DetectionParams
from companion.search.search_grid import Bools, SearchGrid
from companion.search.searched_area import LearntReach, Look, SearchedArea, SearchState, state_of

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
    """Closed outlines with the wanted cells on their left; where two touch, they stay separate."""
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
            sides = zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1], strict=True)
            yield [
                at for a, at, b in sides if not a[0] == at[0] == b[0] and not a[1] == at[1] == b[1]
            ]
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


def _in_metres(grid: SearchGrid, ring: list[Node]) -> tuple[Point, ...]:
    return tuple(
        (grid.west_m + column * grid.cell_m, grid.south_m + row * grid.cell_m)
        for row, column in ring
    )


GAP_POD = 0.5
"""POD below which a cell belongs to a gap: the emitter is more likely missed than heard."""
MIN_GAP_SHARE = 0.02
"""Minimum share of the probability; smaller gaps are not reported."""
MAX_GAPS = 3
COMPASS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")


@dataclass(frozen=True, slots=True)
class Gap:
    """Connected cells with a low POD."""

    name: str
    """Name for the radio, such as "NE corner"."""
    share_of_area: float
    poa: float
    """Probability that the emitter is in it, before the search."""
    cells: Bools


def gaps_of(state: SearchState) -> list[Gap]:
    """Return the gaps to be reported, the most probable one first."""
    grid = state.grid
    found = [
        Gap(sector_name(grid, cells), float(cells.mean()), float(grid.poa[cells].sum()), cells)
        for cells in pieces_of(grid, state.pod < GAP_POD)
    ]
    worthy = [gap for gap in found if gap.poa >= MIN_GAP_SHARE]
    return sorted(worthy, key=lambda gap: -gap.poa)[:MAX_GAPS]


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


def sector_name(grid: SearchGrid, cells: Bools) -> str:
    """Describe the position of cells in the area: `NE corner`, `W side`, `centre`."""
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


Probability = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
GOOD_POD = 0.8
"""POD above which an area is taken as searched."""


ReachSource = Literal["configured", "preset"]
"""Source of the reach before contact: `search.detection`, or the radio's preset."""
REACH_WORDS: Mapping[ReachSource, tuple[str, str]] = {
    "configured": ("as configured", "configured, search.detection.reach_m"),
    "preset": ("from the radio's preset", "preset, estimation.filter.reach_m"),
}


class SearchAreaParams(Params, frozen=True):
    """The area, the radio's range, and the end of a search without contact."""

    detection: DetectionParams | None = None
    """Radio link of the search; null: the range is unknown, no probability is stated."""
    area_file: str | None = None
    """Possible locations of the emitter, relative to this file: GeoJSON or KML polygons, or an
    ASCII grid or GeoTIFF, in degrees; null: anywhere in the fence."""
    cell_m: ClassVar[float] = 20.0
    """Side of a cell."""
    stop_pos: Probability | None = None
    """Probability of success at which a search without contact ends; null: it continues."""
    stop_sweeps: Annotated[int, msgspec.Meta(ge=1, le=100)] | None = None
    """Number of complete patterns after which the search ends; null: it continues."""


class StoredGrid(msgspec.Struct, frozen=True):
    """Search grid in the form of JSON."""

    west_m: float
    south_m: float
    cell_m: Positive
    poa: list[list[float | None]]
    """Rows from the south; null outside of the area."""

    @classmethod
    def of(cls, grid: SearchGrid) -> StoredGrid:
        """Return the grid in its stored form, with null for cells outside the area."""
        rows = grid.on_map(grid.poa, math.nan).tolist()
        poa = [[None if math.isnan(value) else value for value in row] for row in rows]
        return cls(grid.west_m, grid.south_m, grid.cell_m, poa)

    def grid(self) -> SearchGrid:
        """The grid; a `ValueError` where rows differ in length or nothing is inside."""
        poa = np.array(
            [[math.nan if value is None else value for value in row] for row in self.poa], float
        )
        inside = np.isfinite(poa)
        if poa.ndim != 2 or not inside.any():
            raise ValueError("the grid has no cells")
        mass = poa[inside]
        return SearchGrid(self.west_m, self.south_m, self.cell_m, inside, mass / mass.sum())


class SearchedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Content of `searched_area.json`, from which the other files are made."""

    version: int = 1
    began_unix_s: float
    ended_unix_s: float
    listened_s: float
    """Time in the air with a position, while counting."""
    contact_unix_s: float | None = None
    """Unix time of the first accepted measurement."""
    reported: tuple[int, ...] = ()
    """Emitters with a report, by id."""
    heard: tuple[int, ...] = ()
    """Emitters that were heard and have no report."""
    sought: tuple[int, ...] | None = None
    """Ids of the emitters still counted; empty: any other; None if counting ended at contact."""
    is_radio_heard: bool
    """True if the radio sent anything in this flight; if not, perhaps it never listened."""
    origin: LocalOrigin | None
    detection: DetectionModel | None = None
    learnt: LearntReach | None = None
    """Reach observed at the first contact; None: the one of `reach_from`."""
    reach_from: ReachSource = "configured"
    grid: StoredGrid | None = None
    looks: list[tuple[float, float, float, float]] = []
    """Looks, each with east, north, height and number of answers."""
    track: list[tuple[float, float, float, float]] = []
    """Seconds after the beginning, east, north and height above home."""


def combined_area(flights: Sequence[SearchedFlight]) -> SearchState | None:
    """Return the combined coverage of flights, on the grid of the first one.

    None if it has no grid or model. Flights of other origins are moved by the difference of the
    origins. A reach that a contact revealed applies to all flights that assumed the same one.
    """
    first = flights[0]
    if first.grid is None:
        return None
    grid = first.grid.grid()
    learnt = {flight.detection: flight.learnt for flight in flights if flight.learnt is not None}
    areas: dict[DetectionModel, SearchedArea] = {}
    for flight in flights:
        if flight.detection is None:
            continue
        if flight.detection not in areas:
            shown = learnt.get(flight.detection)
            model = flight.detection if shown is None else shown.model(flight.detection)
            areas[flight.detection] = SearchedArea(grid, model)
        shift = _shift_m(flight.origin, first.origin)
        areas[flight.detection].take(
            Look(east + shift[0], north + shift[1], up, answers)
            for east, north, up, answers in flight.looks
        )
    return state_of(*areas.values()) if areas else None


def _shift_m(origin: LocalOrigin | None, base: LocalOrigin | None) -> PositionEnu:
    if origin is None or base is None:
        return (0.0, 0.0, 0.0)
    own_origin = origin.geodetic_from_enu((0.0, 0.0, 0.0))
    return base.enu_from_geodetic(*own_origin)


def statement(flight: SearchedFlight, state: SearchState | None) -> str:
    """Return the sentences for the radio, one or two."""
    heard = _heard(flight)
    if not flight.is_radio_heard:
        heard += " The radio sent nothing at all: check that it was receiving."
    if state is None:
        minutes = flight.listened_s / 60.0
        return f"{heard} {minutes:.0f} min listened; no probability: the radio's reach is unknown."
    gaps = gaps_of(state)
    named = ", ".join(gap.name for gap in gaps) if gaps else "none"
    return (
        f"{heard} {_percent(state.share_at(GOOD_POD))} of the planned area searched at 80 % or "
        f"more; POS {_percent(state.pos)}; gaps: {named}.{_reach(flight)}"
    )


def _heard(flight: SearchedFlight) -> str:
    """Return the emitters that were heard, and those that were not."""
    if flight.contact_unix_s is None and not flight.reported:
        return "Nothing heard."
    if flight.sought is None:
        return "Searched before contact:"
    found = [
        f"{len(ids)} {word} ({_named(ids)})"
        for ids, word in ((flight.reported, "reported"), (flight.heard, "heard"))
        if ids
    ]
    rest = _named(flight.sought) if flight.sought else "others"
    return f"{', '.join(found)}; nothing heard of {rest}."


def _named(ids: Sequence[int]) -> str:
    return f"{'emitter' if len(ids) == 1 else 'emitters'} {', '.join(map(str, ids))}"


def _reach(flight: SearchedFlight) -> str:
    """Return the reach that the figures assume, with its source."""
    if flight.detection is None:
        return ""
    if flight.learnt is not None:
        return f" Reach {flight.learnt.reach_m:.0f} m, by the first contact."
    return f" Reach {flight.detection.reach_m:.0f} m, {REACH_WORDS[flight.reach_from][0]}."


def reach_source(flight: SearchedFlight) -> str | None:
    """Return the text of where the reach is from; None if it is unknown."""
    if flight.detection is None:
        return None
    figures = f"{flight.detection.reach_m:g} m, {flight.detection.reach_sigma_db:g} dB"
    assumed = f"{REACH_WORDS[flight.reach_from][1]}: {figures}"
    if flight.learnt is None:
        return assumed
    learnt = f"{flight.learnt.reach_m:g} m, {flight.learnt.reach_sigma_db:g} dB"
    return f"first contact of this flight: {learnt}; {assumed}"


def _percent(share: float) -> str:
    """Whole per cent, rounded down: 99.6 % are not everything."""
    return f"{math.floor(100.0 * share + 1e-9)} %"
