"""A bounded memory of measurements, spread over the places that they were taken from."""

from __future__ import annotations

import math

import numpy as np

from companion.domain import PositionEnu
from companion.geometry.arrays import Matrix

GRID_CELLS = 10
"""Places per side of the path's bounding square, for thinning."""
KEPT_SHARE = 0.75
"""What a full window is thinned to."""


class MeasurementWindow:
    """Up to `size` measurements, spread over the places that they were taken from.

    Rows are [east, north, up, range, bearing, range sigma, bearing sigma]; what was not measured
    is NaN here, because the rows are one array.
    """

    def __init__(self, size: int) -> None:
        self._rows = np.full((size, 7), np.nan)
        self._count = 0
        self._is_complete = True

    def __len__(self) -> int:
        """Measurements held."""
        return self._count

    @property
    def rows(self) -> Matrix:
        """The measurements, (n, 7), oldest first."""
        return self._rows[: self._count]

    @property
    def is_complete(self) -> bool:
        """Whether no measurement was left out yet."""
        return self._is_complete

    def clear(self) -> None:
        """Forget everything."""
        self._count = 0
        self._is_complete = True

    def add(
        self,
        sensor_enu_m: PositionEnu,
        range_m: float | None,
        bearing_enu_rad: float | None,
        range_sigma_m: float,
        bearing_sigma_rad: float,
    ) -> None:
        """Take in a measurement; a full window is thinned first."""
        if self._count == len(self._rows):
            kept = thinned(self._rows, int(KEPT_SHARE * len(self._rows)))
            self._count = len(kept)
            self._rows[: self._count] = kept
            self._is_complete = False
        self._rows[self._count] = (
            *sensor_enu_m,
            math.nan if range_m is None else range_m,
            math.nan if bearing_enu_rad is None else bearing_enu_rad,
            range_sigma_m,
            bearing_sigma_rad,
        )
        self._count += 1


def thinned(rows: Matrix, target: int) -> Matrix:
    """At most `target` of the rows, in order, taken away where they are most crowded.

    Args:
        rows: (n, 7), the first two columns are the place.
        target: How many to keep.
    """
    low = rows[:, :2].min(axis=0)
    extent_m = float((rows[:, :2].max(axis=0) - low).max()) + 1e-9
    cells = np.minimum(((rows[:, :2] - low) / extent_m * GRID_CELLS).astype(int), GRID_CELLS - 1)
    _, place, counts = np.unique(
        cells[:, 0] * GRID_CELLS + cells[:, 1], return_inverse=True, return_counts=True
    )
    cap = int(counts.max())
    while cap > 1 and int(np.minimum(counts, cap).sum()) > target:
        cap -= 1
    keep = np.zeros(len(rows), dtype=bool)
    for index, count in enumerate(counts):
        members = np.flatnonzero(place == index)
        keep[members[np.linspace(0, count - 1, min(int(count), cap)).astype(int)]] = True
    kept = np.flatnonzero(keep)
    if len(kept) > target:  # more places than may be kept: every place loses alike
        kept = kept[np.linspace(0, len(kept) - 1, target).astype(int)]
    remaining: Matrix = rows[kept]
    return remaining
