"""The measurement update that the recursive filters share, as kernels.

With whitened innovations u = y / sqrt(R) and the weights w(u) of `losses`,

    R_eff = c R / w                          the same R_eff in S, K and the Joseph form
    S     = H P H^T + R_eff
    K     = P H^T S^-1
    x    <- x + K y
    P    <- (I - K H) P (I - K H)^T + K R_eff K^T

where c is the inflation. Range, bearing and elevation have independent noise, so the joint update
is done row by row with all rows linearised at the same prior mean, which is the same thing without
a matrix inverse.

Paper: eqs. (7) to (9), used recursively.
"""

from __future__ import annotations

import math

import numpy as np

from companion.estimation.joseph import is_positive_definite, joseph_row, within_bounds
from companion.estimation.losses import asymmetric_huber_weight
from companion.geometry.arrays import Matrix, Vector
from companion.kernel import kernel
from companion.models.ranging_model import (
    RangingModel,
    jacobian,
    predicted,
    variances,
)


@kernel
def wrapped(angle_rad: float) -> float:
    """The same direction in [-pi, pi)."""
    turned = (angle_rad + math.pi) % (2.0 * math.pi)
    return turned - math.pi


@kernel
def innovations(z: Vector, mean: Vector, sensor_enu_m: Vector, model: RangingModel) -> Vector:
    """Measured minus predicted, (3,), the bearing's wrapped; NaN where nothing was measured."""
    y = z - predicted(mean, sensor_enu_m, model)
    y[1] = wrapped(y[1])
    return y


@kernel
def lateness_variance(H: Vector, late_m2: float, model: RangingModel) -> float:
    """What a random walk of the target adds to the variance of one late measurement row."""
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
    """One measurement of up to three rows, each with the weight of its own innovation.

    Args:
        mean: (n,).
        P: (n, n).
        sensor_enu_m: (3,).
        z: (3,) range, bearing, elevation; NaN where not measured.
        sigma: (3,) noise of the radio.
        late_m2: Variance per axis that the target gained since the measurement was taken.
        inflation: (3,) factors on the variances.
        thresholds: (3, 2) long and short threshold of each modality, in sigma; inf: none.
        bounds: (2, n) lower and upper bounds of the state.
        model: The constants.

    Returns:
        Mean, covariance, report (3, 7) with the fields of `ModalityReport` in their order, the
        row's share of the NIS, and NaN rows where nothing was measured, and whether the covariance
        is positive definite; where it is not, mean and covariance are those given.
    """
    H = jacobian(mean, sensor_enu_m, model)
    y = innovations(z, mean, sensor_enu_m, model)
    R = variances(P, mean, sensor_enu_m, sigma, model)
    report = np.full((3, 7), np.nan)
    new_mean, new_P = mean, P
    for row in range(3):
        if math.isnan(y[row]):
            continue
        variance = float(R[row]) + lateness_variance(H[row], late_m2, model)
        noise_sigma = math.sqrt(variance)
        u = float(y[row]) / noise_sigma
        weight = asymmetric_huber_weight(u, thresholds[row, 0], thresholds[row, 1])
        remaining = y[row] - np.dot(H[row], new_mean - mean)
        K, updated, S = joseph_row(new_P, H[row], inflation[row] * variance / weight)
        report[row, 0] = y[row]
        report[row, 1] = S
        report[row, 2] = noise_sigma
        report[row, 3] = u
        report[row, 4] = weight
        report[row, 5] = (S - inflation[row] * variance / weight) / variance
        report[row, 6] = remaining * remaining / S
        new_mean, new_P = new_mean + K * remaining, updated
    new_mean = settled(new_mean, new_P, bounds)
    if is_positive_definite(new_mean, new_P):
        return new_mean, new_P, report, True
    return mean, P, report, False


@kernel
def settled(mean: Vector, P: Matrix, bounds: Matrix) -> Vector:
    """The mean within its bounds, its bearing offset an angle within half a turn."""
    mean = within_bounds(mean, P, bounds[0], bounds[1])
    if abs(mean[3]) > math.pi:
        mean = mean.copy()
        mean[3] = wrapped(mean[3])
    return mean
