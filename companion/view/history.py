"""History of a flight for maps, and its transfer to readers that join late or lose a part.

The flight keeps the track and the curves, thinned, from its own event log. A page gets the part
that it lacks with the next snapshot that is sent, and a browser with the next update. So snapshots
may be dropped, pages restarted and browsers opened late: each eventually has the whole.

The searched area is packed by the flight, which takes about a millisecond; gaps, outlines and the
image take too long for a control tick, and are drawn by the process of the page.
"""

from __future__ import annotations

import base64
import math
import zlib
from dataclasses import asdict, dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from companion.area_handoff import png_of
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Point
from companion.guidance.session import GuidanceSession
from companion.search.search_grid import SearchGrid
from companion.search.searched_area import SearchState
from companion.search.searched_flight import Gap, gaps_of, outlines

T = TypeVar("T")


class HistoryPart(NamedTuple, Generic[T]):
    """Part of a history that a reader has not received yet."""

    items: list[T]
    is_whole: bool
    """True if the items replace the reader's; otherwise they are appended."""


class History(Generic[T]):
    """Growing list with a version, which every change but an addition increments."""

    def __init__(self) -> None:
        self.items: list[T] = []
        self.version = 0

    def take(self, part: HistoryPart[T]) -> None:
        """Append or replace by a part."""
        if part.is_whole:
            self.items, self.version = [], self.version + 1
        self.items += part.items

    def clear(self) -> None:
        """Remove all items."""
        self.items, self.version = [], self.version + 1


class HistoryReader:
    """Reader's position in a history."""

    def __init__(self, whole_every: int | None = None) -> None:
        """Create a reader that gets the whole with every `whole_every`th part."""
        self._whole_every = whole_every
        self._parts, self._count, self._version = 0, 0, -1

    def next_part(self, history: History[T]) -> HistoryPart[T]:
        """Return the part that is lacking, and record it as sent."""
        is_whole = history.version != self._version
        if self._whole_every is not None:
            is_whole = is_whole or self._parts % self._whole_every == 0
        first = 0 if is_whole else self._count
        self._parts += 1
        self._count, self._version = len(history.items), history.version
        return HistoryPart(history.items[first:], is_whole)


MAX_CORNERS = 2000
TOLERANCE_M = 0.25
"""Tolerance of the track, half the step of positions in the event log: a finer line would follow
their noise."""


class FlightTrack(History[Point]):
    """Corners of the flown line, so that no position is farther from it than the tolerance.

    Sleeve fitting: a corner is added when the next position cannot be reached from the last corner
    by a line that passes all positions between within the tolerance. With more than `MAX_CORNERS`
    the tolerance doubles. Source: Zhao and Saalfeld, "Linear-time sleeve-fitting polyline
    simplification algorithms", Auto-Carto 13 (1997).
    """

    def __init__(self) -> None:
        super().__init__()
        self._tolerance_m = TOLERANCE_M
        self._end: Point | None = None
        """The latest position, not a corner yet."""
        self._reach_m = 0.0
        """Largest distance of the line from the last corner."""
        self._ahead_rad = 0.0
        self._sector_rad = (0.0, 0.0)
        """Directions from the last corner, relative to `_ahead_rad`, that pass all since then."""

    @property
    def line(self) -> list[Point]:
        """The corners and the latest position."""
        return self.items if self._end is None else [*self.items, self._end]

    def add(self, position: Point) -> None:
        """Add the next position."""
        if not self.items:
            self.items.append(position)
            return
        (east, north), (from_east, from_north) = position, self.items[-1]
        far_m = math.hypot(east - from_east, north - from_north)
        direction_rad = math.atan2(north - from_north, east - from_east)
        half_rad = math.asin(min(1.0, self._tolerance_m / far_m)) if far_m > 0.0 else math.pi
        if self._end is None:
            if far_m > self._tolerance_m:
                self._end, self._reach_m = position, far_m
                self._ahead_rad, self._sector_rad = direction_rad, (-half_rad, half_rad)
            return
        aside_rad = math.remainder(direction_rad - self._ahead_rad, math.tau)
        low_rad, high_rad = self._sector_rad
        if low_rad <= aside_rad <= high_rad and far_m >= self._reach_m - self._tolerance_m:
            self._end, self._reach_m = position, max(self._reach_m, far_m)
            self._sector_rad = (
                max(low_rad, aside_rad - half_rad),
                min(high_rad, aside_rad + half_rad),
            )
            return
        self.items.append(self._end)
        self._end = None
        if len(self.items) > MAX_CORNERS:
            corners = self.items
            self.clear()
            self._tolerance_m *= 2.0
            for corner in corners:
                self.add(corner)
        self.add(position)

    def clear(self) -> None:
        """Remove all corners for another frame."""
        super().clear()
        self._end = None


CURVE_POINTS = 600
CURVE_STEP_S = 0.5


class CurveHistory(History[dict[str, object]]):
    """Points of the curves over time, at a step that doubles with every `CURVE_POINTS` of them."""

    def __init__(self) -> None:
        super().__init__()
        self._step_s = CURVE_STEP_S
        self._next_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Return True if a point at this time is kept."""
        return now_s >= self._next_s

    def add(self, point: dict[str, object], now_s: float) -> None:
        """Keep a point that is due."""
        self._next_s = now_s + self._step_s
        self.items.append(point)
        if len(self.items) > CURVE_POINTS:
            self.items, self.version = self.items[::2], self.version + 1
            self._step_s *= 2.0


FASTEST = 1
"""Compression level of zlib."""
CELL = np.dtype("<f2")
"""Half precision, which keeps three digits, as many as are shown."""


@dataclass(frozen=True, slots=True)
class PackedState:
    """State of the search as one compact line of JSON."""

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
    """Latest state of the search; its version changes only if the display changes."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: tuple[SearchState | None, LocalOrigin | None] = (None, None)

    def look(self, session: GuidanceSession) -> None:
        """Take the session's state, which is updated every few seconds."""
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
