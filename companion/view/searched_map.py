"""The searched area for maps: packed by the flight, drawn by the process of the page.

Gaps, outlines and the image take too long for a control tick; packing takes about a millisecond.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass

import numpy as np

from companion.area_handoff import png_of
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point
from companion.guidance.session import GuidanceSession
from companion.search.outlines import Gap, gaps_of, outlines
from companion.search.search_grid import SearchGrid
from companion.search.searched_area import SearchState
from companion.view.history import History, HistoryPart

FASTEST = 1
"""Level of zlib."""
CELL = np.dtype("<f2")
"""Half precision keeps three digits, which is what is shown."""


@dataclass(frozen=True, slots=True)
class PackedState:
    """A state of the search as one short line of JSON has it."""

    west_m: float
    south_m: float
    cell_m: float
    columns: int
    cells: str
    """POA relative to its maximum, then POD, row by row from the south-west, NaN outside of the
    area: half-precision numbers, compressed (RFC 1950), in base64."""

    @classmethod
    def of(cls, state: SearchState, zero_m: Point = (0.0, 0.0)) -> PackedState:
        """Return the packed state of a grid whose frame has its zero here on the map."""
        grid = state.grid
        values = (grid.poa / grid.poa.max(), state.pod)
        cells = np.stack([grid.on_map(each, np.nan) for each in values]).astype(CELL)
        text = base64.b64encode(zlib.compress(cells.tobytes(), FASTEST)).decode("ascii")
        west_m, south_m = grid.west_m + zero_m[0], grid.south_m + zero_m[1]
        return cls(west_m, south_m, grid.cell_m, grid.inside.shape[1], text)

    def state(self) -> SearchState:
        """Return the state, with its values rounded."""
        data = np.frombuffer(zlib.decompress(base64.b64decode(self.cells)), CELL)
        poa, pod = data.astype(float).reshape(2, -1, self.columns)
        inside = np.isfinite(poa)
        mass = poa[inside]
        grid = SearchGrid(self.west_m, self.south_m, self.cell_m, inside, mass / mass.sum())
        return SearchState(grid, pod[inside])


class SearchedHistory(History[PackedState]):
    """The latest state of the search; its version changes only with what is shown."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: tuple[SearchState | None, LocalOrigin | None] = (None, None)

    def look(self, session: GuidanceSession) -> None:
        """Take the session's state, which is renewed every few seconds."""
        searching, frame = session.searching, session.vehicle.frame
        state = searching.state if searching.is_worth_reporting else None
        if state is self._shown[0] and frame == self._shown[1]:
            return
        self._shown = (state, frame)
        items = [] if state is None else [PackedState.of(state, _zero_m(searching.frame, frame))]
        if items != self.items:
            self.take(HistoryPart(items, True))


def _zero_m(origin: LocalOrigin | None, frame: LocalOrigin | None) -> Point:
    """Return the position of another frame's origin in this frame, east and north."""
    if origin is None or frame is None or origin == frame:
        return (0.0, 0.0)
    east, north, *_ = frame.zero_of(origin)
    return (east, north)


def drawn(packed: PackedState) -> dict[str, object]:
    """Return the map: an image of POD with its corners, and the gaps; metres, east first."""
    state = packed.state()
    grid = state.grid
    rows, columns = grid.inside.shape
    east_m, north_m = grid.west_m + columns * grid.cell_m, grid.south_m + rows * grid.cell_m
    image = base64.b64encode(png_of(state)).decode("ascii")
    return {
        "image": f"data:image/png;base64,{image}",
        "corners": [(grid.west_m, grid.south_m), (east_m, north_m)],
        "gaps": [_drawn_gap(grid, gap) for gap in gaps_of(state)],
    }


def _drawn_gap(grid: SearchGrid, gap: Gap) -> dict[str, object]:
    centres = grid.centres_enu_m[gap.cells]
    middle = centres.mean(axis=0)
    label = centres[np.argmin(np.hypot(*(centres - middle).T))]  # a gap may lie around its middle
    return {
        "text": f"gap: {gap.name}, POA {100.0 * gap.poa:.0f} %",
        "label": label.tolist(),
        "outlines": [asdict(each) for each in outlines(grid, gap.cells)],
    }
