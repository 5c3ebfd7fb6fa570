"""Measurements that left the window, as a Gaussian prior.

Each is expanded to second order about the estimate at the time when it left, and summed:

    rho(u(x)) ~ const - psi H^T (x - x0) + 1/2 (x - x0)^T psi' H H^T (x - x0)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.measurement_model import POWER, RangingModel
from companion.estimation.window.map_kernels import (
    POWER_WEIGHT,
    clipped,
    row_partials,
    row_residuals,
    row_sigmas,
)
from companion.kernel import Matrix, Vector


@dataclass(frozen=True, slots=True)
class OlderEvidence:
    """Gaussian in canonical form, with the sampling variability of its pull."""

    information: Matrix
    """Information L, (k, k)."""
    pull: Vector
    """L times the mean, (k,)."""
    variability: Matrix
    """Sum of psi^2 H H^T, (k, k): the sandwich's B."""

    @classmethod
    def none(cls, size: int) -> OlderEvidence:
        """Return empty evidence for a state of `size` components."""
        return cls(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)))

    @property
    def is_empty(self) -> bool:
        """True if nothing has left the window yet."""
        return not self.information.any()

    def moved(self, step: Vector) -> OlderEvidence:
        """Return the evidence after the state moved by `step`, (k,)."""
        return replace(self, pull=self.pull + self.information @ step)

    def joined(
        self, rows: Matrix, mean: Vector, thresholds: Matrix, model: RangingModel
    ) -> OlderEvidence:
        """Return the evidence with `rows` (m, 10) added, expanded about `mean` (k,)."""
        at = np.array(mean)  # as in `WindowMap.scores`
        sigmas = row_sigmas(rows, at, model)
        u = row_residuals(rows, at, sigmas, model)
        psi = clipped(u, thresholds)
        H = row_partials(rows, at, sigmas, model)
        if len(u) > POWER:  # H and influence with the square root of the weight each
            roots = np.sqrt(rows[:, POWER_WEIGHT])
            H[POWER * len(rows) :] *= roots[:, None]
            psi[POWER], u[POWER] = roots * psi[POWER], roots * u[POWER]
        influence = psi.reshape(-1)
        A = H.T @ ((u == psi).reshape(-1, 1) * H)
        B = H.T @ ((influence**2)[:, None] * H)
        return OlderEvidence(
            self.information + A, self.pull + A @ mean + H.T @ influence, self.variability + B
        )
