"""What every filter of the target's position promises, whatever it is inside.

A filter joins by a line in `filters()`; what cannot be promised by a baseline (robustness, say) is
tested on those that do.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.admm_ekf import AdmmEkf, AdmmParams
from companion.estimation.asymmetric_huber_ekf import AsymmetricHuberEkf
from companion.estimation.base import FilterState, UpdateReport
from companion.estimation.ekf import Ekf
from companion.estimation.filter_params import FilterParams
from companion.estimation.huber_ekf import HuberEkf
from companion.estimation.joseph import joseph_row
from companion.estimation.losses import asymmetric_huber_weight, threshold
from companion.geometry.arrays import Vector
from companion.models.ranging_model import jacobian, predicted
from sim_link.evaluation.hostile import MakeFilter, fault_of, hostile_params, run_sequence

FILTERPY = "sim_link.evaluation.filterpy_ekf"


def filters() -> dict[str, MakeFilter]:
    """All filters, the third-party one where it is there."""
    makers: dict[str, MakeFilter] = {
        "ekf": Ekf,
        "huber": HuberEkf,
        "asymmetric_huber": AsymmetricHuberEkf,
        "admm": AdmmEkf,
    }
    if importlib.util.find_spec(FILTERPY) and importlib.util.find_spec("filterpy"):
        makers["filterpy"] = importlib.import_module(FILTERPY).FilterpyEkf
    return makers


FILTERS = filters()
ROBUST = ["huber", "asymmetric_huber", "admm"]
ONE_SIDED = ["asymmetric_huber", "admm"]

OF_FILTERPY = pytest.mark.filterwarnings("ignore:An ill-conditioned matrix detected")
"""What scipy says of the inverse that filterpy takes; its promises hold none the less."""

SPACE = FilterParams(target_height_m=3.0, target_height_sigma_m=4.0)
BOUNDED = FilterParams(
    range_offset_min_m=0.0,
    range_offset_max_m=3.0,
    bearing_offset_max_deg=3.0,
    range_scale_sigma=0.05,
    range_scale_max=0.04,
)
VARIANTS: dict[str, FilterParams] = {
    "one-sided": FilterParams(),
    "symmetric": FilterParams(range_k_short=1.5),
    "asymmetric": FilterParams(range_k_short=3.0),
    "quadratic": FilterParams(range_k_long=None, bearing_k=None),
    "as printed": FilterParams(near_target_terms=False, own_position_sigma_m=0.0),
    "bounded": BOUNDED,
    "moving": FilterParams(process_noise_m_per_sqrt_s=0.5),
    "scaled": FilterParams(range_scale_sigma=0.05),
    "space": SPACE,
    "space, moving": msgspec.structs.replace(SPACE, process_noise_m_per_sqrt_s=0.5),
    "space, scaled": msgspec.structs.replace(SPACE, range_scale_sigma=0.05),
}


@pytest.fixture(params=VARIANTS)
def params(request: pytest.FixtureRequest) -> FilterParams:
    return VARIANTS[request.param]


@pytest.fixture(params=FILTERS)
def make(request: pytest.FixtureRequest) -> MakeFilter:
    return FILTERS[request.param]


def _state(params: FilterParams, position_sigma_m: float = 30.0) -> FilterState:
    """A target at (40, 20), not sure of it, the other components as they are at first."""
    mean, sigmas = params.prior
    mean[:2] = 40.0, 20.0
    mean[2:4] += [1.0, 0.01]
    sigmas[:2] = position_sigma_m
    return FilterState.of(0.0, mean, np.diag(sigmas**2))


def _sure(params: FilterParams) -> FilterState:
    """The same target after many measurements: an error is more likely the radio's."""
    state = _state(params, 1.0)
    return FilterState.of(0.0, state.mean, np.diag(np.minimum(np.diag(state.covariance), 1e-2)))


def _seen(
    time_s: float,
    range_m: float | None = 50.0,
    bearing_rad: float | None = 0.4,
    elevation_rad: float | None = None,
) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id=1,
        measured_at_s=time_s,
        range_m=range_m,
        bearing_enu_rad=bearing_rad,
        elevation_rad=elevation_rad,
    )


def _expected(
    state: FilterState, place: PositionEnu, params: FilterParams, error: Vector | None = None
) -> RangingMeasurement:
    """What the state itself predicts, with an error on top."""
    z = predicted(state.mean, np.array(place), params.model) + (0.0 if error is None else error)
    bearing_rad = math.remainder(float(z[1]), 2.0 * math.pi)
    return _seen(state.time_s, float(z[0]), bearing_rad, float(z[2]))


