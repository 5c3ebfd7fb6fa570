"""The searched area at first contact: prior of the emitter's position, and reach of the radio.

Theory of operation of the prior. Where searching has been in vain, the emitter is less likely. The
posterior of the grid, POA (1 - POD), is the prior of the first hypotheses. It is limited: alone it
never decides between two places, because the emitter may also be outside of the area, and a wrong
reach is an error common to all cells.

Theory of operation of the reach. Until contact, the searched area keeps the log probability that an
emitter in a cell was missed, for each offset of the cell: the sum of the error of the stated reach
and of the shadowing about the emitter. Once the emitter's position is known, that of its cell is
the likelihood of these offsets, times the probability that the first answer was received where it
was. Of the posterior offset the reach has the share of its variance in the prior, because one
emitter does not separate the two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from companion.domain import PositionEnu
from companion.geometry.polygons import Point
from companion.search.detection_model import NODE_WEIGHTS, NODES, DetectionModel
from companion.search.search_grid import Floats, SearchGrid
from companion.search.searched_area import SearchedArea, SearchState

LEAST_ODDS = 0.1
"""Least odds of a place to the likeliest one: two such places are still ambiguous, as the estimate
counts it (a second place of 5 % or more)."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchPrior:
    """Log of the prior density on a map, against its greatest value."""

    grid: SearchGrid
    log_map: Floats
    """(rows, columns); cells of the box that are not of the area count as its mean."""
    shift_en_m: Point = (0.0, 0.0)
    """Sum of the jumps of the vehicle's navigation since it was made."""

    @classmethod
    def of(cls, state: SearchState) -> SearchPrior:
        """Return the prior that a search leaves."""
        left = state.grid.poa * (1.0 - state.pod)
        density = state.grid.on_map(left, float(left.mean()))
        return cls(state.grid, np.log(np.maximum(density / density.max(), LEAST_ODDS)))

    def log_at(self, place_enu_m: Point) -> float:
        """Return the log of the odds of a place to the likeliest one.

        Beyond the map it is as at its border: the fence rarely ends where the emitter may be.
        """
        grid = self.grid
        rows, columns = self.log_map.shape
        east, north = (p - s for p, s in zip(place_enu_m, self.shift_en_m, strict=True))
        row = math.floor((north - grid.south_m) / grid.cell_m)
        column = math.floor((east - grid.west_m) / grid.cell_m)
        return float(self.log_map[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])

    def moved(self, shift_en_m: Point) -> SearchPrior:
        """Return the prior after a jump of the vehicle's navigation."""
        east, north = self.shift_en_m
        return replace(self, shift_en_m=(east + shift_en_m[0], north + shift_en_m[1]))


class LearntReach(msgspec.Struct, frozen=True):
    """Reach after the first contact."""

    reach_m: float
    reach_sigma_db: float

    def model(self, before: DetectionModel) -> DetectionModel:
        """Return the detection model with this reach."""
        return msgspec.structs.replace(
            before, reach_m=self.reach_m, reach_sigma_db=max(0.5, self.reach_sigma_db)
        )


def learnt_reach(
    area: SearchedArea, contact_m: PositionEnu, emitter_enu_m: Point
) -> LearntReach | None:
    """Return the reach after an emitter at a known position was first heard from `contact_m`.

    None: the emitter lies outside of the searched area, where nothing was counted.
    """
    model, grid, table = area.model, area.grid, area.table
    away = np.abs(grid.centres_enu_m - np.array(emitter_enu_m)).max(axis=1)
    cell = int(away.argmin())
    if away[cell] > 0.5 * grid.cell_m + 1e-9:
        return None
    margin = model.margin_db(np.array([emitter_enu_m]), contact_m)
    missed_one = np.exp(table.rows[table.index_of(margin)[0]]) @ table.spread_matrix()
    before = area.missed_before_contact
    log_missed = area.log_missed() if before is None else before
    posterior = NODE_WEIGHTS * np.exp(log_missed[cell]) * (1.0 - missed_one)
    if not posterior.sum() > 0.0:
        return None
    posterior = posterior / posterior.sum()
    offsets_db = model.cell_sigma_db * NODES
    mean_db = float(posterior @ offsets_db)
    variance = float(posterior @ (offsets_db - mean_db) ** 2)
    share = (model.reach_sigma_db / model.cell_sigma_db) ** 2
    sigma_db = math.sqrt(model.reach_sigma_db**2 * (1.0 - share) + share**2 * variance)
    factor = 10.0 ** (share * mean_db / (10.0 * model.propagation.exponent))
    return LearntReach(round(model.reach_m * factor, 1), round(sigma_db, 2))
