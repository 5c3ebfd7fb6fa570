"""Remaining probability in a search area, and the part that a straight leg would detect.

Theory of operation. An `Outlook` keeps, for every cell, the probability that the emitter is there
and was missed so far, split by the offset of the cell (error of the reach and shadowing about the
emitter): a cell that was missed from near by probably has a low offset, and one more leg over it
finds little. A leg is a row of independent squares, one per correlation length of the shadowing.
Its log probability of a miss is that of a square, integrated along the leg. For a straight leg it
depends on the lateral distance of the cell and on the two ends, so that a table of the integral, by
lateral distance and position along the leg, gives it with two look-ups per cell and offset: the
lateral range curve of B. O. Koopman, Search and Screening, with its ends.

Squares that were listened from before count once, as in `SearchedArea`: a leg finds something only
along the part of it that is new.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.obstacles import between
from companion.geometry.polygons import Point
from companion.search.detection_model import (
    MAX_SIGMAS,
    MIN_LOG,
    NODE_WEIGHTS,
    NODES,
    DetectionModel,
    received_share,
)
from companion.search.search_grid import Bools, Floats, SearchGrid
from companion.search.searched_area import GROUP_SIGMAS, GROUPS, SearchedArea, Square

MAX_CELLS = 2500
"""Limit of cells of a forecast: 50 by 50, each far smaller than the area that a leg changes."""
UPFADE_DB = 10.0
"""Rayleigh fading exceeds its median by so much in 0.1 % of all answers."""
LEVELS_DB = np.arange(-80.0, 81.0)
"""Margins of the table of one square; beyond them nothing changes."""
STEPS = 160
"""Lateral distances of the table."""
Floats32 = NDArray[np.float32]


class LegTable:
    """Log probability that a straight leg at constant speed misses an emitter."""

    def __init__(self, model: DetectionModel, height_m: float, speed_mps: float) -> None:
        n = model.propagation.exponent
        side_m = model.propagation.correlation_m
        offsets_db = GROUP_SIGMAS * model.cell_sigma_db
        best_db = float(offsets_db[-1]) + MAX_SIGMAS * model.path_sigma_db + UPFADE_DB
        farthest_m = model.reach_m * 10.0 ** (best_db / (10.0 * n))
        self.speed_mps = speed_mps
        self.side_m = side_m
        """Correlation length of the shadowing: side of a square."""
        self._step_m = farthest_m / STEPS
        self._count = math.ceil(farthest_m / self._step_m)
        lateral = self._step_m * np.arange(self._count + 1)
        along = self._step_m * (np.arange(-self._count, self._count + 1))
        squared = lateral[:, None] ** 2 + along[None, :] ** 2 + max(height_m, 1.0) ** 2
        margin_db = -5.0 * n * np.log10(squared / model.reach_m**2)
        answers = side_m / (max(speed_mps, 0.1) * model.interval_s)
        missed = _square_log_miss(model, answers)
        rate = np.stack(
            [np.interp(margin_db + offset, LEVELS_DB, missed) for offset in offsets_db], axis=2
        )
        rate *= self._step_m / side_m
        total = np.cumsum(rate, axis=1) - 0.5 * rate
        self._integral: Floats32 = total.astype(np.float32)
        """(lateral, along, groups), from far before the leg to a position along it."""

    def log_miss(self, centres_enu_m: Floats, start: Point, end: Point) -> Floats32:
        """(cells, groups) log probability that the leg misses an emitter in each cell."""
        length_m = max(math.dist(start, end), 1e-9)
        ue, un = (end[0] - start[0]) / length_m, (end[1] - start[1]) / length_m
        east, north = centres_enu_m[:, 0] - start[0], centres_enu_m[:, 1] - start[1]
        along = east * ue + north * un
        row = np.rint(np.abs(north * ue - east * un) / self._step_m).astype(np.intp)
        is_near = row <= self._count
        row = np.minimum(row, self._count)
        # Seen from the cell, the leg runs from -along to length - along.
        first = self._column(-along)
        last = self._column(length_m - along)
        found: Floats32 = self._integral[row, last] - self._integral[row, first]
        found[~is_near] = 0.0
        return found

    def _column(self, along_m: Floats) -> NDArray[np.intp]:
        index: NDArray[np.intp] = np.rint(along_m / self._step_m).astype(np.intp) + self._count
        return np.clip(index, 0, 2 * self._count, out=index)


def _square_log_miss(model: DetectionModel, answers: float) -> Floats:
    """Return log probabilities that all answers in a square are missed, by `LEVELS_DB`."""
    received = received_share(LEVELS_DB, model.propagation.rice_k_db)
    missed = (1.0 - model.duty_cycle * received) ** answers
    mean = np.zeros(len(LEVELS_DB))
    for sigma, weight in zip(NODES, NODE_WEIGHTS, strict=True):
        mean += weight * np.interp(LEVELS_DB + sigma * model.path_sigma_db, LEVELS_DB, missed)
    logs: Floats = np.log(np.maximum(mean, math.exp(MIN_LOG)))
    return logs


@dataclass(frozen=True, slots=True, eq=False)
class Outlook:
    """Remaining probability at one moment of a search."""

    grid: SearchGrid
    """Cells of the forecast, with their posterior POA, given that the emitter is in the area."""
    chance: Floats32
    """(cells, groups) probability that the emitter is there and was missed; the sum is 1 - POS."""
    visited: frozenset[Square]
    """Squares of the shadowing's correlation length that the radio has listened from."""

    @property
    def is_even(self) -> bool:
        """True if no square was searched yet and all cells are equally likely."""
        return not self.visited and float(np.ptp(self.grid.poa)) < 1e-9

    def after(self, start: Point, end: Point, table: LegTable) -> Outlook:
        """Return the outlook after one more straight leg on which nothing is heard."""
        centres, chance, side_m = self.grid.centres_enu_m, self.chance, table.side_m
        for piece in _new_pieces(start, end, side_m, self.visited):
            chance = chance * np.exp(table.log_miss(centres, *piece))
        return Outlook(self.grid, chance, self.visited.union(_squares(start, end, side_m)))

    @property
    def left(self) -> float:
        """Probability that the emitter is in the area and was missed."""
        return float(self.chance.sum())

    @property
    def density(self) -> Floats:
        """Remaining probability of each cell, (cells,), relative to the highest."""
        mass: Floats = self.chance.sum(axis=1, dtype=float)
        return mass / max(float(mass.max()), 1e-300)


