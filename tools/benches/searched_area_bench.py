"""Time and memory of an update of a searched area of 4 km^2 in cells of 20 m."""

from __future__ import annotations

import statistics
import tracemalloc
from dataclasses import dataclass
from time import process_time

from companion.search.detection_model import DetectionModel
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import SearchedArea

SIDE_M, CELL_M = 2000.0, 20.0
LIMIT_MS, LIMIT_MB = 10.0, 30.0
RENEWALS = 21
STEP_M = 5.0
"""Flown in a second."""


@dataclass(frozen=True, slots=True)
class AreaCost:
    """Cost of one update, and memory of all arrays together."""

    cells: int
    update_ms: float
    """Median of the pieces of work, of which a control tick does one."""
    update_p99_ms: float
    renewal_ms: float
    """Median renewal of the probabilities of a block; a control tick does one at most."""
    memory_mb: float

    @property
    def is_met(self) -> bool:
        """Return True within the limits of time and memory."""
        slowest_ms = max(self.update_ms, self.renewal_ms)
        return slowest_ms <= LIMIT_MS and self.memory_mb <= LIMIT_MB


def searched_area_cost(seconds: int) -> AreaCost:
    """Return the cost of a search of some seconds along a line over the middle."""
    corners = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M))
    tracemalloc.start()
    grid = grid_over([WeightedArea(corners)], CELL_M)
    area = SearchedArea(grid, DetectionModel(reach_m=150.0))
    area.listen((0.0, 0.0, 20.0), 1.0)
    area.finish()
    memory_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    times_ms: list[float] = []
    for second in range(seconds):
        east_m = (STEP_M * second) % SIDE_M
        area.listen((east_m, 0.5 * SIDE_M, 20.0), 1.0)
        began = process_time()
        while area.advance():
            times_ms.append(1e3 * (process_time() - began))
            began = process_time()
    renewals_ms: list[float] = []
    for _ in range(RENEWALS):
        began = process_time()
        area.renew()
        renewals_ms.append(1e3 * (process_time() - began))
    renewal_ms = statistics.median(renewals_ms)
    times_ms.sort()
    p99_ms = times_ms[int(0.99 * (len(times_ms) - 1))]
    return AreaCost(len(grid.poa), statistics.median(times_ms), p99_ms, renewal_ms, memory_mb)
