"""Promises of every filter of the target's position, whatever its method."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterParams, FilterState
from companion.estimation.measurement_model import jacobian, predicted
from tests.contract.filter_helpers import (
    OF_FILTERPY,
    SPACE,
    assert_same,
    assert_sane,
    expected_by,
    seen_at,
    state_of,
)
from tests.contract.hostile_sequences import MakeFilter, fault_of, hostile_params, run_sequence

# The covariance


@OF_FILTERPY
def test_hostile_sequences_leave_it_sane_or_declared_lost(make: MakeFilter) -> None:
    """A short form of the campaign in `test_hostile_sequences`, which runs a hundred thousand."""
    updates = lost = 0
    for number in range(150):
        rng = np.random.default_rng([7, number])
        drawn = hostile_params(rng)
        outcome = run_sequence(make(drawn), drawn, rng)
        assert outcome.faults == (), f"sequence {number}"
        updates += outcome.updates
        lost += outcome.refused
    assert lost < 0.02 * updates  # giving up is no way to be sane


@OF_FILTERPY
def test_hostile_sequences_of_every_variant(make: MakeFilter, params: FilterParams) -> None:
    target_filter = make(params)
    for number in range(15):
        outcome = run_sequence(target_filter, params, np.random.default_rng([8, number]))
        assert outcome.faults == (), f"sequence {number}"


def test_a_plausible_walk_never_loses_certainty(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state, rng = make(params), state_of(params), np.random.default_rng(5)
    truth = np.array(state.mean)
    truth[:2] += 10.0, -15.0
    for step in range(60):
        position = (60.0 * math.cos(0.2 * step), 60.0 * math.sin(0.2 * step), 20.0)
        z = predicted(truth, np.array(position), params.model)
        z += rng.normal(size=3) * [1.5, 0.03, 0.08]
        prior = target_filter.predict(state, float(step))
        seen = seen_at(float(step), float(z[0]), math.remainder(z[1], 2.0 * math.pi), float(z[2]))
        report = target_filter.update(prior, seen, position)
        assert_sane(report, prior, params)
        state = report.state


def test_the_same_place_again_and_again(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), state_of(params)
    for step in range(100):
        prior = target_filter.predict(state, float(step))
        report = target_filter.update(prior, seen_at(float(step)), (0.0, 0.0, 20.0))
        assert_sane(report, prior, params)
        state = report.state


def test_right_on_the_estimate(make: MakeFilter, params: FilterParams) -> None:
    state = state_of(params, 1.0)
    position = (40.0, 20.0, params.target_height_m)
    report = make(params).update(state, seen_at(0.0, 1e-6, 2.0), position)
    assert report.is_positive_definite
    assert fault_of(report, state, params.bounds) is None
    # There is no direction in it: the position stays, only the offsets may take it.
    assert report.state.mean[:2].tolist() == [40.0, 20.0]


def test_right_above_the_estimate(make: MakeFilter, params: FilterParams) -> None:
    """The bearing says nothing, the elevation nothing of the position, the range only the rise."""
    state = state_of(params, 1.0)
    for rise_m in (-1e-4, 0.05, 1.0, 20.0):
        position = (40.0, 20.0, params.target_height_m + rise_m)
        seen = seen_at(0.0, abs(rise_m) + 2.0, 2.0, -1.2)
        report = make(params).update(state, seen, position)
        assert report.is_positive_definite
        assert fault_of(report, state, params.bounds) is None
        assert report.state.mean[:2].tolist() == [40.0, 20.0]
        if params.near_target_terms:
            assert report.bearing is not None
            assert report.elevation is not None
            assert min(report.bearing.noise_sigma, report.elevation.noise_sigma) > 1.0


def test_inflation_makes_it_learn_less(make: MakeFilter, params: FilterParams) -> None:
    state, position = state_of(params), (0.0, 0.0, 20.0)
    once = make(params).update(state, seen_at(0.0), position)
    inflated = make(params).update(state, seen_at(0.0), position, inflation=(9.0, 9.0, 9.0))
    assert np.trace(inflated.state.covariance) > np.trace(once.state.covariance)
    assert inflated.range is not None
    assert once.range is not None
    assert inflated.range.noise_sigma == once.range.noise_sigma
    assert inflated.range.whitened_innovation == once.range.whitened_innovation


def test_time_never_runs_backwards_and_certainty_never_grows_by_waiting(
    make: MakeFilter, params: FilterParams
) -> None:
    state = state_of(params)
    for dt_s in (-5.0, 0.0, 1e-12, 1.0, 1e9):
        later = make(params).predict(state, state.time_s + dt_s)
        assert later.time_s == max(0.0, dt_s)
        assert later.mean.tobytes() == state.mean.tobytes()
        grown_m2 = np.zeros(state.mean.size)
        grown_m2[:2] = params.process_noise_m_per_sqrt_s**2 * max(dt_s, 0.0)
        if params.model.height_index >= 0:
            grown_m2[params.model.height_index] = grown_m2[0]
        expected = state.covariance + np.diag(grown_m2)
        np.testing.assert_allclose(later.covariance, expected, rtol=1e-15)


# The mean


def test_no_surprise_no_move(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), state_of(params)
    for position in ((0.0, 0.0, 20.0), (80.0, -10.0, 5.0), (41.0, 22.0, 30.0), (60.0, 20.0, 3.0)):
        report = target_filter.update(state, expected_by(state, position, params), position)
        np.testing.assert_allclose(report.state.mean, state.mean, rtol=0.0, atol=1e-12)
        assert np.trace(report.state.covariance[:2, :2]) < np.trace(state.covariance[:2, :2])
        assert report.nis == pytest.approx(0.0, abs=1e-12)
        assert_sane(report, state, params)


def test_bearings_wrap(make: MakeFilter, params: FilterParams) -> None:
    """West of the sensor, just above and just below the cut are the same direction."""
    mean = state_of(params).mean.copy()
    mean[:4] = -50.0, 0.5, 0.0, 0.0
    state = FilterState.of(0.0, mean, np.diag(np.full(mean.size, 1e-4)))
    report = make(params).update(state, seen_at(0.0, None, -math.pi + 0.01), (0.0, 0.0, 0.0))
    assert report.bearing is not None
    assert report.bearing.innovation == pytest.approx(0.02, abs=1e-3)


def test_elevations_end_overhead_and_underfoot(make: MakeFilter, params: FilterParams) -> None:
    """Just past the zenith is on the other side: there is nothing to wrap, only to stop at."""
    mean = state_of(params).mean.copy()
    mean[:4] = 1e-3, 0.0, 0.0, 0.0
    state = FilterState.of(0.0, mean, np.diag(np.full(mean.size, 1e-4)))
    for side in (1.0, -1.0):
        position = (0.0, 0.0, params.target_height_m - side * 30.0)
        report = make(params).update(
            state, seen_at(0.0, None, None, side * 0.5 * math.pi), position
        )
        assert report.elevation is not None
        assert report.elevation.innovation == pytest.approx(side * 1e-3 / 30.0, rel=1e-3)
        assert_sane(report, state, params)


def test_the_bearing_offset_stays_an_angle(make: MakeFilter) -> None:
    """A hostile bearing can push the offset over pi: it comes back on the other side."""
    params = FilterParams(bearing_offset_sigma_deg=500.0, bearing_k=None)
    sigmas = np.array([1e-3, 1e-3, 1.0, math.radians(500.0)])
    state = FilterState.of(0.0, np.array([40.0, 0.0, 0.0, 3.1]), np.diag(sigmas**2))
    report = make(params).update(state, seen_at(0.0, None, -3.0), (0.0, 0.0, 0.0))
    assert report.state.mean[3] == pytest.approx(-3.0, abs=0.01)


def test_an_elevation_tells_the_height(make: MakeFilter) -> None:
    state, position = state_of(SPACE, 1e-3), (10.0, 20.0, 33.0)
    up_rad = math.atan2(5.0 - 33.0, 30.0)
    report = make(SPACE).update(state, seen_at(0.0, None, None, up_rad), position)
    precise = msgspec.structs.replace(SPACE, elevation_sigma_deg=0.005)
    reported = replace(seen_at(0.0, None, None, up_rad), elevation_sigma_rad=1e-4)
    assert precise.effective_sigmas(reported)[2] == 1e-4
    sharp = make(precise).update(state, reported, position)
    assert 3.0 < report.state.mean[4] < sharp.state.mean[4]
    assert sharp.state.mean[4] == pytest.approx(5.0, abs=0.2)


# It is a function


def test_it_is_pure(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), state_of(params)
    mean, covariance = state.mean.tobytes(), state.covariance.tobytes()
    first = target_filter.update(target_filter.predict(state, 3.0), seen_at(3.0), (0.0, 0.0, 20.0))
    target_filter.update(first.state, seen_at(4.0, 5.0, -2.0, 0.1), (10.0, 5.0, 20.0))
    again = target_filter.update(target_filter.predict(state, 3.0), seen_at(3.0), (0.0, 0.0, 20.0))
    assert (state.mean.tobytes(), state.covariance.tobytes()) == (mean, covariance)
    assert_same(again.state, first.state)


def test_stored_arrays_are_read_only(make: MakeFilter, params: FilterParams) -> None:
    target_filter = make(params)
    later = target_filter.predict(state_of(params), 3.0)
    updated = target_filter.update(later, seen_at(3.0), (0.0, 0.0, 20.0)).state
    for state in (state_of(params), later, updated):
        with pytest.raises(ValueError, match="read-only"):
            state.mean[0] = 1.0
        with pytest.raises(ValueError, match="read-only"):
            state.covariance[0, 0] = 1.0


def test_it_reports_what_was_measured_and_nothing_else(
    make: MakeFilter, params: FilterParams
) -> None:
    state, position = state_of(params), (0.0, 0.0, 20.0)
    for has in range(1, 8):
        seen = seen_at(
            0.0, 50.0 if has & 1 else None, 0.4 if has & 2 else None, -0.3 if has & 4 else None
        )
        report = make(params).update(state, seen, position)
        assert [m is not None for m in report.modalities] == [bool(has & bit) for bit in (1, 2, 4)]
        parts = [m for m in report.modalities if m is not None]
        rows = [row for row, m in enumerate(report.modalities) if m is not None]
        H = jacobian(state.mean, np.array(position), params.model)[rows]
        R = np.diag([m.noise_sigma**2 / m.weight for m in parts])
        y = np.array([m.innovation for m in parts])
        assert report.nis == pytest.approx(y @ np.linalg.solve(H @ state.covariance @ H.T + R, y))
        for m in parts:
            assert m.whitened_innovation == pytest.approx(m.innovation / m.noise_sigma)
            assert m.innovation_variance > m.noise_sigma**2
            assert m.prior_share >= 0.0


def test_a_reported_sigma_counts_only_where_it_is_wanted(make: MakeFilter) -> None:
    position = (0.0, 0.0, 20.0)
    vague = replace(
        seen_at(0.0, 50.0, 0.4, -0.3),
        range_sigma_m=50.0,
        bearing_sigma_rad=1.0,
        elevation_sigma_rad=1.0,
    )
    deaf_params = msgspec.structs.replace(SPACE, use_reported_sigma=False)
    heeding = make(SPACE).update(state_of(SPACE), vague, position)
    deaf = make(deaf_params).update(state_of(SPACE), vague, position)
    plain = make(SPACE).update(state_of(SPACE), seen_at(0.0, 50.0, 0.4, -0.3), position)
    assert_same(deaf.state, plain.state)
    assert np.trace(heeding.state.covariance) > np.trace(plain.state.covariance)
