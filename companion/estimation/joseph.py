"""The Kalman arithmetic that every filter here shares: one row in Joseph form, hard bounds."""

from __future__ import annotations

import math

import numpy as np

from companion.geometry.arrays import Matrix, Vector
from companion.kernel import IS_COMPILED, kernel

DEFINITE_MARGIN = 1e-14
"""Share of the variances without which a covariance must still have a Cholesky factor.

Twice what rounding can do to a factor of 6 components (N. J. Higham, Accuracy and Stability of
Numerical Algorithms, theorem 10.7), so that two computers never differ about what was accepted.
"""


def joseph_row(P: Matrix, H: Vector, R: float) -> tuple[Vector, Matrix, float]:
    """Gain, covariance and innovation variance of one measurement row, in Joseph form.

        S = H P H^T + R,   K = P H^T / S,   P <- (I - K H) P (I - K H)^T + K R K^T

    The product is multiplied out factor by factor, each a rank-one change of the one before: the
    same numbers as with full matrices, and as robust, without a matrix product.

    Args:
        P: (n, n), symmetric positive definite.
        H: (n,) row of partials.
        R: Effective variance.

    Returns:
        K (n,), the new P (n, n), exactly symmetric, and S.
    """
    PH = np.dot(P, H)
    S = float(np.dot(H, PH)) + R
    K = PH / S
    left = P - K.reshape(-1, 1) * PH
    updated = left + (R * K - np.dot(left, H)).reshape(-1, 1) * K
    return K, 0.5 * (updated + updated.T), S


@kernel
def joseph_row_by_entries(P: Matrix, H: Vector, R: float) -> tuple[Vector, Matrix, float]:
    """The same entry by entry: faster than arrays for a compiler, slower for an interpreter."""
    n = H.size
    PH, K, rest = np.empty(n), np.empty(n), np.empty(n)
    left, updated = np.empty((n, n)), np.empty((n, n))
    S = R
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += P[i, j] * H[j]
        PH[i] = total
        S += H[i] * total
    for i in range(n):
        K[i] = PH[i] / S
        total = 0.0
        for j in range(n):
            left[i, j] = P[i, j] - K[i] * PH[j]
            total += left[i, j] * H[j]
        rest[i] = R * K[i] - total
    for i in range(n):
        for j in range(i + 1):
            entry = left[i, j] + rest[i] * K[j] + left[j, i] + rest[j] * K[i]
            updated[i, j] = updated[j, i] = 0.5 * entry
    return K, updated, S


if IS_COMPILED:
    joseph_row = joseph_row_by_entries


@kernel
def within_bounds(mean: Vector, P: Matrix, lower: Vector, upper: Vector) -> Vector:
    """The most probable mean with every component between its bounds (estimate projection).

    Components without bounds follow along P. A component that another's projection pushed over
    its bound is projected in turn, which only comes near the most probable mean; the last word has
    a clip, so that bounds hold exactly.

    Args:
        mean: (n,).
        P: (n, n).
        lower: (n,), -inf where there is none.
        upper: (n,), inf where there is none.
    """
    is_inside = True
    for index in range(mean.size):
        if mean[index] < lower[index] or mean[index] > upper[index]:
            is_inside = False
    if is_inside:
        return mean
    for _ in range(2):
        for index in range(mean.size):
            value = min(max(mean[index], lower[index]), upper[index])
            if value != mean[index]:
                mean = mean + P[:, index] * ((value - mean[index]) / P[index, index])
    bounded: Vector = np.minimum(np.maximum(mean, lower), upper)
    return bounded


def is_positive_definite(mean: Vector, P: Matrix) -> bool:
    """Whether mean and covariance are finite, and the covariance positive definite for certain."""
    if not math.isfinite(float(mean.sum() + P.sum())):
        return False
    certain = P.copy()
    for index in range(mean.size):
        certain[index, index] *= 1.0 - DEFINITE_MARGIN
    try:
        np.linalg.cholesky(certain)
    except np.linalg.LinAlgError:
        return False
    return True


@kernel
def is_positive_definite_by_entries(mean: Vector, P: Matrix) -> bool:
    """The same entry by entry, see `joseph_row_by_entries`."""
    if not math.isfinite(mean.sum() + P.sum()):
        return False
    n = mean.size
    factor = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            left = P[i, j]
            for k in range(j):
                left -= factor[i, k] * factor[j, k]
            if i == j:
                left -= DEFINITE_MARGIN * P[i, i]
                if not left > 0.0:
                    return False
                factor[i, i] = math.sqrt(left)
            else:
                factor[i, j] = left / factor[j, j]
    return True


if IS_COMPILED:
    is_positive_definite = is_positive_definite_by_entries
