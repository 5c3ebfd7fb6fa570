"""A bounded memory of measurements, and what those said that no longer fit into it.

Measurements are spread over the views of the target that they are. What leaves becomes a Gaussian
prior for those that stay.

A measurement that leaves the window is expanded to second order about the estimate of that time,

    rho(u(x)) ~ const - psi H^T (x - x0) + 1/2 (x - x0)^T psi' H H^T (x - x0)

and only the sums are kept. That is for residuals that know nothing of each other. Where they repeat
each other, a measurement that was left out says little that its neighbours in the window do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.domain import Point, PositionEnu
from companion.estimation.measurement_model import BEARING, RANGE, RangingModel
from companion.estimation.window.map_kernels import (
    COLUMNS,
    SEQUENCE,
    SIGMAS,
    VALUES,
    clipped,
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector

SECTORS = 16
"""Directions that the target is seen from, for thinning."""
NEAREST_RING_M = 1.0
"""Views from closer than this are in the innermost ring; each further ring is twice as far."""
KEPT_SHARE = 0.95
"""What a full window is thinned to."""


class MeasurementWindow:
    """Up to `size` measurements, spread over the views of the target that they are.

    Rows are laid out as in `map_kernels`.
    """

    def __init__(self, size: int) -> None:
        self._rows = np.full((size, COLUMNS), np.nan)
        self._count = 0
        self._sequence = 0

    def __len__(self) -> int:
        """Measurements held."""
        return self._count

    @property
    def rows(self) -> Matrix:
        """The measurements, (n, 10), oldest first."""
        return self._rows[: self._count]

    @property
    def has_bearings(self) -> bool:
        """Whether any measurement held is a bearing."""
        return not bool(np.isnan(self.rows[:, VALUES + BEARING]).all())

    def clear(self) -> None:
        """Forget everything."""
        self._count = 0
        self._sequence = 0

    def keep_last(self, count: int) -> None:
        """Forget all but the newest measurements."""
        kept = self.rows[max(self._count - count, 0) :].copy()
        self._count = len(kept)
        self._rows[: self._count] = kept

    def change(self, changed: Callable[[Matrix], Matrix]) -> None:
        """Put other rows in the place of those held.

        Args:
            changed: The new rows, (n, 10), of the old ones.
        """
        self._rows[: self._count] = changed(self.rows)

    def believe(self, range_sigma_m: float, bearing_sigma_rad: float) -> None:
        """Take all ranges and bearings held to have this thermal noise."""
        self.rows[:, SIGMAS + RANGE] = range_sigma_m
        self.rows[:, SIGMAS + BEARING] = bearing_sigma_rad

    def add(
        self, sensor_enu_m: PositionEnu, z: Vector, sigma: Vector, target_enu_m: Point
    ) -> Matrix:
        """Take in a measurement; a full window is thinned first.

        Args:
            z: (3,) range, bearing, elevation; NaN where not measured.
            sigma: (3,) thermal noise.
            target_enu_m: Where the target is believed to be, which decides what is alike.

        Returns:
            The measurements that had to go, (m, 10), mostly none.
        """
        dropped = self._rows[:0]
        if self._count == len(self._rows):
            is_kept = kept_by_thinning(self._rows, int(KEPT_SHARE * len(self._rows)), target_enu_m)
            dropped = self._rows[~is_kept]
            self._count = int(is_kept.sum())
            self._rows[: self._count] = self._rows[is_kept]
        self._rows[self._count] = (*sensor_enu_m, *z, *sigma, self._sequence)
        self._count += 1
        self._sequence += 1
        return dropped


def kept_by_thinning(rows: Matrix, target: int, centre: Point) -> NDArray[np.bool_]:
    """Which of the rows stay, (n,): at most `target`, taken away where views are most alike.

    Alike are views of the centre from the same sector and about the same distance.

    Args:
        rows: (n, 10), see `map_kernels`.
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
        keep[:] = False
        keep[kept[np.linspace(0, len(kept) - 1, target).astype(int)]] = True
    return keep


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


@dataclass(frozen=True, slots=True)
class OlderEvidence:
    """A Gaussian in canonical form, and how much its pull would vary by chance."""

    information: Matrix
    """(k, k), L."""
    pull: Vector
    """(k,), L times the mean."""
    variability: Matrix
    """(k, k), the sum of psi^2 H H^T: the sandwich's B."""

    @classmethod
    def none(cls, size: int) -> OlderEvidence:
        """Nothing yet, for a state of `size` components."""
        return cls(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)))

    @property
    def is_empty(self) -> bool:
        """Whether nothing was left out yet."""
        return not self.information.any()

    def moved(self, step: Vector) -> OlderEvidence:
        """The same about a state that is farther by `step`, (k,)."""
        return replace(self, pull=self.pull + self.information @ step)

    def joined(
        self,
        rows: Matrix,
        mean: Vector,
        thresholds: Matrix,
        model: RangingModel,
    ) -> OlderEvidence:
        """With the measurements `rows`, expanded about `mean`.

        Args:
            rows: (m, 10), see `map_kernels`.
            mean: (k,).
            thresholds: (3, 2).
        """
        sigmas = row_sigmas(rows, mean, model)
        u = row_residuals(rows, mean, sigmas, model)
        psi = clipped(u, thresholds)
        H = row_partials(rows, mean, sigmas, model)
        influence = psi.reshape(-1)
        A = H.T @ ((u == psi).reshape(-1, 1) * H)
        B = H.T @ ((influence**2)[:, None] * H)
        return OlderEvidence(
            self.information + A,
            self.pull + A @ mean + H.T @ influence,
            self.variability + B,
        )
