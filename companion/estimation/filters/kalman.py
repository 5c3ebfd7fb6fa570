"""Recursive filters: asymmetric Huber, Huber and plain extended Kalman filter, by name.

They share the prediction, and the update with one weight per modality; they differ in thresholds.
The Huber-EKF is symmetric: it treats a long range like a short one. The EKF gives every measurement
the weight one.

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
from collections.abc import Callable
from operator import mul
from typing import Literal

import msgspec
import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.measurement_model import RangingModel, linearised
from companion.estimation.number_or_array import wrapped
from companion.estimation.window.map_kernels import argument_columns
from companion.kernel import IS_COMPILED, Matrix, Vector, frozen, kernel

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
    """Return `is_positive_definite` computed entry by entry, see `joseph_row_by_entries`."""
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
    """Return the variance that a late measurement gains from the target's random walk."""
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


KernelResult = tuple[Vector, Matrix, Matrix, bool]
"""Mean, covariance, report and positive definiteness, as the update kernels return them."""


class RecursiveFilter:
    """Extended Kalman filter whose rows are weighted by the params' thresholds.

    The `kernel` has the arguments and results of `robust_update`; `options` are its further
    arguments.
    """

    def __init__(
        self,
        params: FilterParams,
        kernel: Callable[..., KernelResult] = robust_update,
        options: tuple[float, ...] = (),
    ) -> None:
        self.params = params
        self.kernel = kernel
        self._walk = params.process_noise_m_per_sqrt_s
        self.settings = (params.thresholds, params.bounds, params.model, *options)
        """Last arguments of the kernel, which are the same for every measurement."""
        self._columns = argument_columns(params.model)
        self._latest: tuple[object, object, list[Vector]] = (None, None, [])
        """Latest measurement, sensor position and kernel arguments, reused for all hypotheses."""

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        """Return the state at `time_s`; the covariance grows by the random walk, if any."""
        q = self._walk
        dt_s = time_s - state.time_s
        if q == 0.0 or dt_s <= 0.0:
            return FilterState(max(time_s, state.time_s), state.mean, state.covariance)
        P = np.array(state.covariance)
        for index in (0, 1, self.params.model.height_index):
            if index >= 0:
                P[index, index] += q * q * dt_s
        return FilterState(time_s, state.mean, frozen(P))

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        """Return the result of a measurement; see `TargetFilter.update`.

        A late measurement of a moving target is fused from the sensor position at its time; the
        random walk since then is added to its noise. (Its correlation with the state's own error is
        left out, which makes the filter slightly conservative.)
        """
        late_s = max(state.time_s - measurement.measured_at_s, 0.0)
        if self._latest[0] is not measurement or self._latest[1] is not sensor_enu_m:
            row = self.params.kernel_row(measurement, sensor_enu_m)
            self._latest = measurement, sensor_enu_m, [row[columns] for columns in self._columns]
        mean, P, rows, is_sane = self.kernel(
            state.mean,
            state.covariance,
            *self._latest[2],
            self._walk**2 * late_s,
            np.array(inflation),
            *self.settings,
        )
        if is_sane:
            mean.setflags(write=False)
            P.setflags(write=False)
            state = FilterState(state.time_s, mean, P)
        reports = rows.tolist()
        modalities = [None if math.isnan(row[0]) else ModalityReport(*row[:-1]) for row in reports]
        nis = sum([row[-1] for row in reports if not math.isnan(row[-1])])
        return UpdateReport(state, tuple(modalities), nis, is_sane)


class AsymmetricHuberEkf(RecursiveFilter):
    """Filter of the paper: ranges linear above `range_k_long`, bearings on both sides.

    With `range_k_short` ranges are linear on the short side as well, for sensors whose gross errors
    are short; without it the loss is the paper's.

    Paper: eqs. (7) to (9), used recursively. Deviations: the range is slant; the variances contain
    second-order terms and the vehicle position's uncertainty (`measurement_model`), without which
    the filter diverges near the target and is over-confident right above it.
    """


class HuberEkf(RecursiveFilter):
    """Symmetric baseline, which ignores that b >= 0. Paper: eq. (8) for every modality."""

    def __init__(self, params: FilterParams) -> None:
        super().__init__(msgspec.structs.replace(params, range_k_short=params.range_k_long))


class Ekf(RecursiveFilter):
    """Baseline without robust weights; thresholds in the params are ignored."""

    def __init__(self, params: FilterParams) -> None:
        no_thresholds = {"range_k_long": None, "range_k_short": None, "bearing_k": None}
        super().__init__(msgspec.structs.replace(params, **no_thresholds))


FilterKind = Literal["asymmetric_huber", "huber", "ekf"]

KINDS: dict[FilterKind, Callable[[FilterParams], TargetFilter]] = {
    "asymmetric_huber": AsymmetricHuberEkf,
    "huber": HuberEkf,
    "ekf": Ekf,
}
"""Filter classes by their configured names."""


def filter_of(kind: FilterKind, params: FilterParams) -> TargetFilter:
    """Return the filter of that name; its `params` are those in force, thresholds included."""
    return KINDS[kind](params)