def _moved_m(report: UpdateReport, state: FilterState) -> float:
    return math.dist(report.state.mean[:2], state.mean[:2])


def assert_sane(report: UpdateReport, prior: FilterState, params: FilterParams) -> None:
    """Symmetric, positive definite, within bounds, and in no direction more uncertain."""
    assert report.is_positive_definite
    assert fault_of(report, prior, params.bounds) is None
    units = 1.0 / np.sqrt(np.diag(prior.covariance))
    learnt = (prior.covariance - report.state.covariance) * np.outer(units, units)
    assert np.linalg.eigvalsh(learnt)[0] > -1e-9


# -- The covariance ------------------------------------------------------------------------------


@OF_FILTERPY
def test_hostile_sequences_leave_it_sane_or_declared_lost(make: MakeFilter) -> None:
    """A short form of tools/hostile_campaign.py, which runs a hundred thousand."""
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
    target_filter, state, rng = make(params), _state(params), np.random.default_rng(5)
    truth = np.array(state.mean)
    truth[:2] += 10.0, -15.0
    for step in range(60):
        place = (60.0 * math.cos(0.2 * step), 60.0 * math.sin(0.2 * step), 20.0)
        z = predicted(truth, np.array(place), params.model)
        z += rng.normal(size=3) * [1.5, 0.03, 0.08]
        prior = target_filter.predict(state, float(step))
        seen = _seen(float(step), float(z[0]), math.remainder(z[1], 2.0 * math.pi), float(z[2]))
        report = target_filter.update(prior, seen, place)
        assert_sane(report, prior, params)
        state = report.state


def test_the_same_place_again_and_again(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), _state(params)
    for step in range(100):
        prior = target_filter.predict(state, float(step))
        report = target_filter.update(prior, _seen(float(step)), (0.0, 0.0, 20.0))
        assert_sane(report, prior, params)
        state = report.state


def test_right_on_the_estimate(make: MakeFilter, params: FilterParams) -> None:
    state = _state(params, 1.0)
    place = (40.0, 20.0, params.target_height_m)
    report = make(params).update(state, _seen(0.0, 1e-6, 2.0), place)
    assert report.is_positive_definite
    assert fault_of(report, state, params.bounds) is None
    # There is no direction in it: the place stays, only the offsets may take it.
    assert report.state.mean[:2].tolist() == [40.0, 20.0]


def test_right_above_the_estimate(make: MakeFilter, params: FilterParams) -> None:
    """The bearing says nothing, the elevation nothing of the place, the range only of the rise."""
    state = _state(params, 1.0)
    for rise_m in (-1e-4, 0.05, 1.0, 20.0):
        place = (40.0, 20.0, params.target_height_m + rise_m)
        seen = _seen(0.0, abs(rise_m) + 2.0, 2.0, -1.2)
        report = make(params).update(state, seen, place)
        assert report.is_positive_definite
        assert fault_of(report, state, params.bounds) is None
        assert report.state.mean[:2].tolist() == [40.0, 20.0]
        if params.near_target_terms:
            assert report.bearing is not None
            assert report.elevation is not None
            assert min(report.bearing.noise_sigma, report.elevation.noise_sigma) > 1.0


def test_inflation_makes_it_learn_less(make: MakeFilter, params: FilterParams) -> None:
    state, place = _state(params), (0.0, 0.0, 20.0)
    once = make(params).update(state, _seen(0.0), place)
    inflated = make(params).update(state, _seen(0.0), place, inflation=(9.0, 9.0, 9.0))
    assert np.trace(inflated.state.covariance) > np.trace(once.state.covariance)
    assert inflated.range is not None
    assert once.range is not None
    assert inflated.range.noise_sigma == once.range.noise_sigma
    assert inflated.range.whitened_innovation == once.range.whitened_innovation


def test_time_never_runs_backwards_and_certainty_never_grows_by_waiting(
    make: MakeFilter, params: FilterParams
) -> None:
    state = _state(params)
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


# -- The mean ------------------------------------------------------------------------------------


