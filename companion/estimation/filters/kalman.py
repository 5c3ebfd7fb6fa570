"""Recursive filters: asymmetric Huber, Huber and plain extended Kalman filter, by name.

They share the prediction, and the update with one weight per modality; they differ in thresholds.
The Huber-EKF is symmetric: it treats a long range like a short one. The EKF gives every measurement
the weight one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import msgspec
import numpy as np

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.robust_update import robust_update
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.kernel import Matrix, Vector, frozen

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
        ranged, borne, elevated, *more = [
            None if math.isnan(row[0]) else ModalityReport(*row[:-1]) for row in reports
        ]
        nis = sum([row[-1] for row in reports if not math.isnan(row[-1])])
        return UpdateReport(state, ranged, borne, elevated, nis, is_sane, *more)


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
