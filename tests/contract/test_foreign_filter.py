"""Another filter is one class and one row: the tracker asks for what `TargetFilter` promises."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import KINDS, FilterKind
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    ModalityReport,
    TargetFilter,
    UpdateReport,
)
from companion.estimation.measurement_model import jacobian, predicted, variances
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.map_kernels import argument_columns

TARGET = (12.0, -7.0)
FOREIGN = cast(FilterKind, "foreign")


class InformationFilter:
    """Sums information, row by row, without weights or bounds; it has the protocol's three."""

    __slots__ = ("params",)

    def __init__(self, params: FilterParams) -> None:
        self.params = params

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        return FilterState(max(time_s, state.time_s), state.mean, state.covariance)

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        p = self.params
        seen = p.kernel_row(measurement, sensor_enu_m)
        position, z, sigma = [seen[columns] for columns in argument_columns(p.model)]
        y = z - predicted(state.mean, position, p.model)
        y[1] = math.remainder(y[1], math.tau)
        H = jacobian(state.mean, position, p.model)
        R = variances(state.covariance, state.mean, position, sigma, p.model)
        information, pull, nis = np.linalg.inv(state.covariance), np.zeros(len(state.mean)), 0.0
        rows: list[ModalityReport | None] = [None, None, None]
        for row in np.flatnonzero(~np.isnan(y)):
            spread = float(H[row] @ state.covariance @ H[row])
            S, noise = spread + inflation[row] * R[row], math.sqrt(R[row])
            rows[row] = ModalityReport(y[row], S, noise, y[row] / noise, 1.0, spread / R[row])
            information = information + np.outer(H[row], H[row]) / (inflation[row] * R[row])
            pull += H[row] * y[row] / (inflation[row] * R[row])
            nis += y[row] ** 2 / S
        covariance = np.linalg.inv(information)
        mean = state.mean + covariance @ pull
        after = FilterState.of(state.time_s, mean, 0.5 * (covariance + covariance.T))
        return UpdateReport(after, tuple(rows[:3]), float(nis), True)


def test_a_filter_that_has_nothing_but_the_protocol_runs_in_the_tracker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[TargetFilter] = []

    def make(params: FilterParams) -> TargetFilter:
        made.append(InformationFilter(params))
        return made[-1]

    monkeypatch.setitem(KINDS, FOREIGN, make)
    params = TrackerParams(kind=FOREIGN)
    tracker, rng = TargetTracker(params), np.random.default_rng(5)
    for step in range(160):
        angle = 0.1 * step
        position = (TARGET[0] + 25.0 * math.cos(angle), TARGET[1] + 25.0 * math.sin(angle), 20.0)
        seen = RangingMeasurement(
            emitter_id=1,
            measured_at_s=0.2 * step,
            range_m=math.dist(position, (*TARGET, 0.0)) + float(rng.normal(0.0, 1.5)),
            bearing_enu_rad=math.remainder(
                angle + math.pi + float(rng.normal(0.0, 0.03)), math.tau
            ),
        )
        assert tracker.fuse(seen, position, 0.2 * step).reject_reason is None
        if step == 100:
            tracker.move((3.0, 0.0, 0.0), 0.0)
            tracker.move((-3.0, 0.0, 0.0), 0.0)
    estimate, belief = tracker.estimate(32.0), tracker.belief
    assert estimate is not None
    assert math.dist(estimate.position_enu_m, TARGET) <= max(estimate.r95_m, 1.0)
    assert tracker.health.observability is not None
    assert belief is not None
    assert TargetTracker(params).resume(belief, 1.0, 33.0) is None
    assert len(made) == 2