def test_no_surprise_no_move(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), _state(params)
    for place in ((0.0, 0.0, 20.0), (80.0, -10.0, 5.0), (41.0, 22.0, 30.0), (60.0, 20.0, 3.0)):
        report = target_filter.update(state, _expected(state, place, params), place)
        np.testing.assert_allclose(report.state.mean, state.mean, rtol=0.0, atol=1e-12)
        assert np.trace(report.state.covariance[:2, :2]) < np.trace(state.covariance[:2, :2])
        assert report.nis == pytest.approx(0.0, abs=1e-12)
        assert_sane(report, state, params)


def test_bearings_wrap(make: MakeFilter, params: FilterParams) -> None:
    """West of the sensor, just above and just below the cut are the same direction."""
    mean = _state(params).mean.copy()
    mean[:4] = -50.0, 0.5, 0.0, 0.0
    state = FilterState.of(0.0, mean, np.diag(np.full(mean.size, 1e-4)))
    report = make(params).update(state, _seen(0.0, None, -math.pi + 0.01), (0.0, 0.0, 0.0))
    assert report.bearing is not None
    assert report.bearing.innovation == pytest.approx(0.02, abs=1e-3)


def test_elevations_end_overhead_and_underfoot(make: MakeFilter, params: FilterParams) -> None:
    """Just past the zenith is on the other side: there is nothing to wrap, only to stop at."""
    mean = _state(params).mean.copy()
    mean[:4] = 1e-3, 0.0, 0.0, 0.0
    state = FilterState.of(0.0, mean, np.diag(np.full(mean.size, 1e-4)))
    for side in (1.0, -1.0):
        place = (0.0, 0.0, params.target_height_m - side * 30.0)
        report = make(params).update(state, _seen(0.0, None, None, side * 0.5 * math.pi), place)
        assert report.elevation is not None
        assert report.elevation.innovation == pytest.approx(side * 1e-3 / 30.0, rel=1e-3)
        assert_sane(report, state, params)


def test_the_bearing_offset_stays_an_angle(make: MakeFilter) -> None:
    """A hostile bearing can push the offset over pi: it comes back on the other side."""
    params = FilterParams(bearing_offset_sigma_deg=500.0, bearing_k=None)
    sigmas = np.array([1e-3, 1e-3, 1.0, math.radians(500.0)])
    state = FilterState.of(0.0, np.array([40.0, 0.0, 0.0, 3.1]), np.diag(sigmas**2))
    report = make(params).update(state, _seen(0.0, None, -3.0), (0.0, 0.0, 0.0))
    assert report.state.mean[3] == pytest.approx(-3.0, abs=0.01)


def test_an_elevation_tells_the_height(make: MakeFilter) -> None:
    state, place = _state(SPACE, 1e-3), (10.0, 20.0, 33.0)
    up_rad = math.atan2(5.0 - 33.0, 30.0)
    report = make(SPACE).update(state, _seen(0.0, None, None, up_rad), place)
    believed = replace(_seen(0.0, None, None, up_rad), elevation_sigma_rad=1e-4)
    sharp = make(SPACE).update(state, believed, place)
    assert 3.0 < report.state.mean[4] < sharp.state.mean[4]
    assert sharp.state.mean[4] == pytest.approx(5.0, abs=0.2)


# -- It is a function ----------------------------------------------------------------------------


def test_it_is_pure(make: MakeFilter, params: FilterParams) -> None:
    target_filter, state = make(params), _state(params)
    mean, covariance = state.mean.tobytes(), state.covariance.tobytes()
    first = target_filter.update(target_filter.predict(state, 3.0), _seen(3.0), (0.0, 0.0, 20.0))
    target_filter.update(first.state, _seen(4.0, 5.0, -2.0, 0.1), (10.0, 5.0, 20.0))
    again = target_filter.update(target_filter.predict(state, 3.0), _seen(3.0), (0.0, 0.0, 20.0))
    assert (state.mean.tobytes(), state.covariance.tobytes()) == (mean, covariance)
    assert_same(again.state, first.state)


def test_stored_arrays_are_read_only(make: MakeFilter, params: FilterParams) -> None:
    target_filter = make(params)
    later = target_filter.predict(_state(params), 3.0)
    updated = target_filter.update(later, _seen(3.0), (0.0, 0.0, 20.0)).state
    for state in (_state(params), later, updated):
        with pytest.raises(ValueError, match="read-only"):
            state.mean[0] = 1.0
        with pytest.raises(ValueError, match="read-only"):
            state.covariance[0, 0] = 1.0


