"""Searched area of one flight: its configuration, its file and its sentence for the radio."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from companion.domain import Params, PositionEnu, Positive
from companion.geometry.coordinates import LocalOrigin
from companion.search.detection_model import DetectionModel, DetectionParams
from companion.search.first_contact import LearntReach
from companion.search.outlines import gaps_of
from companion.search.search_grid import SearchGrid
from companion.search.searched_area import Look, SearchedArea, SearchState, state_of

Probability = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
GOOD_POD = 0.8
"""An area counts as searched from here on."""


ReachSource = Literal["configured", "preset"]
"""Source of the reach before any contact: `search.detection.reach_m`, or the radio's preset,
`estimation.filter.reach_m`."""
REACH_WORDS: Mapping[ReachSource, tuple[str, str]] = {
    "configured": ("as configured", "configured, search.detection.reach_m"),
    "preset": ("from the radio's preset", "preset, estimation.filter.reach_m"),
}


class SearchAreaParams(Params, frozen=True):
    """The area, the radio's range, and the end of a search without contact."""

    detection: DetectionParams | None = None
    """Null: the radio's range is unknown, and no probability is stated."""
    area_file: str | None = None
    """Possible locations of the emitter, relative to this file: GeoJSON or KML polygons, or an
    ASCII grid or GeoTIFF, in degrees; null: anywhere in the fence."""
    cell_m: ClassVar[float] = 20.0
    """Side of a cell."""
    stop_pos: Probability | None = None
    """The search ends, with nothing heard, at this probability of success; null: it goes on."""
    stop_sweeps: Annotated[int, msgspec.Meta(ge=1, le=100)] | None = None
    """Number of complete patterns after which the search ends; null: it goes on."""


class StoredGrid(msgspec.Struct, frozen=True):
    """A search grid as JSON has it."""

    west_m: float
    south_m: float
    cell_m: Positive
    poa: list[list[float | None]]
    """Rows from the south; null outside of the area."""

    @classmethod
    def of(cls, grid: SearchGrid) -> StoredGrid:
        """Return the grid as it is stored: cells outside of the area are null."""
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
    """`searched_area.json`: everything that the other files are made of."""

    version: int = 1
    began_unix_s: float
    ended_unix_s: float
    listened_s: float
    """Time in the air with a position, while an emitter was sought."""
    contact_unix_s: float | None = None
    """First measurement that was accepted."""
    reported: tuple[int, ...] = ()
    """Emitters with a report, by id."""
    heard: tuple[int, ...] = ()
    """Emitters that were heard and have no report."""
    sought: tuple[int, ...] | None = None
    """Emitters for which counting went on, by id; empty: any other; None: it ended at contact."""
    is_radio_heard: bool
    """True if the radio sent anything in this flight; if not, perhaps it never listened."""
    origin: LocalOrigin | None
    detection: DetectionModel | None = None
    learnt: LearntReach | None = None
    """Reach as the first contact showed it; None: as `reach_from` says."""
    reach_from: ReachSource = "configured"
    grid: StoredGrid | None = None
    looks: list[tuple[float, float, float, float]] = []
    """East, north, height and number of answers."""
    track: list[tuple[float, float, float, float]] = []
    """Seconds after the beginning, east, north and height above home."""


def searched_again(flights: Sequence[SearchedFlight]) -> SearchState | None:
    """Return what flights have searched together, over the grid of the first one.

    None: nothing can be stated, because it has no grid or model. Flights of other origins are moved
    by the difference of the origins. What a contact showed of the reach holds for all flights that
    assumed the same.
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
    place = origin.geodetic_from_enu((0.0, 0.0, 0.0))
    return base.enu_from_geodetic(*place)


def statement(flight: SearchedFlight, state: SearchState | None) -> str:
    """Return the sentences for the radio, one or two."""
    heard = _heard(flight)
    if not flight.is_radio_heard:
        heard += " The radio sent nothing at all: check that it listened."
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
    """Return what was heard, and of which emitters nothing was."""
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
    """Return where the reach is from, in words; None: it is unknown."""
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
