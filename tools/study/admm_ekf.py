"""ADMM-EKF of the paper's comparison.

It handles the non-negative bias by splitting instead of by a closed form. For one
measurement it minimises, over the change d of the state, with whitened residuals v,

    1/2 d^T P^-1 d + sum_m rho_m(v_m)      subject to   v_m = (y_m - H_m d) / sqrt(R_m)

where rho is the paper's loss (its inner minimum over b >= 0 is the soft threshold). With a scaled
dual w and a penalty kappa, the alternating direction method of multipliers repeats (~: whitened)

    d <- argmin 1/2 d^T P^-1 d + kappa/2 |y~ - H~ d - v + w|^2      a Kalman update, R / kappa
    v <- argmin rho(v) + kappa/2 |y~ - H~ d - v + w|^2              the proximal map of rho
    w <- w + y~ - H~ d - v

The covariance is that of the weights psi(v) / v at the end, in Joseph form. With few iterations the
result depends on the penalty, which the closed form does not have.

Source: S. Boyd et al., Distributed Optimization and Statistical Learning via ADMM (2011), ch. 3 and
6. Paper: the baseline "ADMM-EKF"; it does not print its splitting.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np

from companion.domain import Params, Positive
from companion.estimation.filters.kalman import (
    KINDS,
    RecursiveFilter,
    asymmetric_huber_weight,
    is_positive_definite,
    joseph_row,
    lateness_variance,
    settled,
)
from companion.estimation.filters.target_filter import FilterParams, TargetFilter
from companion.estimation.measurement_model import (
    RangingModel,
    linearised,
)
from companion.kernel import Matrix, Vector, kernel


class AdmmParams(Params, frozen=True):
    """Iterations and penalty of the splitting."""

    iterations: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10
    penalty: Positive = 1.0
    """Penalty kappa, in units of the whitened residual's own curvature."""


@kernel
def proximal_residual(a: float, k_long: float, k_short: float, penalty: float) -> float:
    """Return the v that minimises rho(v) + penalty/2 (a - v)^2, rho the asymmetric Huber loss."""
    v = a * penalty / (1.0 + penalty)
    if v > k_long:
        return a - k_long / penalty
    if v < -k_short:
        return a + k_short / penalty
    return v


@kernel
def split(
    P: Matrix,
    H: Matrix,
    y: Vector,
    thresholds: Matrix,
    inflation: Vector,
    iterations: int,
    penalty: float,
) -> tuple[Vector, Vector]:
    """Return the change of the state (n,) and the split residuals v (3,) after these iterations.

    H (3, n) and y (3,) are whitened, and zero where nothing was measured; `inflation` (3,) are
    factors on the variances, by which the loss is divided. `thresholds` are (3, 2), P is (n, n).
    """
    PHt = np.dot(P, H.T.copy())
    spread = np.dot(H, PHt)
    S = spread + np.diag(inflation[: y.size] / penalty)
    gain = np.linalg.solve(S, PHt.T.copy()).T.copy()
    explained = np.dot(H, gain)  # share of the residuals that a step of the state explains
    v, dual, asked = np.zeros(3), np.zeros(3), np.zeros(3)
    for _ in range(iterations):
        for row in range(3):
            asked[row] = y[row] - v[row] + dual[row]
        for row in range(3):
            gap = y[row] + dual[row]
            for column in range(3):
                gap -= explained[row, column] * asked[column]
            v[row] = proximal_residual(gap, thresholds[row, 0], thresholds[row, 1], penalty)
            dual[row] = gap - v[row]
    d = np.dot(gain, asked)
    return d, v


@kernel
def admm_update(
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
    iterations: int,
    penalty: float,
) -> tuple[Vector, Matrix, Matrix, bool]:
    """Update the state with one measurement by splitting; arguments as in `robust_update`."""
    y, H, R = linearised(z, P, mean, sensor_enu_m, sigma, model)
    whitened_H = np.zeros((3, mean.size))
    whitened_y = np.zeros(3)
    report = np.full((3, 7), np.nan)
    for row in range(3):
        if not math.isnan(y[row]):
            R[row] += lateness_variance(H[row], late_m2, model)
            whitened_H[row] = H[row] / math.sqrt(R[row])
            whitened_y[row] = y[row] / math.sqrt(R[row])
    d, v = split(P, whitened_H, whitened_y, thresholds, inflation, iterations, penalty)
    new_P = P
    explained = np.zeros(mean.size)
    for row in range(3):
        if math.isnan(y[row]):
            continue
        weight = asymmetric_huber_weight(float(v[row]), thresholds[row, 0], thresholds[row, 1])
        effective = inflation[row] * R[row] / weight
        remaining = y[row] - np.dot(H[row], explained)
        K, new_P, S = joseph_row(new_P, H[row], effective)
        explained = explained + K * remaining
        prior_share, nis = (S - effective) / R[row], remaining * remaining / S
        noise_sigma = math.sqrt(R[row])
        report[row] = np.array((y[row], S, noise_sigma, whitened_y[row], weight, prior_share, nis))
    new_mean = settled(mean + d, new_P, bounds)
    if is_positive_definite(new_mean, new_P):
        return new_mean, new_P, report, True
    return mean, P, report, False


class AdmmEkf(RecursiveFilter):
    """Iterative baseline."""

    def __init__(self, params: FilterParams, admm: AdmmParams | None = None) -> None:
        self.admm = admm or AdmmParams()
        super().__init__(params, admm_update, (self.admm.iterations, self.admm.penalty))


RECURSIVE: dict[str, Callable[[FilterParams], TargetFilter]] = {
    **{str(kind): make for kind, make in KINDS.items()},
    "admm": AdmmEkf,
}
"""Recursive filters by their names in studies: the companion's and this one."""