def _steps(start: Point, end: Point, side_m: float) -> list[float]:
    """Return shares of a leg in steps of half a square's side, their middles."""
    count = max(1, math.ceil(2.0 * math.dist(start, end) / side_m))
    return [(index + 0.5) / count for index in range(count)]


def _square(position: Point, side_m: float) -> Square:
    return math.floor(position[0] / side_m), math.floor(position[1] / side_m)


def _squares(start: Point, end: Point, side_m: float) -> Iterator[Square]:
    for share in _steps(start, end, side_m):
        yield _square(between(start, end, share), side_m)


def _new_pieces(
    start: Point, end: Point, side_m: float, visited: frozenset[Square]
) -> Iterator[tuple[Point, Point]]:
    """Yield the parts of a leg that run through squares that were not listened from."""
    shares = _steps(start, end, side_m)
    half = 0.5 / len(shares)
    begun: float | None = None
    for share in shares:
        is_new = _square(between(start, end, share), side_m) not in visited
        if is_new and begun is None:
            begun = share - half
        elif not is_new and begun is not None:
            yield between(start, end, begun), between(start, end, share - half)
            begun = None
    if begun is not None:
        yield between(start, end, begun), end


def outlook_of(area: SearchedArea) -> Outlook:
    """Return the remaining probability, as of its last update."""
    chance = area.missed * area.grid.poa[:, None].astype(np.float32)
    grid, chance = _coarse(area.grid, chance)
    return Outlook(grid, chance, frozenset(area.squares))


def _coarse(grid: SearchGrid, chance: Floats32) -> tuple[SearchGrid, Floats32]:
    """Return blocks of cells, at most `MAX_CELLS`, with the sums of their chances."""
    factor = math.ceil(math.sqrt(len(grid.poa) / MAX_CELLS))
    rows, columns = (math.ceil(count / factor) for count in grid.inside.shape)
    row, column = np.nonzero(grid.inside)
    block = (row // factor) * columns + column // factor
    inside: Bools = np.bincount(block, minlength=rows * columns) > 0
    sums = [np.bincount(block, chance[:, k], rows * columns)[inside] for k in range(GROUPS)]
    blocks: Floats32 = np.stack(sums, axis=1).astype(np.float32)
    mass = blocks.sum(axis=1, dtype=float)
    poa = mass / max(float(mass.sum()), 1e-300)
    coarse = SearchGrid(
        grid.west_m, grid.south_m, grid.cell_m * factor, inside.reshape(rows, columns), poa
    )
    return coarse, blocks
