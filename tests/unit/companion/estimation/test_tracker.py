"""The tracker: first hypotheses, ambiguity, divergence, and an R95 that keeps its word."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import EstimateState, Point, PositionEnu, RangingMeasurement, TargetEstimate
from companion.estimation.contradiction import CONTRADICTION_COUNT
from companion.estimation.filter_params import FilterParams
from companion.estimation.filters import KINDS, FilterKind, filter_of
from companion.estimation.objections import Objection
from companion.estimation.refusal import Refusal
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window_map import WindowParams
from companion.planning.base import PlanRequest
from companion.planning.latched_crossing import Latch, LatchedCrossing, LatchedCrossingParams

HEIGHT_M = 20.0


def _seen(
    time_s: float, range_m: float | None = None, bearing_rad: float | None = None
) -> RangingMeasurement:
    bearing = None if bearing_rad is None else math.remainder(bearing_rad, 2.0 * math.pi)
    return RangingMeasurement(
        emitter_id=1, measured_at_s=time_s, range_m=range_m, bearing_enu_rad=bearing
    )


def _range_m(place: PositionEnu, target: Point) -> float:
    return math.dist(place, (*target, 0.0))


def _bearing_rad(place: PositionEnu, target: Point) -> float:
    return math.atan2(target[1] - place[1], target[0] - place[0])


def _line(start: Point, end: Point, steps: int) -> list[PositionEnu]:
    return [
        (float(e), float(n), HEIGHT_M)
        for e, n in zip(
            np.linspace(start[0], end[0], steps), np.linspace(start[1], end[1], steps), strict=True
        )
    ]


def _corner() -> list[PositionEnu]:
    """A walk with a turn: 60 m east, then 60 m north."""
    return _line((0.0, 0.0), (60.0, 0.0), 60) + _line((60.0, 1.0), (60.0, 60.0), 60)


def _estimate(tracker: TargetTracker) -> TargetEstimate:
    estimate = tracker.estimate(0.0)
    assert estimate is not None
    return estimate


def _walked(
    places: Iterable[PositionEnu], target: Point, has_range: bool, has_bearing: bool
) -> TargetTracker:
    """Noiseless measurements of an emitter without offsets along a walk."""
    tracker = TargetTracker(TrackerParams())
    for step, place in enumerate(places):
        seen = _seen(
            float(step),
            _range_m(place, target) if has_range else None,
            _bearing_rad(place, target) if has_bearing else None,
        )
        assert tracker.fuse(seen, place, float(step)).refusal is None
    return tracker


def test_before_the_first_measurement_there_is_no_estimate() -> None:
    tracker = TargetTracker(TrackerParams())
    assert tracker.estimate(0.0) is None
    assert len(tracker.hypotheses) == 0


def test_the_first_range_and_bearing_are_inverted() -> None:
    tracker = _walked([(10.0, 5.0, HEIGHT_M)], (40.0, 45.0), True, True)
    estimate = _estimate(tracker)
    assert estimate.position_enu_m == pytest.approx((40.0, 45.0))
    assert estimate.state is EstimateState.SEARCHING
    own2 = FilterParams().own_position_sigma_m ** 2
    assert estimate.covariance_m2[0][0] == pytest.approx(30.0**2 + own2)


def test_a_single_range_is_a_ring() -> None:
    tracker = _walked([(0.0, 0.0, HEIGHT_M)], (40.0, 0.0), True, False)
    places = np.array([h.state.mean[:2] for h in tracker.hypotheses])
    np.testing.assert_allclose(np.hypot(*places.T), 40.0)
    assert _estimate(tracker).state is EstimateState.SEARCHING


def test_a_single_bearing_is_a_ray() -> None:
    tracker = _walked([(0.0, 0.0, HEIGHT_M)], (30.0, 30.0), False, True)
    places = np.array([h.state.mean[:2] for h in tracker.hypotheses])
    np.testing.assert_allclose(places[:, 0], places[:, 1])
    assert np.hypot(*places.T).min() < 10.0
    assert np.hypot(*places.T).max() > 100.0


@pytest.mark.parametrize(
    ("target", "has_range", "has_bearing"),
    [
        (target, *has)
        for target in [(30.0, 40.0), (90.0, -30.0), (20.0, 15.0), (-20.0, 35.0)]
        for has in [(True, False), (False, True), (True, True)]
    ],
)
def test_a_noiseless_walk_with_a_turn_finds_the_target(
    target: Point, has_range: bool, has_bearing: bool
) -> None:
    estimate = _estimate(_walked(_corner(), target, has_range, has_bearing))
    assert math.dist(estimate.position_enu_m, target) <= 3.2
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m
    assert estimate.state in (EstimateState.LOCALISED, EstimateState.SEARCHING)


@pytest.mark.parametrize("target", [(30.0, 25.0), (45.0, -40.0)])
def test_a_straight_walk_with_ranges_only_leaves_a_mirror_image(target: Point) -> None:
    tracker = _walked(_line((0.0, 0.0), (80.0, 0.0), 80), target, True, False)
    estimate = _estimate(tracker)
    assert estimate.state is EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is not None
    found = sorted([estimate.position_enu_m, estimate.alternative_enu_m], key=lambda p: p[1])
    mirrored = sorted([target, (target[0], -target[1])], key=lambda p: p[1])
    for place, expected in zip(found, mirrored, strict=True):
        assert math.dist(place, expected) < 6.0
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m


def test_a_turn_ends_the_ambiguity() -> None:
    target = (30.0, 25.0)
    there, aside = _line((0.0, 0.0), (80.0, 0.0), 80), _line((80.0, 1.0), (80.0, 60.0), 60)
    estimate = _estimate(_walked(there + aside, target, True, False))
    assert estimate.state is not EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is None
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m


def _circling(tracker: TargetTracker, target: Point, steps: range, turned_rad: float = 0.0) -> int:
    """Noisy measurements on a circle about the target; returns how often the tracker restarted."""
    rng = np.random.default_rng(steps.start + 17)
    restarts = 0
    for step in steps:
        angle = 0.25 * step
        place = (target[0] + 25.0 * math.cos(angle), target[1] + 25.0 * math.sin(angle), HEIGHT_M)
        seen = _seen(
            float(step),
            _range_m(place, target) + float(rng.normal(0.0, 1.5)),
            _bearing_rad(place, target) + turned_rad + float(rng.normal(0.0, 0.03)),
        )
        restarts += tracker.fuse(seen, place, float(step)).restarted
    return restarts


@pytest.mark.parametrize("turned_rad", [math.pi, 2.5, -2.0])
def test_an_estimate_that_contradicts_its_measurements_starts_anew(turned_rad: float) -> None:
    """Bearings right behind scatter about the cut, to one side and the other."""
    tracker = TargetTracker(TrackerParams())
    assert _circling(tracker, (0.0, 0.0), range(120)) == 0
    assert _estimate(tracker).state is EstimateState.LOCALISED
    assert _circling(tracker, (0.0, 0.0), range(120, 140), turned_rad) == 0
    assert _circling(tracker, (0.0, 0.0), range(140, 120 + CONTRADICTION_COUNT), turned_rad) == 1
    assert tracker.restarts == 1
    assert _estimate(tracker).state is EstimateState.DIVERGED


def test_a_few_contradictions_are_forgiven() -> None:
    tracker = TargetTracker(TrackerParams())
    _circling(tracker, (0.0, 0.0), range(120))
    for start in range(120, 420, 30):
        assert _circling(tracker, (0.0, 0.0), range(start, start + 9), math.pi) == 0
        assert _circling(tracker, (0.0, 0.0), range(start + 9, start + 30)) == 0


def test_well_specified_noise_never_restarts_it() -> None:
    tracker = TargetTracker(TrackerParams())
    assert _circling(tracker, (10.0, -5.0), range(600)) == 0


def test_a_lost_covariance_restarts_it_and_says_so() -> None:
    """A radio that claims an impossible precision takes the rounding out of the covariance."""
    params = TrackerParams(filter=FilterParams(own_position_sigma_m=0.0, near_target_terms=False))
    tracker = TargetTracker(params)
    place = (0.0, 0.0, HEIGHT_M)
    restarted = False
    for step in range(20):
        seen = RangingMeasurement(
            emitter_id=1,
            measured_at_s=float(step),
            range_m=50.0,
            range_sigma_m=1e-30,
            bearing_enu_rad=0.3,
            bearing_sigma_rad=1e-30,
        )
        report = tracker.fuse(seen, place, float(step))
        restarted = restarted or report.restarted
        if report.restarted:
            assert report.update is None
            break
    assert restarted
    assert tracker.restarts == 1
    estimate = _estimate(tracker)
    assert estimate.state is EstimateState.DIVERGED
    assert all(math.isfinite(v) for row in estimate.covariance_m2 for v in row)
    for step in range(20, 20 + CONTRADICTION_COUNT):
        assert _estimate(tracker).state is EstimateState.DIVERGED
        seen = _seen(float(step), 50.0 + 0.1 * (step % 3), 0.3 + 0.01 * (step % 2))
        tracker.fuse(seen, (float(step), 0.0, HEIGHT_M), float(step))
    assert _estimate(tracker).state is not EstimateState.DIVERGED


def test_a_moved_frame_forgets_the_place_but_not_the_emitter() -> None:
    tracker = _walked(_corner(), (30.0, 40.0), True, True)
    tracker.restart()
    assert tracker.estimate(0.0) is None
    assert tracker.emitter_id == 1
    assert tracker.last_accepted_s is None
    tracker.fuse(_seen(500.0, 60.0, 0.0), (0.0, 0.0, 0.0), 500.0)
    assert _estimate(tracker).position_enu_m == pytest.approx((60.0, 0.0))


def test_without_adaptation_the_inflation_is_one() -> None:
    tracker = TargetTracker(TrackerParams(adapt_inflation=False))
    _circling(tracker, (0.0, 0.0), range(50))
    assert tracker.inflation == (1.0, 1.0, 1.0)


def test_reflections_are_counted() -> None:
    tracker = TargetTracker(TrackerParams())
    _circling(tracker, (0.0, 0.0), range(200))
    assert tracker.nlos_share < 0.2
    rng = np.random.default_rng(3)
    for step in range(200, 500):
        angle = 0.25 * step
        place = (25.0 * math.cos(angle), 25.0 * math.sin(angle), HEIGHT_M)
        range_m = _range_m(place, (0.0, 0.0)) + 8.0 + float(rng.normal(0.0, 0.5))
        tracker.fuse(_seen(float(step), range_m, _bearing_rad(place, (0, 0))), place, float(step))
    assert tracker.nlos_share > 0.3


CHECKED_STEPS = (20, 30, 40)
RUNS = 100
STEP_M = 5.0


def _coverage_of_run(seed: int, p_nlos: float) -> list[bool]:
    """One search from 30 to 60 m away; whether R95 holds the truth at each checked step.

    All is as the filter believes it, the error of the vehicle's own place included, but for
    reflections.
    """
    rng = np.random.default_rng(seed)
    tracker, planner = TargetTracker(TrackerParams(), 1), LatchedCrossing(LatchedCrossingParams())
    params = tracker.params.filter
    offset_m = rng.normal(0.0, params.range_offset_sigma_m)
    offset_rad = rng.normal(0.0, math.radians(params.bearing_offset_sigma_deg))
    bearing_sigma_rad = math.radians(params.bearing_sigma_deg)
    start_rad, start_m = rng.uniform(-math.pi, math.pi), rng.uniform(30.0, 60.0)
    place: PositionEnu = (start_m * math.cos(start_rad), start_m * math.sin(start_rad), HEIGHT_M)
    own_error_m = rng.normal(0.0, params.own_position_sigma_m, 2)
    memory: Latch | None = None
    covered = []
    for step in range(1, max(CHECKED_STEPS) + 1):
        is_nlos = rng.random() < p_nlos
        range_m = _range_m(place, (0.0, 0.0)) + offset_m + rng.normal(0.0, params.range_sigma_m)
        bearing_rad = _bearing_rad(place, (0.0, 0.0)) + offset_rad
        bearing_rad += rng.normal(0.0, bearing_sigma_rad)
        if is_nlos:
            range_m += rng.exponential(8.0)
            bearing_rad += rng.normal(0.0, math.radians(5.0))
        believed = (place[0] + own_error_m[0], place[1] + own_error_m[1], HEIGHT_M)
        tracker.fuse(_seen(float(step), max(range_m, 0.1), bearing_rad), believed, float(step))
        estimate = _estimate(tracker)
        if step in CHECKED_STEPS:
            covered.append(math.hypot(*estimate.position_enu_m) <= estimate.r95_m)
        plan = planner.plan(PlanRequest(place[:2], estimate), memory)
        memory = plan.memory
        aim = plan.waypoint.position_enu_m
        share = min(1.0, STEP_M / math.dist(place[:2], aim))
        east, north = (place[i] + share * (aim[i] - place[i]) for i in range(2))
        place = (east, north, HEIGHT_M)
    return covered


@pytest.mark.parametrize("p_nlos", [0.0, 0.9])
def test_r95_holds_the_truth_as_often_as_it_says(p_nlos: float) -> None:
    covered = np.array([_coverage_of_run(seed, p_nlos) for seed in range(RUNS)])
    shares = covered.mean(axis=0)
    assert (shares >= 0.93).all(), shares
    assert (shares <= 0.995).all(), shares


def test_ranges_alone_need_a_base_line_as_long_as_the_height() -> None:
    ranges = _walked(_corner()[:30], (30.0, 40.0), True, False)
    assert ranges.baseline_m(25.0) == 25.0
    both = _walked(_corner()[:30], (30.0, 40.0), True, True)
    assert both.baseline_m(25.0) == 0.0


# -- Duplicates and delays -----------------------------------------------------------------------


def _snapshot(tracker: TargetTracker) -> list[object]:
    """The hypotheses bit by bit."""
    return [
        (h.log_weight, h.state.mean.tobytes(), h.state.covariance.tobytes())
        for h in tracker.hypotheses
    ]


@pytest.mark.parametrize("has_stamp", [True, False])
def test_a_duplicate_changes_nothing_however_often_it_comes(has_stamp: bool) -> None:
    once, often = TargetTracker(TrackerParams()), TargetTracker(TrackerParams())
    rng = np.random.default_rng(1)
    for step, place in enumerate(_corner()[:60]):
        seen = replace(
            _seen(float(step), _range_m(place, (30.0, 40.0)) + float(rng.normal())),
            stamp_us=10_000 + step if has_stamp else None,
        )
        once.fuse(seen, place, float(step))
        assert often.fuse(seen, place, float(step)).refusal is None
        for again_s in (0.0, 0.2, 0.9):
            copy = replace(seen, measured_at_s=seen.measured_at_s + 0.01) if has_stamp else seen
            report = often.fuse(copy, place, float(step) + again_s)
            assert report.refusal is Refusal.DUPLICATE
            assert report.update is None
    assert _snapshot(often) == _snapshot(once)
    assert often.accepted == once.accepted == 60
    assert often.refusals[Refusal.DUPLICATE] == 180


def test_the_same_reading_at_another_time_is_no_duplicate() -> None:
    tracker = TargetTracker(TrackerParams())
    for step in range(5):
        assert tracker.fuse(_seen(0.1 * step, 40.0), (0.0, 0.0, HEIGHT_M), 1.0).refusal is None


def _delayed(delays_s: list[float], params: TrackerParams) -> TargetTracker:
    """Noisy measurements along a walk, fused as they arrive, each where it was taken."""
    rng, tracker, target = np.random.default_rng(2), TargetTracker(params), (30.0, 40.0)
    arrivals = []
    for step, place in enumerate(_corner()):
        seen = _seen(
            0.1 * step,
            _range_m(place, target) + float(rng.normal(0.0, 1.5)),
            _bearing_rad(place, target) + float(rng.normal(0.0, 0.03)),
        )
        delay_s = delays_s[step % len(delays_s)]
        arrivals.append((seen.measured_at_s + delay_s, step, seen, place))
    for now_s, _, seen, place in sorted(arrivals):
        assert tracker.fuse(seen, place, now_s).refusal is None
    return tracker


def test_a_steady_delay_changes_nothing() -> None:
    assert _snapshot(_delayed([0.9], TrackerParams())) == _snapshot(
        _delayed([0.0], TrackerParams())
    )


@pytest.mark.parametrize("q", [0.0, 0.05])
def test_measurements_out_of_their_turn_are_fused_where_they_were_taken(q: float) -> None:
    """Fused where the vehicle is by then, two to ten metres on, they would point elsewhere."""
    params = TrackerParams(filter=FilterParams(process_noise_m_per_sqrt_s=q))
    in_turn, jumbled = _delayed([0.0], params), _delayed([0.95, 0.0, 0.4, 0.7, 0.05], params)
    one, other = _estimate(in_turn), _estimate(jumbled)
    assert math.dist(other.position_enu_m, (30.0, 40.0)) <= other.r95_m
    assert math.dist(one.position_enu_m, other.position_enu_m) < 0.25 * one.r95_m
    assert other.r95_m == pytest.approx(one.r95_m, rel=0.1)
    assert jumbled.accepted == 120


def test_what_is_older_than_a_second_is_refused() -> None:
    tracker = _walked(_corner(), (30.0, 40.0), True, True)
    before = _snapshot(tracker)
    stale = _seen(500.0, _range_m((0.0, 0.0, HEIGHT_M), (30.0, 40.0)))
    assert tracker.fuse(stale, (0.0, 0.0, HEIGHT_M), 501.01).refusal is Refusal.STALE
    assert _snapshot(tracker) == before
    assert tracker.fuse(stale, (0.0, 0.0, HEIGHT_M), 500.99).refusal is None


# -- What is tracked -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_filter_can_be_chosen_and_finds_the_target(kind: FilterKind) -> None:
    tracker = TargetTracker(TrackerParams(kind=kind))
    assert _circling(tracker, (10.0, -5.0), range(150)) == 0
    estimate = _estimate(tracker)
    assert estimate.state is EstimateState.LOCALISED
    assert math.dist(estimate.position_enu_m, (10.0, -5.0)) <= estimate.r95_m
    assert isinstance(filter_of(kind, FilterParams()), KINDS[kind])


def test_the_filters_are_not_all_the_same() -> None:
    params = WindowParams(enabled=False)
    found = set()
    for kind in KINDS:
        tracker = TargetTracker(TrackerParams(kind=kind, window=params))
        rng = np.random.default_rng(4)
        for step, place in enumerate(_corner()):
            longer_m = float(rng.exponential(8.0))
            seen = _seen(
                float(step), _range_m(place, (30.0, 40.0)) + longer_m, _bearing_rad(place, (30, 40))
            )
            tracker.fuse(seen, place, float(step))
        found.add(_snapshot(tracker)[0])
    assert len(found) == len(KINDS)


def _in_space(params: FilterParams, up_m: float, scale: float) -> TargetEstimate:
    """A climbing walk past a target of unknown height with a radio of wrong scale."""
    tracker, rng = TargetTracker(TrackerParams(filter=params)), np.random.default_rng(3)
    target, restarts = (30.0, 40.0, up_m), 0
    for step, (east, north, _) in enumerate(_corner() + _corner()[::-1]):
        place = (east, north, 15.0 + 0.1 * step)
        slant_m = math.dist(place, target)
        up_rad = math.asin((up_m - place[2]) / slant_m) + float(rng.normal(0.0, 0.05))
        seen = replace(
            _seen(
                float(step),
                (1.0 + scale) * slant_m + float(rng.normal(0.0, 1.0)),
                _bearing_rad(place, target[:2]) + float(rng.normal(0.0, 0.03)),
            ),
            range_sigma_m=1.0,
            elevation_rad=up_rad,
            elevation_sigma_rad=0.05,
        )
        restarts += tracker.fuse(seen, place, float(step)).restarted
    assert restarts == 0
    return _estimate(tracker)


def test_height_and_scale_are_estimated_and_reported() -> None:
    params = FilterParams(range_scale_sigma=0.05, target_height_sigma_m=10.0, range_k_long=None)
    estimate = _in_space(params, 6.0, 0.07)
    assert estimate.height_sigma_m is not None
    assert estimate.height_sigma_m < 2.0
    assert estimate.height_m == pytest.approx(6.0, abs=3.0 * estimate.height_sigma_m)
    assert estimate.range_scale == pytest.approx(0.07, abs=0.02)
    assert math.dist(estimate.position_enu_m, (30.0, 40.0)) <= estimate.r95_m


def test_where_they_are_known_they_are_reported_as_known() -> None:
    estimate = _in_space(FilterParams(target_height_m=6.0), 6.0, 0.0)
    assert (estimate.height_m, estimate.height_sigma_m, estimate.range_scale) == (6.0, None, 0.0)
    assert math.dist(estimate.position_enu_m, (30.0, 40.0)) <= estimate.r95_m


def test_the_base_line_is_as_long_as_the_height_above_the_target() -> None:
    params = TrackerParams(filter=FilterParams(target_height_m=6.0))
    tracker = TargetTracker(params)
    tracker.fuse(_seen(0.0, 50.0), (0.0, 0.0, HEIGHT_M), 0.0)
    assert tracker.baseline_m(25.0) == 19.0


def test_what_the_track_can_tell_is_a_live_value() -> None:
    tracker = TargetTracker(TrackerParams())
    assert tracker.observability is None
    target = (30.0, 25.0)
    line = _line((0.0, 0.0), (80.0, 0.0), 60)
    for step, place in enumerate(line):
        tracker.fuse(_seen(float(step), _range_m(place, target)), place, float(step))
    straight = tracker.observability
    assert straight is not None
    assert straight.is_collinear
    assert straight.bilateral_share > 0.9
    for step, place in enumerate(_line((80.0, 1.0), (80.0, 60.0), 60)):
        tracker.fuse(_seen(60.0 + step, _range_m(place, target)), place, 60.0 + step)
    turned = tracker.observability
    assert turned is not None
    assert not turned.is_collinear
    assert turned.min_eigenvalue > straight.min_eigenvalue


# -- Starting anew -------------------------------------------------------------------------------


def _far_away(tracker: TargetTracker, places: Iterable[PositionEnu], emitter: Point) -> int:
    """Noisy measurements of another place than the one believed; how often it restarted."""
    rng, restarts = np.random.default_rng(9), 0
    for step, place in enumerate(places):
        seen = _seen(
            1000.0 + step,
            _range_m(place, emitter) + float(rng.normal(0.0, 1.5)),
            _bearing_rad(place, emitter) + float(rng.normal(0.0, 0.03)),
        )
        restarts += tracker.fuse(seen, place, 1000.0 + step).restarted
    return restarts


@pytest.mark.parametrize("has_window", [True, False])
def test_an_emitter_that_was_carried_away_is_found_where_it_is_now(has_window: bool) -> None:
    """The window forgets what it saw before the contradictions began."""
    tracker = TargetTracker(TrackerParams(window=WindowParams(enabled=has_window)))
    _circling(tracker, (0.0, 0.0), range(300))
    assert math.dist(_estimate(tracker).position_enu_m, (0.0, 0.0)) < 1.0
    emitter = (120.0, 140.0)
    out, back = (-60.0, -60.0), (-60.0, 60.0)
    assert _far_away(tracker, _line(out, back, 60), emitter) == 1
    square = _line(back, (60.0, 60.0), 100) + _line((60.0, 60.0), (60.0, -60.0), 100)
    _far_away(tracker, square + _line((60.0, -60.0), out, 100), emitter)
    estimate = _estimate(tracker)
    assert math.dist(estimate.position_enu_m, emitter) <= estimate.r95_m


def test_what_it_cannot_explain_from_any_side_is_given_up_too() -> None:
    """Seen from all around in turn, no side is contradicted often enough in a row."""
    tracker = TargetTracker(TrackerParams())
    _circling(tracker, (0.0, 0.0), range(300))
    assert tracker.health.nis is not None
    assert tracker.health.nis < 1.2
    assert not tracker.health.is_overconfident
    turns = 0.25 * np.arange(60)
    circle = [(25.0 * math.cos(a), 25.0 * math.sin(a), HEIGHT_M) for a in turns]
    assert _far_away(tracker, circle, (120.0, -60.0)) == 1


def test_ranges_that_no_place_and_no_offset_explains_in_metres_are_not_used() -> None:
    """Shorter than the vehicle is high, and the offset is bounded."""
    bounded = FilterParams(range_offset_min_m=-1.0, range_offset_max_m=1.0, range_k_short=1.0)
    tracker = TargetTracker(TrackerParams(filter=bounded, window=WindowParams(enabled=False)))
    _circling(tracker, (0.0, 0.0), range(120))
    for step in range(120, 240):
        angle = 0.25 * step
        place = (25.0 * math.cos(angle), 25.0 * math.sin(angle), HEIGHT_M)
        short = _seen(float(step), 8.0 + 0.1 * (step % 7))
        tracker.fuse(short, place, float(step))
    assert tracker.objection(240.0) is Objection.RANGE_UNIT
    assert tracker.refusals[Refusal.WRONG_UNIT] > 100
