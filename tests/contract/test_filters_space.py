"""Promises of every filter about bounds, and about a target at another height."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import (
    AsymmetricHuberEkf,
    asymmetric_huber_weight,
    joseph_row,
)
from companion.estimation.filters.target_filter import FilterParams, FilterState, threshold
from companion.estimation.measurement_model import predicted
from companion.kernel import Vector
from tests.contract.filter_helpers import BOUNDED, assert_same, seen_at, state_of, surprises
from tests.contract.hostile_sequences import MakeFilter

# Bounds


@pytest.mark.parametrize("height_sigma_m", [0.0, 4.0])
@pytest.mark.parametrize("index", [2, 3, 4])
def test_bounds_hold_exactly_and_are_reached(
    make: MakeFilter, height_sigma_m: float, index: int
) -> None:
    params = msgspec.structs.replace(BOUNDED, target_height_sigma_m=height_sigma_m)
    target_filter, rng = make(params), np.random.default_rng(3)
    touched = set()
    for side in (1.0, -1.0):
        state = state_of(params, 3.0)
        truth = np.array(state.mean)
        truth[2:5] = 0.0
        truth[index] = side * (8.0, 0.5, 0.3)[index - 2]
        for step in range(60):
            position = (*rng.uniform(-60.0, 60.0, 2), 0.0)
            z = predicted(truth, np.array(position), params.model)
            seen = seen_at(float(step), max(float(z[0]), 0.1), float(z[1]), float(z[2]))
            state = target_filter.update(state, seen, position).state
            assert (params.bounds[0] <= state.mean).all()
            assert (state.mean <= params.bounds[1]).all()
            touched.add(float(state.mean[index]))
    assert {float(b) for b in params.bounds[:, index]} <= touched


# Plane and space


def _plane_update(
    state: FilterState, seen: RangingMeasurement, position: PositionEnu, params: FilterParams
) -> tuple[Vector, Vector]:
    """Range and bearing in the plane of flight, written down without any height."""
    east, north = state.mean[0] - position[0], state.mean[1] - position[1]
    distance2 = east * east + north * north
    distance = math.sqrt(distance2)
    assert seen.range_m is not None
    assert seen.bearing_enu_rad is not None
    turn = seen.bearing_enu_rad - (math.atan2(north, east) + state.mean[3])
    y = [
        seen.range_m - (distance + state.mean[2]),
        turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5),
    ]
    H = np.zeros((2, 4))
    H[0, :3] = east * (1.0 / distance), north * (1.0 / distance), 1.0
    H[1] = -north / distance2, east / distance2, 0.0, 1.0
    own2 = params.own_position_sigma_m**2
    trace = state.covariance[0, 0] + state.covariance[1, 1]
    R = [
        params.range_sigma_m**2 + own2 + trace * trace / (4.0 * distance2),
        math.radians(params.bearing_sigma_deg) ** 2 + own2 / distance2 + (trace / distance2) ** 2,
    ]
    mean, P = state.mean, state.covariance
    thresholds = [(threshold(params.range_k_long), math.inf), (threshold(params.bearing_k),) * 2]
    for row in range(2):
        weight = asymmetric_huber_weight(float(y[row]) / math.sqrt(R[row]), *thresholds[row])
        remaining = y[row] - np.dot(H[row], mean - state.mean)
        K, P, _ = joseph_row(P, H[row], 1.0 * R[row] / weight)
        mean = mean + K * remaining
    return mean, P


def test_with_a_known_height_and_no_elevation_space_is_the_plane_bit_for_bit() -> None:
    """In the plane of flight there is nothing else to the arithmetic."""
    params = FilterParams(target_height_m=12.5)
    target_filter, state = AsymmetricHuberEkf(params), state_of(params)
    for seen, (east, north, _) in surprises(200):
        flat = replace(seen, elevation_rad=None)
        position = (east, north, 12.5)
        mean, P = _plane_update(state, flat, position, params)
        report = target_filter.update(state, flat, position)
        assert abs(mean[3]) < math.pi
        assert report.state.mean.tobytes() == mean.tobytes()
        assert report.state.covariance.tobytes() == P.tobytes()
        state = report.state


def test_elevations_that_do_not_count_are_as_good_as_absent(make: MakeFilter) -> None:
    params = FilterParams(use_elevation=False)
    state = other = state_of(params)
    for seen, position in surprises(30):
        report = make(params).update(state, seen, position)
        assert report.elevation is None
        without = replace(seen, elevation_rad=None, elevation_sigma_rad=0.2)
        other = make(FilterParams()).update(other, without, position).state
        assert_same(report.state, other)
        state = report.state


def test_only_the_difference_in_height_counts(make: MakeFilter) -> None:
    low, high = FilterParams(), FilterParams(target_height_m=1024.0)
    one = other = state_of(low)
    for seen, position in surprises(30):
        raised = (position[0], position[1], position[2] + 1024.0)
        one = make(low).update(one, seen, position).state
        other = make(high).update(other, seen, raised).state
        assert_same(one, other)


def test_a_height_known_ever_better_ends_as_a_known_height(make: MakeFilter) -> None:
    known = FilterParams(target_height_m=3.0)
    distances = []
    for sigma_m in (1e-2, 1e-4, 1e-6):
        estimated = msgspec.structs.replace(known, target_height_sigma_m=sigma_m)
        one, other = state_of(estimated, 3.0), state_of(known, 3.0)
        for seen, position in surprises(20):
            one = make(estimated).update(one, seen, position).state
            other = make(known).update(other, seen, position).state
        distances.append(float(np.abs(one.mean[:4] - other.mean).max()))
    assert distances[0] > distances[1] > distances[2]
    assert distances[2] < 1e-6
