"""What left the window, as a Gaussian prior of what stays in it.

Each measurement is expanded to second order about the estimate of the time when it left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.measurement_model import RangingModel
from companion.estimation.window.map_kernels import (
    clipped,
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector


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
        self, rows: Matrix, mean: Vector, thresholds: Matrix, model: RangingModel
    ) -> OlderEvidence:
        """With the measurements `rows` (m, 10), expanded about `mean` (k,)."""
        at = np.array(mean)  # as in `WindowMap.scores`
        sigmas = row_sigmas(rows, at, model)
        u = row_residuals(rows, at, sigmas, model)
        psi = clipped(u, thresholds)
        H = row_partials(rows, at, sigmas, model)
        influence = psi.reshape(-1)
        A = H.T @ ((u == psi).reshape(-1, 1) * H)
        B = H.T @ ((influence**2)[:, None] * H)
        return OlderEvidence(
            self.information + A, self.pull + A @ mean + H.T @ influence, self.variability + B
        )
