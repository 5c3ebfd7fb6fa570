"""Robust losses, and the measurement update that the recursive filters share, as kernels.

Losses. A reflected path is longer than the straight one, never shorter, so the bias b of a range is
non-negative. With an exponential prior of rate lambda on it, the MAP bias of one measurement is the
soft threshold b* = max(0, r - lambda sigma^2), and putting it back gives a loss that is quadratic
up to tau = lambda sigma^2 and linear above: the one-sided Huber loss. Over the whitened residual
u = r / sigma the threshold is k = tau / sigma = lambda sigma, and

    loss       u^2/2           -k_short <= u <= k_long       k_long  (u - k_long/2)   above
    influence  u                                             k_long                   above
    weight     1                                             k_long / u               above

and the mirror image below -k_short. k_short = infinity is the one-sided loss of the paper,
k_short = k_long the symmetric Huber loss, both infinite the quadratic loss. A finite k_short serves
sensors whose gross errors are short (recorded UWB has bursts of them).

The update in Joseph form. With whitened innovations u = y / sqrt(R) and the weights w(u),

    R_eff = c R / w                          the same R_eff in S, K and the Joseph form
    S     = H P H^T + R_eff
    K     = P H^T S^-1
    x    <- x + K y
    P    <- (I - K H) P (I - K H)^T + K R_eff K^T

where c is the inflation. The modalities have independent noise, so the joint update
is done row by row with all rows linearised at the same prior mean, which is the same thing without
a matrix inverse.

Paper: eqs. (6) to (10), Propositions A.1 to A.4, used recursively.
"""

from __future__ import annotations

import math
from operator import mul

import numpy as np

from companion.estimation.measurement_model import RangingModel, linearised
from companion.estimation.number_or_array import wrapped
from companion.kernel import IS_COMPILED, Matrix, Vector, kernel

DEFINITE_MARGIN = 1e-14
"""Share of the variances that is subtracted before a covariance must have a Cholesky factor.

Twice the rounding error of a factor of 6 components (N. J. Higham, Accuracy and Stability of
Numerical Algorithms, theorem 10.7), so that two computers accept the same covariances.
"""


@kernel
def asymmetric_huber_loss(u: float, k_long: float, k_short: float) -> float:
    """Return the loss of a whitened residual; convex and C1. Paper: eqs. (7), (8)."""
    if u > k_long:
        return k_long * (u - 0.5 * k_long)
    if u < -k_short:
        return k_short * (-u - 0.5 * k_short)
    return 0.5 * u * u


@kernel
def asymmetric_huber_influence(u: float, k_long: float, k_short: float) -> float:
    """Return the derivative of the loss: the residual clipped to [-k_short, k_long]."""
    return min(max(u, -k_short), k_long)


@kernel
def asymmetric_huber_weight(u: float, k_long: float, k_short: float) -> float:
    """Return the robust weight, influence over residual, in (0, 1]."""
    if u > k_long:
        return k_long / u
    if u < -k_short:
        return -k_short / u
    return 1.0


def threshold(k: float | None) -> float:
    """Return a configured threshold as a number; none is infinity."""
    return math.inf if k is None else k


def joseph_row(P: Matrix, H: Vector, R: float) -> tuple[Vector, Matrix, float]:
    """Return gain, covariance and innovation variance of one measurement row, in Joseph form.

        S = H P H^T + R,   K = P H^T / S,   P <- (I - K H) P (I - K H)^T + K R K^T

    with H (n,) and P (n, n) symmetric positive definite; the result is K (n,), the new P, exactly
    symmetric, and S. The product is expanded factor by factor, each a rank-one change of the one
    before: the same numbers as with full matrices, and as robust, without a matrix product.
    """
    PH = np.dot(P, H)
    S = float(np.dot(H, PH)) + R
    K = PH / S
    left = P - K.reshape(-1, 1) * PH
    updated = left + (R * K - np.dot(left, H)).reshape(-1, 1) * K
    return K, 0.5 * (updated + updated.T), S


