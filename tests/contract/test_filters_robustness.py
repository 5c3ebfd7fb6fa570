"""Promises of robust filters beyond the others, and cases in which they equal them."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.estimation.filters.kalman import AsymmetricHuberEkf, Ekf, HuberEkf
from companion.estimation.filters.target_filter import FilterParams
from tests.contract.filter_helpers import (
    FILTERS,
    ONE_SIDED,
    ROBUST,
    VARIANTS,
    assert_same,
    expected_by,
    moved_m,
    state_of,
    sure_state,
    surprises,
)
from tools.study.admm_ekf import AdmmEkf, AdmmParams


def replace_k(params: FilterParams, k: float | None) -> FilterParams:
    """The same filter with one threshold for everything."""
    return msgspec.structs.replace(params, range_k_long=k, range_k_short=k, bearing_k=k)


@pytest.mark.parametrize("name", [*ROBUST, "ekf"])
def test_huge_thresholds_are_no_thresholds(name: str, params: FilterParams) -> None:
    robust, plain = FILTERS[name](replace_k(params, 1e6)), FILTERS[name](replace_k(params, None))
    one = other = state_of(params)
    for seen, position in surprises(50):
        one = robust.update(robust.predict(one, seen.measured_at_s), seen, position).state
        other = plain.update(plain.predict(other, seen.measured_at_s), seen, position).state
        assert_same(one, other)


@pytest.mark.parametrize("name", ["huber", "asymmetric_huber"])
def test_without_thresholds_a_robust_filter_is_the_ekf(name: str, params: FilterParams) -> None:
    robust, plain = FILTERS[name](replace_k(params, None)), Ekf(params)
    one = other = state_of(params)
    for seen, position in surprises(50):
        one = robust.update(robust.predict(one, seen.measured_at_s), seen, position).state
        other = plain.update(plain.predict(other, seen.measured_at_s), seen, position).state
        assert_same(one, other)


def test_without_thresholds_much_splitting_is_the_ekf(params: FilterParams) -> None:
    split = AdmmEkf(replace_k(params, None), AdmmParams(iterations=1000, penalty=0.1))
    plain = Ekf(params)
    state = state_of(params)
    for seen, position in surprises(20):
        prior = plain.predict(state, seen.measured_at_s)
        split_state, state = (f.update(prior, seen, position).state for f in (split, plain))
        np.testing.assert_allclose(split_state.covariance, state.covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(split_state.mean, state.mean, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("k", [0.5, 1.5, 4.0])
def test_with_equal_thresholds_the_asymmetric_filter_is_the_huber_ekf(
    params: FilterParams, k: float
) -> None:
    symmetric = AsymmetricHuberEkf(replace_k(params, k))
    huber = HuberEkf(msgspec.structs.replace(params, range_k_long=k, bearing_k=k))
    one = other = state_of(params)
    for seen, position in surprises(50):
        one = symmetric.update(symmetric.predict(one, seen.measured_at_s), seen, position).state
        other = huber.update(huber.predict(other, seen.measured_at_s), seen, position).state
        assert_same(one, other)


def test_the_ekf_heeds_no_thresholds(params: FilterParams) -> None:
    one, other = Ekf(params), Ekf(replace_k(params, 0.1))
    state = state_of(params)
    for seen, position in surprises(10):
        report = one.update(state, seen, position)
        assert_same(report.state, other.update(state, seen, position).state)
        assert all(m is not None and m.weight == 1.0 for m in report.modalities)
        state = report.state


@pytest.mark.parametrize("name", ROBUST)
def test_a_gross_error_moves_a_robust_filter_less_than_the_ekf(
    name: str, params: FilterParams
) -> None:
    if params == VARIANTS["quadratic"]:
        return
    position = (0.0, 0.0, 3.0)
    state = sure_state(params)
    gross = expected_by(state, position, params, np.array([30.0, 0.5, 0.0]))
    robust = FILTERS[name](params).update(state, gross, position)
    assert moved_m(robust, state) < 0.7 * moved_m(Ekf(params).update(state, gross, position), state)
    assert robust.range is not None
    assert robust.range.weight < 1.0


@pytest.mark.parametrize("name", ONE_SIDED)
def test_a_long_range_moves_a_one_sided_filter_less_than_a_short_one(name: str) -> None:
    params, position = FilterParams(), (0.0, 0.0, 0.0)
    state = sure_state(params)
    moves_m = []
    for error_m in (30.0, -30.0):
        seen = expected_by(state, position, params, np.array([error_m, 0.0, 0.0]))
        report = FILTERS[name](params).update(
            state, replace(seen, bearing_enu_rad=None, elevation_rad=None), position
        )
        moves_m.append(moved_m(report, state))
    assert moves_m[0] < 0.5 * moves_m[1]


def test_to_the_symmetric_filter_long_is_as_wrong_as_short() -> None:
    params, position = FilterParams(), (0.0, 0.0, 0.0)
    state = sure_state(params)
    moves_m = []
    for error_m in (30.0, -30.0):
        seen = expected_by(state, position, params, np.array([error_m, 0.0, 0.0]))
        report = HuberEkf(params).update(
            state, replace(seen, bearing_enu_rad=None, elevation_rad=None), position
        )
        moves_m.append(moved_m(report, state))
    assert moves_m[0] == pytest.approx(moves_m[1], rel=1e-9)
