"""Where the objective is flatter than its curvature says: uncertainty beyond the linearised one.

A bearing from far away or a range from nearly one place leaves a valley that is steep at the
optimum and flat beyond it. The covariance is that of the curvature at the optimum; so the cost is
read along the most uncertain direction, out to where the 95 % circle ends. Where it rises by less
than half of what the curvature promises, the deviation is stretched to where it does.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from companion.geometry.arrays import Matrix, Vector

EDGE_SIGMAS = 2.45
"""How far out the 95 % circle ends."""
MIN_RISE_SHARE = 0.5
"""Least share of the promised rise that is taken for agreement."""
STRETCHES = tuple(1.5**i for i in range(1, 9))

Cost = Callable[[Vector], float]


def stretched(covariance: Matrix, A: Matrix, mean: Vector, cost: Cost) -> Matrix:
    """The covariance, wider along its longest axis where the cost is flatter than its curvature.

    Args:
        covariance: (k, k).
        A: (k, k) curvature of the cost at the optimum.
        mean: (k,) the optimum.
        cost: The objective.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    sigma_m = math.sqrt(max(float(values[1]), 0.0))
    if sigma_m == 0.0:
        return covariance
    axis: Vector = covariance[:, :2] @ vectors[:, 1] / sigma_m
    promised = 0.5 * EDGE_SIGMAS**2 * float(axis @ A @ axis)
    least = cost(mean)
    stretch = max(
        _stretch(mean, side * EDGE_SIGMAS * axis, MIN_RISE_SHARE * promised + least, cost)
        for side in (-1.0, 1.0)
    )
    if stretch == 1.0:
        return covariance
    wider: Matrix = covariance + (stretch**2 - 1.0) * np.outer(axis, axis)
    return wider


def _stretch(mean: Vector, edge: Vector, wanted: float, cost: Cost) -> float:
    """How often `edge` must be laid off until the cost reaches `wanted`."""
    for stretch in (1.0, *STRETCHES):
        if cost(mean + stretch * edge) >= wanted:
            return stretch
    return STRETCHES[-1]
