"""What every filter of the target's position promises, whatever it is inside."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.asymmetric_huber_ekf import AsymmetricHuberEkf
from companion.estimation.base import FilterParams, FilterState, TargetFilter, UpdateReport
from companion.models.ranging_model import predicted_bearing, predicted_range

Make = Callable[..., TargetFilter]

VARIANTS: dict[str, FilterParams] = {
    "one-sided": FilterParams(),
    "symmetric": FilterParams(range_k_short=1.5),
    "asymmetric": FilterParams(range_k_short=3.0),
    "quadratic": FilterParams(range_k_long=None, bearing_k=None),
    "as printed": FilterParams(near_target_terms=False, own_position_sigma_m=0.0),
    "bounded": FilterParams(range_offset_min_m=0.0, range_offset_max_m=3.0),
    "moving": FilterParams(process_noise_m_per_sqrt_s=0.5),
}


@pytest.fixture(params=VARIANTS)
def params(request: pytest.FixtureRequest) -> FilterParams:
    return VARIANTS[request.param]


@pytest.fixture(params=[AsymmetricHuberEkf])
def make(request: pytest.FixtureRequest) -> Make:
    kind: Make = request.param
    return kind


def _state(position_sigma_m: float = 30.0) -> FilterState:
    sigmas = np.array([position_sigma_m, position_sigma_m, 5.0, math.radians(5.0)])
    return FilterState.of(0.0, np.array([40.0, 20.0, 1.0, 0.01]), np.diag(sigmas**2))


def _seen(
    time_s: float, range_m: float | None = 50.0, bearing_rad: float | None = 0.4
) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id=1, measured_at_s=time_s, range_m=range_m, bearing_enu_rad=bearing_rad
    )


def _expected(state: FilterState, place: PositionEnu) -> RangingMeasurement:
    """What the state itself predicts."""
    sensor = np.array(place)
    return _seen(
        state.time_s,
        predicted_range(state.mean, sensor, 0.0),
        math.remainder(predicted_bearing(state.mean, sensor), 2.0 * math.pi),
    )


def assert_sane(report: UpdateReport, before: FilterState) -> None:
    """Either untouched and said so, or symmetric, positive definite and not more uncertain."""
    after = report.state
    if not report.is_positive_definite:
        assert after is before
        return
    assert np.isfinite(after.mean).all()
    assert np.array_equal(after.covariance, after.covariance.T)
    np.linalg.cholesky(after.covariance)
    # Rounding of (I - K H) P (I - K H)' scales with the entries of P.
    rounding = 1e-12 * float(np.trace(before.covariance))
    for index in range(4):
        assert after.covariance[index, index] <= before.covariance[index, index] + rounding
    for row in (report.range, report.bearing):
        assert row is None or 0.0 < row.weight <= 1.0


HOSTILE_SIGMAS = (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e12, 3e38)


def _hostile(rng: np.random.Generator, time_s: float) -> RangingMeasurement:
    """Any positive range, any direction, any positive sigma: what a tracker lets through."""
    has = int(rng.integers(1, 4))
    sigmas = [float(rng.choice(HOSTILE_SIGMAS)) if rng.random() < 0.3 else None for _ in range(2)]
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=float(rng.choice([1e-9, 1e-3, rng.uniform(0.1, 100.0), 2000.0]))
        if has & 1
        else None,
        range_sigma_m=sigmas[0],
        bearing_enu_rad=float(rng.uniform(-2.0 * math.pi, 2.0 * math.pi)) if has & 2 else None,
        bearing_sigma_rad=sigmas[1],
    )


def test_hostile_sequences_leave_it_sane_or_refused(make: Make, params: FilterParams) -> None:
    target_filter = make(params)
    rng = np.random.default_rng(7)
    for _ in range(300):
        state = _state(float(rng.choice([1e-3, 1.0, 30.0, 1e4])))
        for _ in range(6):
            dt_s = float(rng.choice([0.0, 1e-9, 0.1, 5.0, 1e6]))
            place = (*rng.uniform(-100.0, 100.0, 2), float(rng.uniform(0.0, 60.0)))
            if rng.random() < 0.3:
                place = (float(state.mean[0]), float(state.mean[1]), 0.0)  # right on the estimate
            prior = target_filter.predict(state, state.time_s + dt_s)
            report = target_filter.update(prior, _hostile(rng, prior.time_s), place)
            assert_sane(report, prior)
            state = report.state


def test_the_same_place_again_and_again(make: Make, params: FilterParams) -> None:
    target_filter, state = make(params), _state()
    for step in range(300):
        prior = target_filter.predict(state, float(step))
        report = target_filter.update(prior, _seen(float(step)), (0.0, 0.0, 20.0))
        assert report.is_positive_definite
        assert_sane(report, prior)
        state = report.state


def test_right_on_the_estimate(make: Make, params: FilterParams) -> None:
    state = _state(1.0)
    place = (40.0, 20.0, 0.0)
    report = make(params).update(state, _seen(0.0, 1e-6, 2.0), place)
    assert report.is_positive_definite
    assert_sane(report, state)
    # There is no direction in it: the place stays, only the offsets may take it.
    assert report.state.mean[:2].tolist() == [40.0, 20.0]


def test_no_surprise_no_move(make: Make, params: FilterParams) -> None:
    target_filter, state = make(params), _state()
    for place in ((0.0, 0.0, 20.0), (80.0, -10.0, 5.0), (41.0, 22.0, 30.0), (60.0, 20.0, 0.0)):
        report = target_filter.update(state, _expected(state, place), place)
        np.testing.assert_allclose(report.state.mean, state.mean, rtol=0.0, atol=1e-12)
        assert np.trace(report.state.covariance[:2, :2]) < np.trace(state.covariance[:2, :2])
        assert report.nis == pytest.approx(0.0, abs=1e-12)


def test_it_is_pure(make: Make, params: FilterParams) -> None:
    target_filter, state = make(params), _state()
    mean, covariance = state.mean.tobytes(), state.covariance.tobytes()
    first = target_filter.update(target_filter.predict(state, 3.0), _seen(3.0), (0.0, 0.0, 20.0))
    target_filter.update(first.state, _seen(4.0, 5.0, -2.0), (10.0, 5.0, 20.0))
    again = target_filter.update(target_filter.predict(state, 3.0), _seen(3.0), (0.0, 0.0, 20.0))
    assert (state.mean.tobytes(), state.covariance.tobytes()) == (mean, covariance)
    assert again.state.mean.tobytes() == first.state.mean.tobytes()
    assert again.state.covariance.tobytes() == first.state.covariance.tobytes()


def test_stored_arrays_are_read_only(make: Make, params: FilterParams) -> None:
    target_filter = make(params)
    predicted = target_filter.predict(_state(), 3.0)
    updated = target_filter.update(predicted, _seen(3.0), (0.0, 0.0, 20.0)).state
    for state in (_state(), predicted, updated):
        with pytest.raises(ValueError, match="read-only"):
            state.mean[0] = 1.0
        with pytest.raises(ValueError, match="read-only"):
            state.covariance[0, 0] = 1.0


@pytest.mark.parametrize("dt_s", [-5.0, 0.0, 1e-12, 1.0, 1e9])
def test_time_never_runs_backwards_and_certainty_never_grows_by_waiting(
    make: Make, params: FilterParams, dt_s: float
) -> None:
    state = _state()
    predicted = make(params).predict(state, state.time_s + dt_s)
    assert predicted.time_s == max(0.0, dt_s)
    assert predicted.mean.tobytes() == state.mean.tobytes()
    grown_m2 = params.process_noise_m_per_sqrt_s**2 * max(dt_s, 0.0)
    expected = state.covariance + np.diag([grown_m2, grown_m2, 0.0, 0.0])
    np.testing.assert_allclose(predicted.covariance, expected, rtol=1e-15)


def test_huge_thresholds_are_no_thresholds(make: Make, params: FilterParams) -> None:
    robust = make(replace_k(params, 1e6))
    plain = make(replace_k(params, None))
    rng = np.random.default_rng(11)
    one = other = _state()
    for step in range(50):
        place = (*rng.uniform(-60.0, 60.0, 2), 20.0)
        seen = _seen(float(step), float(rng.uniform(1.0, 150.0)), float(rng.uniform(-3.0, 3.0)))
        one = robust.update(robust.predict(one, float(step)), seen, place).state
        other = plain.update(plain.predict(other, float(step)), seen, place).state
        assert one.mean.tobytes() == other.mean.tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()


def replace_k(params: FilterParams, k: float | None) -> FilterParams:
    """The same filter with one threshold for everything."""
    values = {field: getattr(params, field) for field in params.__struct_fields__}
    return FilterParams(**{**values, "range_k_long": k, "range_k_short": k, "bearing_k": k})


def test_a_long_range_moves_a_robust_filter_less_than_a_short_one(make: Make) -> None:
    state, place = _state(3.0), (0.0, 0.0, 0.0)
    range_m = _expected(state, place).range_m
    assert range_m is not None
    moves_m = [
        float(np.linalg.norm((report.state.mean - state.mean)[:2]))
        for report in (
            make(FilterParams()).update(state, _seen(0.0, range_m + error_m, None), place)
            for error_m in (30.0, -30.0)
        )
    ]
    assert moves_m[0] < moves_m[1]


def test_inflation_makes_it_learn_less(make: Make, params: FilterParams) -> None:
    state, place = _state(), (0.0, 0.0, 20.0)
    once = make(params).update(state, _seen(0.0), place)
    inflated = make(params).update(state, _seen(0.0), place, inflation=(9.0, 9.0))
    assert np.trace(inflated.state.covariance) > np.trace(once.state.covariance)
    assert inflated.range is not None
    assert once.range is not None
    assert inflated.range.weight == once.range.weight


def test_a_reported_sigma_counts_only_where_it_is_wanted(make: Make) -> None:
    place = (0.0, 0.0, 20.0)
    vague = replace(_seen(0.0), range_sigma_m=50.0, bearing_sigma_rad=1.0)
    heeding = make(FilterParams()).update(_state(), vague, place)
    deaf = make(FilterParams(use_reported_sigma=False)).update(_state(), vague, place)
    plain = make(FilterParams()).update(_state(), _seen(0.0), place)
    assert deaf.state.covariance.tobytes() == plain.state.covariance.tobytes()
    assert np.trace(heeding.state.covariance) > np.trace(plain.state.covariance)


def test_the_range_offset_stays_within_its_bounds(make: Make) -> None:
    target_filter = make(FilterParams(range_offset_min_m=0.0, range_offset_max_m=3.0))
    rng = np.random.default_rng(3)
    state, touched = _state(), set()
    for step in range(200):
        place = (*rng.uniform(-60.0, 60.0, 2), 0.0)
        bias_m = 8.0 if step < 100 else -8.0
        range_m = max(math.dist(place[:2], (40.0, 20.0)) + bias_m, 1.0)
        state = target_filter.update(state, _seen(float(step), range_m, None), place).state
        offset_m = float(state.mean[2])
        assert -1e-12 <= offset_m <= 3.0 + 1e-12
        touched.add(round(offset_m, 9))
    assert {0.0, 3.0} <= touched


def test_the_bearing_offset_stays_an_angle(make: Make) -> None:
    """A hostile bearing can push the offset over pi: it comes back on the other side."""
    params = FilterParams(bearing_offset_sigma_deg=500.0, bearing_k=None)
    sigmas = np.array([1e-3, 1e-3, 1.0, math.radians(500.0)])
    state = FilterState.of(0.0, np.array([40.0, 0.0, 0.0, 3.1]), np.diag(sigmas**2))
    report = make(params).update(state, _seen(0.0, None, -3.0), (0.0, 0.0, 0.0))
    assert report.state.mean[3] == pytest.approx(-3.0, abs=0.01)


def test_bearings_wrap(make: Make, params: FilterParams) -> None:
    """West of the sensor, just above and just below the cut are the same direction."""
    state = FilterState.of(0.0, np.array([-50.0, 0.5, 0.0, 0.0]), np.diag([9.0, 9.0, 1.0, 1e-4]))
    report = make(params).update(state, _seen(0.0, None, -math.pi + 0.01), (0.0, 0.0, 0.0))
    assert report.bearing is not None
    assert report.bearing.innovation == pytest.approx(0.02, abs=1e-3)


def test_bounds_that_leave_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="range_offset_min_m"):
        FilterParams(range_offset_min_m=3.0, range_offset_max_m=3.0)
