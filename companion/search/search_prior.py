"""Prior of an emitter's position at first contact: where searching has been in vain, it is less.

The posterior of the grid, POA (1 - POD), is the prior of the first hypotheses. It is limited: alone
it never decides between two places, because the emitter may also be outside of the area, and a
wrong reach is an error common to all cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from companion.geometry.polygons import Point
from companion.search.search_grid import Floats, SearchGrid
from companion.search.searched_area import SearchState

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
