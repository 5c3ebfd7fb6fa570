"""Are squared, normalised errors as large as they should be? NIS, NEES and their bands.

A consistent filter's y^T S^-1 y (NIS, needs no truth) and e^T P^-1 e (NEES, needs it) are
chi-square distributed with as many degrees of freedom as they have components. Their mean over a
window or over runs lies in a band about that number.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation (2001), section 5.4; E. B. Wilson and M. M. Hilferty, PNAS 17 (1931), for the quantile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.estimation.base import UpdateReport
from companion.geometry.arrays import Matrix, Vector

NORMAL_975 = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % above it."""
FORGETTING = 1.0 - 1.0 / 200.0
"""Memory of the NIS monitor, in measurements."""


def nees(error: Vector, covariance: Matrix) -> float:
    """e^T P^-1 e. Args: error (n,), covariance (n, n)."""
    return float(error @ np.linalg.solve(covariance, error))


def mean_band(dof: float, count: float) -> tuple[float, float]:
    """Where the mean of `count` chi-square values lies with 95 % probability.

    By the cube-root normal approximation: within 5 % for 5 degrees of freedom in all, 1 % for 20.

    Args:
        dof: Degrees of freedom of each.
        count: How many; may be a sum of weights.
    """
    total = dof * count
    spread = math.sqrt(2.0 / (9.0 * total))
    low, high = (
        total * (1.0 - 2.0 / (9.0 * total) + sign * NORMAL_975 * spread) ** 3
        for sign in (-1.0, 1.0)
    )
    return max(low, 0.0) / count, high / count


@dataclass(frozen=True, slots=True)
class NisMonitor:
    """Running mean of the NIS per degree of freedom, with forgetting; 1 is consistent.

    S is the innovation variance that the filter works with, robust weight and inflation included:
    with these the mean is near 1 or a little below it, because saturated innovations are given more
    variance than they show. Above the band the filter is over-confident.
    """

    count: float = 0.0
    """Degrees of freedom in memory."""
    total: float = 0.0

    def after(self, report: UpdateReport) -> NisMonitor:
        """With one more update."""
        dof = sum(row is not None for row in report.modalities)
        return NisMonitor(FORGETTING * self.count + dof, FORGETTING * self.total + report.nis)

    @property
    def mean(self) -> float | None:
        """Mean NIS per degree of freedom; None before the first update."""
        return self.total / self.count if self.count > 0.0 else None

    @property
    def is_overconfident(self) -> bool:
        """Whether the mean is above the band of white, consistent innovations."""
        return self.count >= 1.0 and self.total / self.count > mean_band(1.0, self.count)[1]
