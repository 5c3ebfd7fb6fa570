"""Received power as a measurement: alone, with ranges, and what it must not do."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.domain import PositionAccuracy, PositionEnu, RangingMeasurement
from companion.estimation.filters.kalman import filter_of
from companion.estimation.filters.target_filter import (
    EXPONENT,
    POWER_TOTAL_SIGMA_DB,
    FilterParams,
    FilterState,
)
from companion.estimation.measurement_model import POWER, jacobian, predicted
from companion.estimation.screen import RejectReason
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.map_kernels import COLUMNS, POWER_COLUMNS
from companion.estimation.window.shadows import shadow_weights

PARAMS = FilterParams(power_at_1m_dbm=-40.0, target_height_sigma_m=2.0)
TRUTH = (60.0, 30.0)
HIGH_M = 20.0
OWN = PositionAccuracy(1.0, 2.0, is_reported=True)


def heard(power_dbm: float, at_s: float = 0.0, range_m: float | None = None) -> RangingMeasurement:
    return RangingMeasurement(7, at_s, range_m=range_m, power_dbm=power_dbm)


def test_the_partials_of_power_are_those_of_its_prediction() -> None:
    mean, sensor = np.array([30.0, -20.0, 0.0, 0.0, 1.5, -38.0, 2.9]), np.array([4.0, 5.0, 20.0])
    H = jacobian(mean, sensor, PARAMS.model)
    for index in range(len(mean)):
        step = np.zeros(len(mean))
        step[index] = 1e-5
        low, high = (predicted(mean + s * step, sensor, PARAMS.model)[POWER] for s in (-1.0, 1.0))
        assert H[POWER, index] == pytest.approx((high - low) / 2e-5, abs=1e-6)


def test_power_falls_by_the_exponent_in_every_decade() -> None:
    mean = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -40.0, 2.5])
    for distance_m, power_dbm in ((1.0, -40.0), (10.0, -65.0), (100.0, -90.0)):
        sensor = np.array([0.0, 0.0, distance_m])
        assert predicted(mean, sensor, PARAMS.model)[POWER] == pytest.approx(power_dbm)


def test_a_weak_signal_is_bounded_evidence_and_a_strong_one_is_not() -> None:
    target_filter = filter_of("asymmetric_huber", PARAMS)
    mean, sigmas = PARAMS.prior
    mean[:2] = 40.0, 0.0
    state = FilterState.of(0.0, mean, np.diag(sigmas**2))
    position = (0.0, 0.0, HIGH_M)
    expected_dbm = float(predicted(mean, np.array(position), PARAMS.model)[POWER])
    weak, strong = (
        target_filter.update(state, heard(expected_dbm + off), position).modalities[POWER]
        for off in (-40.0, 20.0)
    )
    assert weak is not None
    assert strong is not None
    assert weak.weight < 0.5
    assert strong.weight == 1.0


def test_a_hundred_looks_from_one_place_weigh_little_more_than_one() -> None:
    def rows(positions: list[PositionEnu]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return np.array([PARAMS.kernel_row(heard(-70.0), position) for position in positions])

    apart = [(200.0 * i, 0.0, HIGH_M) for i in range(5)]
    hovering = [(-500.0, 0.0, HIGH_M)] * 100
    weights = shadow_weights(rows([*apart, *hovering]))
    assert weights[:5] == pytest.approx(1.0, abs=0.02)
    assert 1.0 < weights[5:].sum() < 1.7


def flown(
    tracker: TargetTracker, seed: int, *, with_ranges: bool = False, has_power: bool = True
) -> None:
    """Fly two legs that cross near the emitter; power with shadows of 6 dB over 25 m."""
    rng = np.random.default_rng(seed)
    shadow_db, last = 0.0, (0.0, 0.0)
    legs = [((0.0, 0.0), (120.0, 60.0)), ((110.0, -40.0), (10.0, 100.0))]
    positions = [
        (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]))
        for a, b in legs
        for t in np.linspace(0.0, 1.0, 110)
    ]
    for number, position in enumerate(positions):
        kept = math.exp(-math.dist(position, last) / 25.0)
        shadow_db = kept * shadow_db + 6.0 * math.sqrt(1.0 - kept * kept) * rng.normal()
        last, slant_m = position, math.hypot(*np.subtract(TRUTH, position), HIGH_M)
        power_dbm = round(-43.0 - 26.0 * math.log10(slant_m) + shadow_db + 4.0 * rng.normal())
        range_m = slant_m + rng.normal() if with_ranges else None
        seen = heard(power_dbm, 0.25 * number, range_m)
        if not has_power:
            seen = RangingMeasurement(7, 0.25 * number, range_m=range_m)
        tracker.fuse(seen, (*position, HIGH_M), 0.25 * number, OWN)


@pytest.mark.parametrize(
    ("p0_dbm", "flights"),
    [(None, 4), *(pytest.param(p0_dbm, 8, marks=pytest.mark.slow) for p0_dbm in (None, -40.0))],
)
def test_power_alone_locates_to_tens_of_metres_and_says_so(
    p0_dbm: float | None, flights: int
) -> None:
    errors_m, radii_m = [], []
    for seed in range(flights):
        tracker = TargetTracker(TrackerParams(filter=FilterParams(power_at_1m_dbm=p0_dbm)))
        flown(tracker, seed)
        estimate = tracker.estimate(60.0)
        assert estimate is not None
        errors_m.append(math.dist(estimate.position_enu_m, TRUTH))
        radii_m.append(estimate.r95_m)
    assert np.median(errors_m) < 25.0
    assert np.median(radii_m) < 80.0
    assert sum(error > radius for error, radius in zip(errors_m, radii_m, strict=True)) <= 1


def test_planners_know_a_power_as_a_share_of_the_slant_range() -> None:
    tracker = TargetTracker(TrackerParams(filter=PARAMS, adapt_inflation=False))
    tracker.fuse(heard(-80.0), (0.0, 0.0, HIGH_M), 0.0, OWN)
    assert tracker.latest_sigmas is not None
    range_m, _, share = tracker.latest_sigmas
    assert math.isinf(range_m)
    assert share == pytest.approx(POWER_TOTAL_SIGMA_DB * math.log(10.0) / (10.0 * EXPONENT))


@pytest.mark.parametrize("with_ranges", [False, True])
def test_power_at_a_metre_is_an_offset_of_ranges_where_there_are_none(with_ranges: bool) -> None:
    tracker = TargetTracker(TrackerParams(filter=PARAMS))
    flown(tracker, 2, with_ranges=with_ranges)
    state, model = tracker.hypotheses[0].state, PARAMS.model
    joint = tracker.joint_covariance((200.0, 0.0, HIGH_M))
    assert joint is not None
    position = (*state.mean[:2], state.mean[model.height_index])
    metres_per_db = math.dist((200.0, 0.0, HIGH_M), position) * math.log(10.0) / 10.0
    metres_per_db /= float(state.mean[model.power_index + 1])
    index, scale = (2, 1.0) if with_ranges else (model.power_index, -metres_per_db)
    P = state.covariance
    assert joint[2, 2] == pytest.approx(scale**2 * P[index, index])
    assert joint[2, [0, 1, 3]] == pytest.approx(scale * P[index, [0, 1, 3]])
    assert joint[:2, :2] == pytest.approx(P[:2, :2])


def test_a_power_that_is_not_configured_changes_nothing_beside_ranges() -> None:
    with_power, without = TargetTracker(TrackerParams()), TargetTracker(TrackerParams())
    flown(with_power, 1, with_ranges=True)
    flown(without, 1, with_ranges=True, has_power=False)
    assert with_power.estimate(60.0) == without.estimate(60.0)


def test_configured_power_stays_with_the_ranges() -> None:
    params = TrackerParams(filter=FilterParams(power_at_1m_dbm=-40.0))
    tracker = TargetTracker(params)
    flown(tracker, 2, with_ranges=True)
    estimate = tracker.estimate(60.0)
    assert estimate is not None
    assert math.dist(estimate.position_enu_m, TRUTH) < 2.0
    assert tracker.rejected[RejectReason.POWER_OUTLIER] <= 2


def test_a_checkpoint_with_power_is_taken_up_by_a_tracker_that_is_not_configured() -> None:
    before = TargetTracker(TrackerParams())
    flown(before, 3)
    belief = before.belief
    assert belief is not None
    after = TargetTracker(TrackerParams())
    assert after.resume(belief, 1.0, 61.0) is None
    old, new = before.estimate(60.0), after.estimate(61.0)
    assert old is not None
    assert new is not None
    assert new.position_enu_m == pytest.approx(old.position_enu_m)


@pytest.mark.parametrize("power_dbm", [127.0, 61.0, -200.0, math.inf, math.nan])
def test_a_power_that_no_receiver_has_is_rejected(power_dbm: float) -> None:
    tracker = TargetTracker(TrackerParams())
    report = tracker.fuse(heard(power_dbm), (0.0, 0.0, HIGH_M), 0.0, OWN)
    assert report.reject_reason in (RejectReason.POWER_ABSURD, RejectReason.NOT_FINITE)
    assert tracker.estimate(0.0) is None


def test_a_power_that_repeats_over_a_hundred_metres_is_frozen() -> None:
    tracker = TargetTracker(TrackerParams())
    for number in range(60):
        tracker.fuse(heard(-70.0, number), (2.0 * number, 0.0, HIGH_M), float(number), OWN)
    assert tracker.rejected[RejectReason.FROZEN] > 20


def test_a_model_without_power_has_no_row_of_it() -> None:
    plain = msgspec.structs.replace(PARAMS, power_at_1m_dbm=None)
    assert len(plain.thresholds) == 3
    lengths = [len(p.kernel_row(heard(-70.0), (0.0, 0.0, 1.0))) for p in (plain, PARAMS)]
    assert lengths == [COLUMNS, COLUMNS + POWER_COLUMNS]
    assert len(plain.prior[0]) + 2 == len(PARAMS.prior[0])
