"""The paper's objective over a whole recording: the same kernel as in flight, without a bound.

For use after a flight or on a recorded walk, where nothing has to be forgotten and the answer may
take its time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.map_kernels import COLUMNS
from companion.estimation.window.optimizer import weigh_optima
from companion.estimation.window.sandwich import Observability, mirrored, observability_of
from companion.estimation.window.window_map import MIN_MEASUREMENTS, Optimum, WindowMap
from companion.kernel import Matrix

DIRECTIONS = 12
"""Starts around the path."""


@dataclass(frozen=True, slots=True)
class BatchEstimate:
    """What a recording says of one target."""

    optima: tuple[tuple[float, Optimum], ...]
    """(probability, optimum), the most probable first; several: the recording is ambiguous."""
    observability: Observability
    """About the most probable one."""

    @property
    def best(self) -> Optimum:
        """The most probable optimum."""
        return self.optima[0][1]


def rows_of(
    measurements: Sequence[tuple[RangingMeasurement, PositionEnu]], params: FilterParams
) -> Matrix:
    """Measurements and where they were taken, as the kernels take them, (n, 10)."""
    rows = np.full((len(measurements), COLUMNS), np.nan)
    for index, (measurement, sensor_enu_m) in enumerate(measurements):
        z, sigma = params.seen(measurement)
        rows[index] = (*sensor_enu_m, *z, *sigma, index)
    return rows


def batch_map(
    measurements: Sequence[tuple[RangingMeasurement, PositionEnu]], params: FilterParams
) -> BatchEstimate | None:
    """The places that explain a recording, with their probabilities and covariances.

    Args:
        measurements: In time order, each with where the sensor was.
        params: Noise, thresholds, priors and bounds.

    Returns:
        None where there are too few measurements, or where they name no place.
    """
    if len(measurements) < MIN_MEASUREMENTS:
        return None
    rows, solver = rows_of(measurements, params), WindowMap(params)
    starts = [
        solver.start_around(rows, 2.0 * math.pi * turn / DIRECTIONS, turn)
        for turn in range(DIRECTIONS)
    ]
    first = solver.optima(rows, starts)
    if not first:
        return None
    starts = [optimum.mean for optimum in first]
    found = weigh_optima(solver.optima(rows, [*starts, mirrored(starts[0], rows[:, :2])]))
    odds = np.exp([log for log, _ in found])
    optima = tuple(
        (float(share), optimum)
        for share, (_, optimum) in zip(odds / odds.sum(), found, strict=True)
    )
    best = optima[0][1]
    return BatchEstimate(optima, observability_of(rows, solver.scores(rows, best.mean)))
