"""Walks past a target as rows of the window: what the tests of the estimation package share."""

from __future__ import annotations

import math

import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.kernel import Matrix, Vector

TARGET = (40.0, 25.0)
OFFSET_M = 2.0
TURN_RAD = -0.05
UP_M = 10.0
RANGE_SIGMA_M, BEARING_SIGMA_RAD, ELEVATION_SIGMA_RAD = 0.5, 0.03, 0.05
START = np.array([35.0, 20.0, 0.0, 0.0])


def params(**changes: float | bool | None) -> FilterParams:
    """A filter that knows where the vehicle is."""
    return FilterParams(**{"own_position_sigma_m": 0.0, **changes})  # type: ignore[arg-type]


def walk(
    rng: np.random.Generator,
    count: int = 200,
    *,
    ranges: bool = True,
    bearings: bool = True,
    elevations: bool = False,
    straight: bool = False,
    noise: float = 1.0,
    height_m: float = 0.0,
    scale: float = 0.0,
    rho: float = 0.0,
) -> Matrix:
    """Rows (n, 10) of a walk at 10 m height, with well-specified noise times `noise`.

    Args:
        rng: Generator of the noise.
        count: Number of measurements, n.
        ranges: True if ranges are measured.
        bearings: True if bearings are measured.
        elevations: True if elevations are measured.
        straight: True if the walk follows a line.
        noise: Factor on the standard deviations; 0: no noise.
        height_m: Height of the target above the ground.
        scale: Scale error of the ranges.
        rho: Lag-1 correlation of the noise.
    """
    s = np.linspace(0.0, 1.0, count)
    rows = np.full((count, 10), np.nan)
    rows[:, 0] = 60.0 * s
    rows[:, 1] = 0.0 if straight else 30.0 * np.sin(2.0 * math.pi * s)
    rows[:, 2] = UP_M
    away = np.array([*TARGET, height_m]) - rows[:, :3]
    ground = np.hypot(away[:, 0], away[:, 1])
    error = noise * repeating(rng, rho, count)
    if ranges:
        slant = np.hypot(ground, away[:, 2])
        rows[:, 3] = (1.0 + scale) * slant + OFFSET_M + RANGE_SIGMA_M * error[:, 0]
    if bearings:
        turned = np.arctan2(away[:, 1], away[:, 0]) + TURN_RAD
        rows[:, 4] = turned + BEARING_SIGMA_RAD * error[:, 1]
    if elevations:
        rows[:, 5] = np.arctan2(away[:, 2], ground) + ELEVATION_SIGMA_RAD * error[:, 2]
    rows[:, 6:9] = RANGE_SIGMA_M, BEARING_SIGMA_RAD, ELEVATION_SIGMA_RAD
    rows[:, 9] = np.arange(count)
    return rows


def repeating(rng: np.random.Generator, rho: float, count: int) -> Matrix:
    """Three columns of unit noise (n, 3) whose neighbours are correlated by `rho`."""
    fresh = rng.normal(size=(count, 3))
    noise = np.array(fresh)
    for index in range(1, count):
        noise[index] = rho * noise[index - 1] + math.sqrt(1.0 - rho * rho) * fresh[index]
    return noise


def reflected(rng: np.random.Generator, rows: Matrix, share: float, mean_m: float = 8.0) -> Matrix:
    """The same rows with a share of the ranges too long."""
    longer = np.array(rows)
    is_longer = rng.random(len(rows)) < share
    longer[is_longer, 3] += rng.exponential(mean_m, int(is_longer.sum()))
    return longer


def truth(size: int = 4) -> Vector:
    """The state that a noiseless walk without scale is solved by."""
    return np.array([*TARGET, OFFSET_M, TURN_RAD, 0.0, 0.0])[:size]


def measurement_of(row: Vector, time_s: float) -> tuple[RangingMeasurement, PositionEnu]:
    """Return the measurement of a row, and the position of the sensor."""
    east, north, up, *rest = row.tolist()
    range_m, bearing_rad, up_rad = (None if math.isnan(v) else v for v in rest[:3])
    bearing_rad = None if bearing_rad is None else math.remainder(bearing_rad, 2.0 * math.pi)
    seen = RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=range_m,
        range_sigma_m=rest[3],
        bearing_enu_rad=bearing_rad,
        bearing_sigma_rad=rest[4],
        elevation_rad=up_rad,
        elevation_sigma_rad=rest[5],
    )
    return seen, (east, north, up)