@kernel
def joseph_row_by_entries(P: Matrix, H: Vector, R: float) -> tuple[Vector, Matrix, float]:
    """Return the result of `joseph_row`, entry by entry: faster when compiled, slower in Python."""
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
    """Return the most probable mean (n,) within the bounds of all components (projection).

    Unbounded components follow along P. A component that another's projection pushed over its bound
    is projected in turn, which only approximates the most probable mean; a final clip makes the
    bounds exact.
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
    """Return True if mean and covariance are finite, and P is positive definite with a margin."""
    if not math.isfinite(float(mean.sum() + P.sum())):
        return False
    factor: list[list[float]] = []
    for i, row in enumerate(P.tolist()):
        own: list[float] = []
        for j, upper in enumerate(factor):
            own.append((row[j] - sum(map(mul, own, upper))) / upper[j])
        left = row[i] - sum(map(mul, own, own)) - DEFINITE_MARGIN * row[i]
        if not left > 0.0:
            return False
        factor.append([*own, math.sqrt(left)])
    return True


@kernel
def is_positive_definite_by_entries(mean: Vector, P: Matrix) -> bool:
    """Return the result of `is_positive_definite`, entry by entry, see `joseph_row_by_entries`."""
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


@kernel
def lateness_variance(H: Vector, late_m2: float, model: RangingModel) -> float:
    """Return the variance that a late measurement row gains by a random walk of the target."""
    position2 = H[0] * H[0] + H[1] * H[1]
    if model.height_index >= 0:
        position2 += H[model.height_index] * H[model.height_index]
    return float(position2) * late_m2


@kernel
def robust_update(
    mean: Vector,
    P: Matrix,
    sensor_enu_m: Vector,
    z: Vector,
    sigma: Vector,
    late_m2: float,
    inflation: Vector,
    thresholds: Matrix,
    bounds: Matrix,
    model: RangingModel,
) -> tuple[Vector, Matrix, Matrix, bool]:
    """Update the state with one measurement of up to m rows, each with its own robust weight.

    Args:
        z: (m,) range, bearing, elevation, power; NaN where not measured.
        sigma: (m,) noise of the radio.
        late_m2: Variance per axis that the target gained since the measurement was taken.
        inflation: (m,) factors on the variances.
        thresholds: (m, 2) long and short threshold of each modality, in sigma; inf: none.
        bounds: (2, n) lower and upper bounds of the state.

    Returns:
        Mean (n,), covariance (n, n), report (m, 7) with the fields of `ModalityReport` in their
        order, the row's share of the NIS, and NaN rows where nothing was measured, and True if the
        covariance is positive definite; if it is not, mean and covariance are those given.
    """
    y, H, R = linearised(z, P, mean, sensor_enu_m, sigma, model)
    report = np.full((y.size, 7), np.nan)
    new_mean, new_P = mean, P
    for row in range(y.size):
        innovation, by_state = float(y[row]), H[row]
        if math.isnan(innovation):
            continue
        variance = float(R[row])
        if late_m2 > 0.0:
            variance += lateness_variance(by_state, late_m2, model)
        noise_sigma = math.sqrt(variance)
        u = innovation / noise_sigma
        weight = asymmetric_huber_weight(u, float(thresholds[row, 0]), float(thresholds[row, 1]))
        remaining = innovation - float(np.dot(by_state, new_mean - mean))
        effective = float(inflation[row]) * variance / weight
        K, updated, S = joseph_row(new_P, by_state, effective)
        report[row, 0] = innovation
        report[row, 1] = S
        report[row, 2] = noise_sigma
        report[row, 3] = u
        report[row, 4] = weight
        report[row, 5] = (S - effective) / variance
        report[row, 6] = remaining * remaining / S
        new_mean, new_P = new_mean + K * remaining, updated
    new_mean = settled(new_mean, new_P, bounds)
    if is_positive_definite(new_mean, new_P):
        return new_mean, new_P, report, True
    return mean, P, report, False


@kernel
def settled(mean: Vector, P: Matrix, bounds: Matrix) -> Vector:
    """Return the mean within its bounds, its bearing offset within half a turn."""
    mean = within_bounds(mean, P, bounds[0], bounds[1])
    if abs(mean[3]) > math.pi:
        mean = mean.copy()
        mean[3] = wrapped(mean[3])
    return mean
