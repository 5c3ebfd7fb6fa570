"""What measurements said that no longer fit into the window: a Gaussian prior for those that do.

A measurement that leaves the window is expanded to second order about the estimate of that time,

    rho(u(x)) ~ const - psi H^T (x - x0) + 1/2 (x - x0)^T psi' H H^T (x - x0)

and only the sums are kept. That is for residuals that know nothing of each other. Where they repeat
each other, a measurement that was left out says little that its neighbours in the window do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.map_kernels import clipped, row_partials, row_residuals, row_sigmas
from companion.geometry.arrays import Matrix, Vector
from companion.models.ranging_model import RangingModel


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
        self,
        rows: Matrix,
        mean: Vector,
        thresholds: Matrix,
        model: RangingModel,
    ) -> OlderEvidence:
        """With the measurements `rows`, expanded about `mean`.

        Args:
            rows: (m, 10), see `map_kernels`.
            mean: (k,).
            thresholds: (3, 2).
            model: The constants.
        """
        sigmas = row_sigmas(rows, mean, model)
        u = row_residuals(rows, mean, sigmas, model)
        psi = clipped(u, thresholds)
        H = row_partials(rows, mean, sigmas, model)
        influence = psi.reshape(-1)
        A = H.T @ ((u == psi).reshape(-1, 1) * H)
        B = H.T @ ((influence**2)[:, None] * H)
        return OlderEvidence(
            self.information + A,
            self.pull + A @ mean + H.T @ influence,
            self.variability + B,
        )
