"""Observability of a target from its measurements, and mirror images about a straight track.

The expected robust curvature matrix is C = sum rho''(r) H H^T / sigma^2, where rho'' is 1 on the
quadratic part of the loss and 0 on the saturated ones. Only non-saturated measurements from diverse
directions make it positive definite; the paper calls that bilateral information. With ranges alone,
a target and its mirror image about a straight track are indistinguishable.

Paper: section IV-D, Lemma B.1, Propositions B.1 and B.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.estimation.window.sandwich import Scores
from companion.kernel import Matrix, Vector

COLLINEAR_RATIO = 0.05
"""Spread of a track across over its spread along, below which it is a line."""


@dataclass(frozen=True, slots=True)
class Observability:
    """Live values of the observability at the best hypothesis."""

    ercm: tuple[tuple[float, float], tuple[float, float]]
    """East and north part of the curvature, 1/m^2."""
    min_eigenvalue: float
    """Smallest eigenvalue of it, 1/m^2: curvature in the worst direction."""
    bilateral_share: float
    """Share of measurements on the quadratic part of their loss."""
    track_ratio: float
    """Spread of the track across its own line over the spread along it; 0: collinear."""

    @property
    def is_collinear(self) -> bool:
        """True if the track is a line, so that ranges alone leave a mirror image."""
        return self.track_ratio < COLLINEAR_RATIO


def observability_of(rows: Matrix, scores: Scores) -> Observability:
    """Return the observability of the measurements `rows` (n, 10), linearised as `scores`."""
    is_quadratic = (scores.u == scores.psi) & (scores.is_measured > 0)
    H = scores.H[:, :2]
    C = H.T @ (is_quadratic.reshape(-1, 1) * H)
    measured = int(scores.is_measured.sum())
    _, _, ratio = track_line(rows[:, :2])
    return Observability(
        ercm=((float(C[0, 0]), float(C[0, 1])), (float(C[1, 0]), float(C[1, 1]))),
        min_eigenvalue=float(np.linalg.eigvalsh(C)[0]),
        bilateral_share=float(is_quadratic.sum()) / max(measured, 1),
        track_ratio=ratio,
    )


def track_line(places: Matrix) -> tuple[Vector, Vector, float]:
    """Return the line that fits a track (n, 2) best: a point, unit direction, and spread ratio.

    The ratio is the spread across over the spread along: 0 for a line or a single position, 1 for a
    track that is as wide as long.
    """
    centre = places.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((places - centre).T) if len(places) > 1 else np.eye(2))
    along2 = float(values[1])
    ratio = math.sqrt(max(float(values[0]), 0.0) / along2) if along2 > 1e-12 else 0.0
    return centre, vectors[:, 1], ratio


def mirrored(mean: Vector, places: Matrix) -> Vector:
    """Return the state (k,) reflected about the line of the track of `places` (n, 2)."""
    centre, direction, _ = track_line(places)
    away = mean[:2] - centre
    image = np.array(mean)
    image[:2] = centre + 2.0 * direction * float(direction @ away) - away
    return image
