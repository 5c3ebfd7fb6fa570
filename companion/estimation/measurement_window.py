"""A bounded memory of measurements, spread over the views of the target that they are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.domain import Point, PositionEnu
from companion.geometry.arrays import Matrix, Vector

SEQUENCE = 7
"""Column of the sequence number."""
SECTORS = 16
"""Directions that the target is seen from, for thinning."""
NEAREST_RING_M = 1.0
"""Views from closer than this are in the innermost ring; each further ring is twice as far."""
KEPT_SHARE = 0.95
"""What a full window is thinned to."""


class MeasurementWindow:
    """Up to `size` measurements, spread over the views of the target that they are.

    Rows are [east, north, up, range, bearing, range sigma, bearing sigma, sequence number]; what
    was not measured is NaN here, because the rows are one array.
    """

    def __init__(self, size: int) -> None:
        self._rows = np.full((size, SEQUENCE + 1), np.nan)
        self._count = 0
        self._sequence = 0
        self._is_complete = True

    def __len__(self) -> int:
        """Measurements held."""
        return self._count

    @property
    def rows(self) -> Matrix:
        """The measurements, (n, 8), oldest first."""
        return self._rows[: self._count]

    @property
    def has_bearings(self) -> bool:
        """Whether any measurement held is a bearing."""
        return not bool(np.isnan(self.rows[:, 4]).all())

    @property
    def is_complete(self) -> bool:
        """Whether no measurement was left out yet."""
        return self._is_complete

    @property
    def kept_share(self) -> float:
        """Share of all measurements since the start that are still held."""
        return self._count / self._sequence if self._sequence else 1.0

    def clear(self) -> None:
        """Forget everything."""
        self._count = 0
        self._sequence = 0
        self._is_complete = True

    def add(
        self,
        sensor_enu_m: PositionEnu,
        range_m: float | None,
        bearing_enu_rad: float | None,
        range_sigma_m: float,
        bearing_sigma_rad: float,
        target_enu_m: Point,
    ) -> None:
        """Take in a measurement; a full window is thinned first.

        Args:
            sensor_enu_m: Where it was taken.
            range_m: None if not measured.
            bearing_enu_rad: None if not measured.
            range_sigma_m: Thermal noise.
            bearing_sigma_rad: Thermal noise.
            target_enu_m: Where the target is believed to be, which decides what is alike.
        """
        if self._count == len(self._rows):
            kept = thinned(self._rows, int(KEPT_SHARE * len(self._rows)), target_enu_m)
            self._count = len(kept)
            self._rows[: self._count] = kept
            self._is_complete = False
        self._rows[self._count] = (
            *sensor_enu_m,
            math.nan if range_m is None else range_m,
            math.nan if bearing_enu_rad is None else bearing_enu_rad,
            range_sigma_m,
            bearing_sigma_rad,
            self._sequence,
        )
        self._count += 1
        self._sequence += 1


def thinned(rows: Matrix, target: int, centre: Point) -> Matrix:
    """At most `target` of the rows, in order, taken away where views are most alike.

    Alike are views of the centre from the same sector and about the same distance.

    Args:
        rows: (n, 8), see `MeasurementWindow`.
        target: How many to keep.
        centre: What is looked at.
    """
    east, north = rows[:, 0] - centre[0], rows[:, 1] - centre[1]
    sector = np.floor((np.arctan2(north, east) / (2.0 * math.pi) + 0.5) * SECTORS) % SECTORS
    ring = np.floor(np.log2(np.maximum(np.hypot(east, north) / NEAREST_RING_M, 1.0)))
    _, view, counts = np.unique(ring * SECTORS + sector, return_inverse=True, return_counts=True)
    cap = int(counts.max())
    while cap > 1 and int(np.minimum(counts, cap).sum()) > target:
        cap -= 1
    keep = np.zeros(len(rows), dtype=bool)
    for index in range(len(counts)):
        members = np.flatnonzero(view == index)
        keep[members[_evenly_in_time(rows[members, SEQUENCE], cap)]] = True
    kept = np.flatnonzero(keep)
    if len(kept) > target:  # more views than may be kept: every one loses alike
        kept = kept[np.linspace(0, len(kept) - 1, target).astype(int)]
    remaining: Matrix = rows[kept]
    return remaining


def _evenly_in_time(sequence: Vector, count: int) -> NDArray[np.intp]:
    """Indices of at most `count` members, spread evenly over the time that they span.

    The member with the nearest neighbours goes first. Picking every other one would forget: what
    survived many thinnings is sparse already.
    """
    kept = np.arange(len(sequence))
    while len(kept) > max(count, 2):
        gaps = sequence[kept[2:]] - sequence[kept[:-2]]
        kept = np.delete(kept, 1 + int(np.argmin(gaps)))
    return kept[:count]
