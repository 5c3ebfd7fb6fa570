"""Hostile sequences: the same story every time, and no broken promise goes unseen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import Ekf, HuberEkf
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterParams,
    FilterState,
    Inflation,
    UpdateReport,
)
from tests.contract.hostile_sequences import (
    SIGMAS,
    MakeFilter,
    SequenceOutcome,
    fault_of,
    hostile_measurement,
    hostile_params,
    hostile_state,
    least_correlation_eigenvalue,
    run_campaign,
    run_sequence,
)
from tools.study.admm_ekf import RECURSIVE

Break = Callable[[UpdateReport, FilterState], UpdateReport]


@dataclass(frozen=True)
class Broken:
    """An EKF whose reports are tampered with."""

    params: FilterParams
    tamper: Break

    def predict(self, state: FilterState, time_s: float) -> FilterState:
        return Ekf(self.params).predict(state, time_s)

    def update(
        self,
        state: FilterState,
        measurement: RangingMeasurement,
        sensor_enu_m: PositionEnu,
        inflation: Inflation = NO_INFLATION,
    ) -> UpdateReport:
        report = Ekf(self.params).update(state, measurement, sensor_enu_m, inflation)
        return self.tamper(report, state)


def _with_covariance(report: UpdateReport, covariance: np.ndarray) -> UpdateReport:
    state = report.state
    return replace(report, state=FilterState.of(state.time_s, state.mean, covariance))


def _with_mean(report: UpdateReport, mean: np.ndarray) -> UpdateReport:
    state = report.state
    return replace(report, state=FilterState.of(state.time_s, mean, state.covariance))


def _grown(report: UpdateReport, state: FilterState) -> UpdateReport:
    return _with_covariance(report, 1.1 * state.covariance)


def _crooked(report: UpdateReport, _: FilterState) -> UpdateReport:
    P = np.array(report.state.covariance)
    P[0, 1] += 1e-9 * P[0, 0]
    return _with_covariance(report, P)


def _indefinite(report: UpdateReport, _: FilterState) -> UpdateReport:
    P = np.array(report.state.covariance)
    P[0, 1] = P[1, 0] = 1.001 * np.sqrt(P[0, 0] * P[1, 1])
    return _with_covariance(report, P)


def _negative(report: UpdateReport, _: FilterState) -> UpdateReport:
    return _with_covariance(report, -report.state.covariance)


def _unbounded(report: UpdateReport, _: FilterState) -> UpdateReport:
    mean = np.array(report.state.mean)
    mean[3] = 7.0
    return _with_mean(report, mean)


def _not_finite(report: UpdateReport, _: FilterState) -> UpdateReport:
    return _with_mean(report, report.state.mean * np.nan)


def _lost_and_changed(report: UpdateReport, _: FilterState) -> UpdateReport:
    return replace(_with_mean(report, report.state.mean + 1.0), is_positive_definite=False)


TAMPERED: dict[str, Break] = {
    "grew by": _grown,
    "not symmetric": _crooked,
    "not positive definite": _indefinite,
    "out of bounds": _unbounded,
    "not finite": _not_finite,
    "declared lost, but the state changed": _lost_and_changed,
}


@pytest.mark.parametrize("fault", TAMPERED)
def test_a_broken_promise_is_found_out(fault: str) -> None:
    params = FilterParams()
    broken = Broken(params, TAMPERED[fault])
    outcome = run_sequence(broken, params, np.random.default_rng(1))
    assert len(outcome.faults) == 1
    assert outcome.faults[0].startswith(fault)
    assert outcome.updates == 1  # it ends there


def test_a_negative_variance_is_not_definite() -> None:
    params = FilterParams()
    outcome = run_sequence(Broken(params, _negative), params, np.random.default_rng(1))
    assert outcome.faults[0].startswith("not positive definite")
    assert least_correlation_eigenvalue(-np.eye(3)) == -np.inf


def test_a_weight_must_be_a_share() -> None:
    params = FilterParams()
    state = hostile_state(params, np.random.default_rng(2))
    seen = RangingMeasurement(1, 0.0, range_m=50.0)
    report = Ekf(params).update(state, seen, (0.0, 0.0, 20.0))
    assert report.range is not None
    assert fault_of(report, state, params.bounds) is None
    for weight in (0.0, 1.5):
        wrong = replace(
            report, modalities=(replace(report.range, weight=weight), *report.modalities[1:])
        )
        assert fault_of(wrong, state, params.bounds) == "weight not in (0, 1]"


def test_to_give_up_with_the_state_as_it_was_is_no_fault() -> None:
    params = FilterParams()

    def give_up(report: UpdateReport, state: FilterState) -> UpdateReport:
        return replace(report, state=state, is_positive_definite=False)

    outcome = run_sequence(Broken(params, give_up), params, np.random.default_rng(1), steps=5)
    assert outcome == SequenceOutcome(1, 5, 5)


MAKE: dict[str, MakeFilter] = {"ekf": Ekf, "huber": HuberEkf}


def test_a_campaign_is_the_same_whole_or_in_parts() -> None:
    whole = run_campaign(MAKE, 0, 40, seed=3)
    parts = run_campaign(MAKE, 0, 15, seed=3).joined(run_campaign(MAKE, 15, 25, seed=3))
    assert whole == parts
    assert whole.sequences == 40
    assert whole.faults == ()
    one, other = (hostile_measurement(0.0, np.random.default_rng(seed)) for seed in (3, 4))
    assert one != other


def test_a_fault_names_its_sequence() -> None:
    make: dict[str, MakeFilter] = {"ekf": Ekf, "grown": lambda params: Broken(params, _grown)}
    outcome = run_campaign(make, 0, 6, seed=1)
    assert [fault.split(":")[0] for fault in outcome.faults] == [
        f"grown, sequence {number}" for number in (1, 3, 5)
    ]


def test_it_is_as_hostile_as_it_says() -> None:
    rng = np.random.default_rng(5)
    drawn = [hostile_params(rng) for _ in range(200)]
    assert {p.prior[0].size for p in drawn} == {4, 5, 6}
    assert any(np.isfinite(p.bounds).any() for p in drawn)
    seen = [hostile_measurement(0.0, rng) for _ in range(500)]
    assert {m.range_sigma_m for m in seen} - {None} == set(SIGMAS)
    assert 0.0 in {m.range_m for m in seen}
    for m in seen:
        assert (m.range_m, m.bearing_enu_rad, m.elevation_rad) != (None, None, None)
    for params in drawn:
        state = hostile_state(params, rng)
        assert np.array_equal(state.covariance, state.covariance.T)
        assert least_correlation_eigenvalue(state.covariance) > 0.0


@pytest.mark.campaign
def test_a_hundred_thousand_sequences_break_no_promise() -> None:
    assert run_campaign(RECURSIVE, 0, 100_000, seed=1).faults == ()
