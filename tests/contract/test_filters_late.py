"""Promises of every filter about measurements that come late."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams
from tests.contract.filter_helpers import assert_same, seen_at, state_of
from tests.contract.hostile_sequences import MakeFilter


def test_of_a_target_that_lies_still_a_late_measurement_is_as_good(
    make: MakeFilter, params: FilterParams
) -> None:
    params = msgspec.structs.replace(params, process_noise_m_per_sqrt_s=0.0)
    target_filter, position = make(params), (0.0, 0.0, 20.0)
    state = target_filter.predict(state_of(params), 10.0)
    in_time = target_filter.update(state, seen_at(10.0, 50.0, 0.4, -0.3), position)
    for late_s in (1e-3, 0.4, 1.0):
        late = target_filter.update(state, seen_at(10.0 - late_s, 50.0, 0.4, -0.3), position)
        assert_same(late.state, in_time.state)
        assert late.state.time_s == 10.0


def test_the_walk_since_a_late_measurement_is_noise_of_it(
    make: MakeFilter, params: FilterParams
) -> None:
    late_s = 0.4
    walking = msgspec.structs.replace(params, process_noise_m_per_sqrt_s=0.7)
    target_filter, position = make(walking), (10.0, 0.0, 20.0)
    state = state_of(params)
    in_time = target_filter.update(state, seen_at(0.0, 50.0, 0.4, -0.3), position)
    late = target_filter.update(state, seen_at(-late_s, 50.0, 0.4, -0.3), position)
    walked_m2 = 0.7**2 * late_s
    away = np.array([30.0, 20.0, params.target_height_m - 20.0])
    ground_m, slant_m = math.hypot(*away[:2]), float(np.linalg.norm(away))
    has_height = params.model.height_index >= 0
    per_m2 = (
        1.0 if has_height else (ground_m / slant_m) ** 2,
        1.0 / ground_m**2,
        (1.0 if has_height else (away[2] / slant_m) ** 2) / slant_m**2,
    )
    for one, other, share in zip(late.modalities, in_time.modalities, per_m2, strict=True):
        assert one is not None
        assert other is not None
        added = one.noise_sigma**2 - other.noise_sigma**2
        assert added == pytest.approx(share * walked_m2, rel=1e-9)
    assert np.trace(late.state.covariance) > np.trace(in_time.state.covariance)


def test_a_late_measurement_says_no_more_than_one_fused_in_its_turn(make: MakeFilter) -> None:
    """The correlation of walk and error that is left out makes the filter more careful."""
    params = FilterParams(process_noise_m_per_sqrt_s=0.7)
    target_filter, position = make(params), (10.0, 0.0, 20.0)
    in_turn = target_filter.predict(
        target_filter.update(state_of(params, 3.0), seen_at(0.0), position).state, 1.0
    )
    late = target_filter.update(
        target_filter.predict(state_of(params, 3.0), 1.0), seen_at(0.0), position
    ).state
    difference = np.linalg.eigvalsh(late.covariance - in_turn.covariance)
    assert difference[-1] > 1e-3
    assert np.trace(late.covariance) < np.trace(in_turn.covariance) + 2.0 * 0.7**2
