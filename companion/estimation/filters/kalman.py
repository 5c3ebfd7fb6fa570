"""Recursive filters: asymmetric Huber, Huber, ADMM and plain extended Kalman filter, by name.

They share the prediction, and the update with one weight per modality; they differ in thresholds.
The Huber-EKF is symmetric: it treats a long range like a short one. The EKF gives every measurement
the weight one.

The ADMM-EKF handles the non-negative bias by splitting instead of by a closed form. For one
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
from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.domain import Params, PositionEnu, Positive, RangingMeasurement
from companion.estimation.filters.robust_update import (
    asymmetric_huber_weight,
    innovations,
    is_positive_definite,
    joseph_row,
    lateness_variance,
    robust_update,
    settled,
)
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.measurement_model import RangingModel, jacobian, variances
from companion.kernel import Matrix, Vector, frozen, kernel

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
        """Last arguments of the kernel, the same for every measurement."""
        self._latest: tuple[object, object, tuple[Vector, ...]] = (None, None, ())
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
            pose, z, sigma = self.params.kernel_row(measurement, sensor_enu_m)
            self._latest = measurement, sensor_enu_m, (np.array(pose), z, sigma)
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
        ranged, borne, elevated = (ModalityReport.of_row(row[:-1]) for row in reports)
        nis = sum(row[-1] for row in reports if not math.isnan(row[-1]))
        return UpdateReport(state, ranged, borne, elevated, nis, is_sane)


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
    S = spread + np.diag(inflation / penalty)
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
    H = jacobian(mean, sensor_enu_m, model)
    y = innovations(z, mean, sensor_enu_m, model)
    R = variances(P, mean, sensor_enu_m, sigma, model)
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


FilterKind = Literal["asymmetric_huber", "huber", "admm", "ekf"]

KINDS: dict[FilterKind, Callable[[FilterParams], TargetFilter]] = {
    "asymmetric_huber": AsymmetricHuberEkf,
    "huber": HuberEkf,
    "admm": AdmmEkf,
    "ekf": Ekf,
}
"""Filter classes by their configured names."""


def filter_of(kind: FilterKind, params: FilterParams) -> TargetFilter:
    """Return the filter of that name; its `params` are those in force, thresholds included."""
    return KINDS[kind](params)