def test_it_reports_what_was_measured_and_nothing_else(
    make: MakeFilter, params: FilterParams
) -> None:
    state, place = _state(params), (0.0, 0.0, 20.0)
    for has in range(1, 8):
        seen = _seen(
            0.0, 50.0 if has & 1 else None, 0.4 if has & 2 else None, -0.3 if has & 4 else None
        )
        report = make(params).update(state, seen, place)
        assert [m is not None for m in report.modalities] == [bool(has & bit) for bit in (1, 2, 4)]
        parts = [m for m in report.modalities if m is not None]
        rows = [row for row, m in enumerate(report.modalities) if m is not None]
        H = jacobian(state.mean, np.array(place), params.model)[rows]
        R = np.diag([m.noise_sigma**2 / m.weight for m in parts])
        y = np.array([m.innovation for m in parts])
        assert report.nis == pytest.approx(y @ np.linalg.solve(H @ state.covariance @ H.T + R, y))
        for m in parts:
            assert m.whitened_innovation == pytest.approx(m.innovation / m.noise_sigma)
            assert m.innovation_variance > m.noise_sigma**2
            assert m.prior_share >= 0.0


def test_a_reported_sigma_counts_only_where_it_is_wanted(make: MakeFilter) -> None:
    place = (0.0, 0.0, 20.0)
    vague = replace(
        _seen(0.0, 50.0, 0.4, -0.3),
        range_sigma_m=50.0,
        bearing_sigma_rad=1.0,
        elevation_sigma_rad=1.0,
    )
    deaf_params = msgspec.structs.replace(SPACE, use_reported_sigma=False)
    heeding = make(SPACE).update(_state(SPACE), vague, place)
    deaf = make(deaf_params).update(_state(SPACE), vague, place)
    plain = make(SPACE).update(_state(SPACE), _seen(0.0, 50.0, 0.4, -0.3), place)
    assert_same(deaf.state, plain.state)
    assert np.trace(heeding.state.covariance) > np.trace(plain.state.covariance)


# -- Robustness ----------------------------------------------------------------------------------


def replace_k(params: FilterParams, k: float | None) -> FilterParams:
    """The same filter with one threshold for everything."""
    return msgspec.structs.replace(params, range_k_long=k, range_k_short=k, bearing_k=k)


def assert_same(one: FilterState, other: FilterState) -> None:
    """Bit for bit."""
    assert one.mean.tobytes() == other.mean.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()


def _surprises(count: int) -> list[tuple[RangingMeasurement, PositionEnu]]:
    """Measurements from anywhere, of anything."""
    rng, drawn = np.random.default_rng(11), []
    for step in range(count):
        place = (*rng.uniform(-60.0, 60.0, 2), 20.0)
        bearing_rad, up_rad = rng.uniform(-3.0, 3.0), rng.uniform(-1.5, 0.5)
        seen = _seen(float(step), rng.uniform(1.0, 150.0), bearing_rad, up_rad)
        drawn.append((seen, place))
    return drawn


@pytest.mark.parametrize("name", [*ROBUST, "ekf"])
def test_huge_thresholds_are_no_thresholds(name: str, params: FilterParams) -> None:
    robust, plain = FILTERS[name](replace_k(params, 1e6)), FILTERS[name](replace_k(params, None))
    one = other = _state(params)
    for seen, place in _surprises(50):
        one = robust.update(robust.predict(one, seen.measured_at_s), seen, place).state
        other = plain.update(plain.predict(other, seen.measured_at_s), seen, place).state
        assert_same(one, other)


@pytest.mark.parametrize("name", ["huber", "asymmetric_huber"])
def test_without_thresholds_a_robust_filter_is_the_ekf(name: str, params: FilterParams) -> None:
    robust, plain = FILTERS[name](replace_k(params, None)), Ekf(params)
    one = other = _state(params)
    for seen, place in _surprises(50):
        one = robust.update(robust.predict(one, seen.measured_at_s), seen, place).state
        other = plain.update(plain.predict(other, seen.measured_at_s), seen, place).state
        assert_same(one, other)


