"""Invented walks with spatially correlated ranging errors, to test the tracker's consistency.

A target lies in reach of a path; every range is too long by a constant offset and by an excess that
is never negative, is a field over the way, and changes over a distance of metres:

    range = distance + offset + excess(way) + noise,    excess = mean * -log(Phi(g(way)))

with g a Gauss-Markov process of unit variance, so that the excess at a position is exponential.
Paths are those of people: straight on, round a corner, a circle, and standing still after steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from companion.domain import RangingMeasurement
from companion.kernel import Matrix, Vector
from companion.replay.walk_replay import WalkRow

PathName = Literal["straight", "corner", "circle", "hover"]
PATHS: tuple[PathName, ...] = get_args(PathName)
LENGTHS_M = (2.0, 6.0, 20.0)
"""Over which distance the excess changes."""
SPEED_MPS, RATE_HZ = 1.0, 4.0
PATH_M = 40.0
"""Length of a path; who hovers walks a tenth of it."""
NEAREST_M, FARTHEST_M = 3.0, 18.0
"""Distances of the target from the path's middle."""
OFFSET_M, OFFSET_SIGMA_M = 1.0, 0.4
EXCESS_M = 0.7
NOISE_M = 0.3


@dataclass(frozen=True, slots=True)
class CorrelatedCase:
    """One kind of walk."""

    path: PathName
    length_m: float

    def __str__(self) -> str:
        """Return its name in the figures."""
        return f"{self.path}, {self.length_m:g} m"


def way_of(path: PathName) -> Matrix:
    """Return positions along a path, (n, 2), at even times."""
    s = np.arange(0.0, PATH_M, SPEED_MPS / RATE_HZ)
    if path == "straight":
        return np.stack([s, np.zeros_like(s)], axis=1)
    if path == "corner":
        half = 0.5 * PATH_M
        return np.stack([np.minimum(s, half), np.maximum(s - half, 0.0)], axis=1)
    if path == "circle":
        radius = PATH_M / (2.0 * math.pi)
        return radius * np.stack([np.cos(s / radius), np.sin(s / radius)], axis=1)
    return np.stack([np.minimum(s, 0.1 * PATH_M), np.zeros_like(s)], axis=1)


def excess_m(rng: np.random.Generator, way_m: Vector, length_m: float) -> Vector:
    """Return the excess along the way, (n,), metres."""
    g = np.empty(len(way_m))
    g[0] = rng.normal()
    for index in range(1, len(g)):
        rho = math.exp(-(way_m[index] - way_m[index - 1]) / length_m)
        g[index] = rho * g[index - 1] + math.sqrt(1.0 - rho * rho) * rng.normal()
    below = np.array([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in g.tolist()])
    return np.asarray(-EXCESS_M * np.log(np.maximum(below, 1e-9)))


def walk_of(case: CorrelatedCase, rng: np.random.Generator) -> list[WalkRow]:
    """Draw a walk past a target."""
    positions = way_of(case.path)
    steps_m = np.hypot(*np.diff(positions, axis=0).T)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    turn_rad, away_m = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(NEAREST_M, FARTHEST_M)
    target = positions.mean(axis=0) + away_m * np.array([math.cos(turn_rad), math.sin(turn_rad)])
    offset_m = max(0.0, rng.normal(OFFSET_M, OFFSET_SIGMA_M))
    noise_m = rng.normal(0.0, NOISE_M, len(positions))
    ranges = np.hypot(*(positions - target).T) + offset_m + excess_m(rng, way_m, case.length_m)
    ranges = np.maximum(ranges + noise_m, 0.1)
    truth = (float(target[0]), float(target[1]))
    return [
        WalkRow("target", RangingMeasurement(1, index / RATE_HZ, range_m=r), (e, n, 0.0), truth)
        for index, (r, (e, n)) in enumerate(zip(ranges.tolist(), positions.tolist(), strict=True))
    ]


def walks_of(case: CorrelatedCase, seeds: Iterable[int]) -> Iterator[list[WalkRow]]:
    """Yield walks of a kind, one for each seed."""
    number = PATHS.index(case.path)
    for seed in seeds:
        yield walk_of(case, np.random.default_rng([21, number, round(10 * case.length_m), seed]))
