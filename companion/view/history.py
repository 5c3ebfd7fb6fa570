"""History of a flight for maps, and its transfer to readers that come late or lose a part.

The flight keeps the track and the curves, thinned, from its own event log. A page gets the part
that it lacks with the next snapshot that is sent, and a browser with the next update. So snapshots
may be dropped, pages restarted and browsers opened late: each has the whole in the end.
"""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeVar

from companion.geometry.polygons import Point

T = TypeVar("T")


class HistoryPart(NamedTuple, Generic[T]):
    """Part of a history that a reader lacks."""

    items: list[T]
    is_whole: bool
    """The items replace the reader's; otherwise they are appended."""


class History(Generic[T]):
    """A list that grows; its version changes with every other change."""

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
        """Return the part that is lacking; it counts as sent."""
        is_whole = history.version != self._version
        if self._whole_every is not None:
            is_whole = is_whole or self._parts % self._whole_every == 0
        first = 0 if is_whole else self._count
        self._parts += 1
        self._count, self._version = len(history.items), history.version
        return HistoryPart(history.items[first:], is_whole)


MOST_CORNERS = 2000
TOLERANCE_M = 0.25
"""Half the step of the positions in the event log: a finer line would follow their noise."""


class FlightTrack(History[Point]):
    """Corners of the flown line, so that no position is farther from it than the tolerance.

    Sleeve fitting: a corner is added when the next position cannot be reached from the last corner
    by a line that passes all positions between within the tolerance. With more than `MOST_CORNERS`
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

    def add(self, place: Point) -> None:
        """Add the next position."""
        if not self.items:
            self.items.append(place)
            return
        (east, north), (from_east, from_north) = place, self.items[-1]
        far_m = math.hypot(east - from_east, north - from_north)
        direction_rad = math.atan2(north - from_north, east - from_east)
        half_rad = math.asin(min(1.0, self._tolerance_m / far_m)) if far_m > 0.0 else math.pi
        if self._end is None:
            if far_m > self._tolerance_m:
                self._end, self._reach_m = place, far_m
                self._ahead_rad, self._sector_rad = direction_rad, (-half_rad, half_rad)
            return
        aside_rad = math.remainder(direction_rad - self._ahead_rad, math.tau)
        low_rad, high_rad = self._sector_rad
        if low_rad <= aside_rad <= high_rad and far_m >= self._reach_m - self._tolerance_m:
            self._end, self._reach_m = place, max(self._reach_m, far_m)
            self._sector_rad = (
                max(low_rad, aside_rad - half_rad),
                min(high_rad, aside_rad + half_rad),
            )
            return
        self.items.append(self._end)
        self._end = None
        if len(self.items) > MOST_CORNERS:
            self._coarsen()
        self.add(place)

    def clear(self) -> None:
        """Remove all corners for another frame."""
        super().clear()
        self._end = None

    def _coarsen(self) -> None:
        corners = self.items
        self.clear()
        self._tolerance_m *= 2.0
        for corner in corners:
            self.add(corner)


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