def test_without_thresholds_much_splitting_is_the_ekf(params: FilterParams) -> None:
    split = AdmmEkf(replace_k(params, None), AdmmParams(iterations=1000, penalty=0.1))
    plain = Ekf(params)
    state = _state(params)
    for seen, place in _surprises(20):
        prior = plain.predict(state, seen.measured_at_s)
        split_state, state = (f.update(prior, seen, place).state for f in (split, plain))
        np.testing.assert_allclose(split_state.covariance, state.covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(split_state.mean, state.mean, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("k", [0.5, 1.5, 4.0])
def test_with_equal_thresholds_the_asymmetric_filter_is_the_huber_ekf(
    params: FilterParams, k: float
) -> None:
    symmetric = AsymmetricHuberEkf(replace_k(params, k))
    huber = HuberEkf(msgspec.structs.replace(params, range_k_long=k, bearing_k=k))
    one = other = _state(params)
    for seen, place in _surprises(50):
        one = symmetric.update(symmetric.predict(one, seen.measured_at_s), seen, place).state
        other = huber.update(huber.predict(other, seen.measured_at_s), seen, place).state
        assert_same(one, other)


def test_the_ekf_heeds_no_thresholds(params: FilterParams) -> None:
    one, other = Ekf(params), Ekf(replace_k(params, 0.1))
    state = _state(params)
    for seen, place in _surprises(10):
        report = one.update(state, seen, place)
        assert_same(report.state, other.update(state, seen, place).state)
        assert all(m is not None and m.weight == 1.0 for m in report.modalities)
        state = report.state


@pytest.mark.parametrize("name", ROBUST)
def test_a_gross_error_moves_a_robust_filter_less_than_the_ekf(
    name: str, params: FilterParams
) -> None:
    if params == VARIANTS["quadratic"]:
        return
    place = (0.0, 0.0, 3.0)
    state = _sure(params)
    gross = _expected(state, place, params, np.array([30.0, 0.5, 0.0]))
    robust = FILTERS[name](params).update(state, gross, place)
    assert _moved_m(robust, state) < 0.7 * _moved_m(Ekf(params).update(state, gross, place), state)
    assert robust.range is not None
    assert robust.range.weight < 1.0


@pytest.mark.parametrize("name", ONE_SIDED)
def test_a_long_range_moves_a_one_sided_filter_less_than_a_short_one(name: str) -> None:
    params, place = FilterParams(), (0.0, 0.0, 0.0)
    state = _sure(params)
    moves_m = []
    for error_m in (30.0, -30.0):
        seen = _expected(state, place, params, np.array([error_m, 0.0, 0.0]))
        report = FILTERS[name](params).update(
            state, replace(seen, bearing_enu_rad=None, elevation_rad=None), place
        )
        moves_m.append(_moved_m(report, state))
    assert moves_m[0] < 0.5 * moves_m[1]


def test_to_the_symmetric_filter_long_is_as_wrong_as_short() -> None:
    params, place = FilterParams(), (0.0, 0.0, 0.0)
    state = _sure(params)
    moves_m = []
    for error_m in (30.0, -30.0):
        seen = _expected(state, place, params, np.array([error_m, 0.0, 0.0]))
        report = HuberEkf(params).update(
            state, replace(seen, bearing_enu_rad=None, elevation_rad=None), place
        )
        moves_m.append(_moved_m(report, state))
    assert moves_m[0] == pytest.approx(moves_m[1], rel=1e-9)


# -- Late measurements ---------------------------------------------------------------------------


def test_of_a_target_that_lies_still_a_late_measurement_is_as_good(
    make: MakeFilter, params: FilterParams
) -> None:
    params = msgspec.structs.replace(params, process_noise_m_per_sqrt_s=0.0)
    target_filter, place = make(params), (0.0, 0.0, 20.0)
    state = target_filter.predict(_state(params), 10.0)
    in_time = target_filter.update(state, _seen(10.0, 50.0, 0.4, -0.3), place)
    for late_s in (1e-3, 0.4, 1.0):
        late = target_filter.update(state, _seen(10.0 - late_s, 50.0, 0.4, -0.3), place)
        assert_same(late.state, in_time.state)
        assert late.state.time_s == 10.0


def test_the_walk_since_a_late_measurement_is_noise_of_it(
    make: MakeFilter, params: FilterParams
) -> None:
    late_s = 0.4
    walking = msgspec.structs.replace(params, process_noise_m_per_sqrt_s=0.7)
    target_filter, place = make(walking), (10.0, 0.0, 20.0)
    state = _state(params)
    in_time = target_filter.update(state, _seen(0.0, 50.0, 0.4, -0.3), place)
    late = target_filter.update(state, _seen(-late_s, 50.0, 0.4, -0.3), place)
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
    target_filter, place = make(params), (10.0, 0.0, 20.0)
    in_turn = target_filter.predict(
        target_filter.update(_state(params, 3.0), _seen(0.0), place).state, 1.0
    )
    late = target_filter.update(
        target_filter.predict(_state(params, 3.0), 1.0), _seen(0.0), place
    ).state
    difference = np.linalg.eigvalsh(late.covariance - in_turn.covariance)
    assert difference[-1] > 1e-3
    assert np.trace(late.covariance) < np.trace(in_turn.covariance) + 2.0 * 0.7**2


# -- Bounds --------------------------------------------------------------------------------------


@pytest.mark.parametrize("height_sigma_m", [0.0, 4.0])
@pytest.mark.parametrize("index", [2, 3, 4])
def test_bounds_hold_exactly_and_are_reached(
    make: MakeFilter, height_sigma_m: float, index: int
) -> None:
    params = msgspec.structs.replace(BOUNDED, target_height_sigma_m=height_sigma_m)
    target_filter, rng = make(params), np.random.default_rng(3)
    touched = set()
    for side in (1.0, -1.0):
        state = _state(params, 3.0)
        truth = np.array(state.mean)
        truth[2:5] = 0.0
        truth[index] = side * (8.0, 0.5, 0.3)[index - 2]
        for step in range(60):
            place = (*rng.uniform(-60.0, 60.0, 2), 0.0)
            z = predicted(truth, np.array(place), params.model)
            seen = _seen(float(step), max(float(z[0]), 0.1), float(z[1]), float(z[2]))
            state = target_filter.update(state, seen, place).state
            assert (params.bounds[0] <= state.mean).all()
            assert (state.mean <= params.bounds[1]).all()
            touched.add(float(state.mean[index]))
    assert {float(b) for b in params.bounds[:, index]} <= touched


# -- Plane and space -----------------------------------------------------------------------------


def _plane_update(
    state: FilterState, seen: RangingMeasurement, place: PositionEnu, params: FilterParams
) -> tuple[Vector, Vector]:
    """Range and bearing in the plane of flight, written down without any height."""
    east, north = state.mean[0] - place[0], state.mean[1] - place[1]
    distance2 = east * east + north * north
    distance = math.sqrt(distance2)
    assert seen.range_m is not None
    assert seen.bearing_enu_rad is not None
    turn = seen.bearing_enu_rad - (math.atan2(north, east) + state.mean[3])
    y = [
        seen.range_m - (distance + state.mean[2]),
        (turn + math.pi) % (2.0 * math.pi) - math.pi,
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
    target_filter, state = AsymmetricHuberEkf(params), _state(params)
    for seen, (east, north, _) in _surprises(200):
        flat = replace(seen, elevation_rad=None)
        place = (east, north, 12.5)
        mean, P = _plane_update(state, flat, place, params)
        report = target_filter.update(state, flat, place)
        assert abs(mean[3]) < math.pi
        assert report.state.mean.tobytes() == mean.tobytes()
        assert report.state.covariance.tobytes() == P.tobytes()
        state = report.state


def test_elevations_that_do_not_count_are_as_good_as_absent(make: MakeFilter) -> None:
    params = FilterParams(use_elevation=False)
    state = other = _state(params)
    for seen, place in _surprises(30):
        report = make(params).update(state, seen, place)
        assert report.elevation is None
        without = replace(seen, elevation_rad=None, elevation_sigma_rad=0.2)
        other = make(FilterParams()).update(other, without, place).state
        assert_same(report.state, other)
        state = report.state


def test_only_the_difference_in_height_counts(make: MakeFilter) -> None:
    low, high = FilterParams(), FilterParams(target_height_m=1024.0)
    one = other = _state(low)
    for seen, place in _surprises(30):
        raised = (place[0], place[1], place[2] + 1024.0)
        one = make(low).update(one, seen, place).state
        other = make(high).update(other, seen, raised).state
        assert_same(one, other)


def test_a_height_known_ever_better_ends_as_a_known_height(make: MakeFilter) -> None:
    known = FilterParams(target_height_m=3.0)
    distances = []
    for sigma_m in (1e-2, 1e-4, 1e-6):
        estimated = msgspec.structs.replace(known, target_height_sigma_m=sigma_m)
        one, other = _state(estimated, 3.0), _state(known, 3.0)
        for seen, place in _surprises(20):
            one = make(estimated).update(one, seen, place).state
            other = make(known).update(other, seen, place).state
        distances.append(float(np.abs(one.mean[:4] - other.mean).max()))
    assert distances[0] > distances[1] > distances[2]
    assert distances[2] < 1e-6
