"""The tracker: first hypotheses, ambiguity, divergence, and an R95 that keeps its word."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import (
    EstimateState,
    PositionAccuracy,
    PositionEnu,
    RangingMeasurement,
    TargetEstimate,
)
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.kalman import KINDS, FilterKind, filter_of
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.integrity import CONTRADICTION_COUNT
from companion.estimation.target_estimate import KeptEstimate
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from companion.geometry.polygons import Point
from companion.planning.crossing import LatchedCrossing, LatchedCrossingParams
from companion.planning.planner import PlanRequest
from companion.planning.views import Latch
from tests.unit.companion.estimation.tracker_helpers import (
    HEIGHT_M,
    bearing_to,
    corner_walk,
    estimate_of,
    fly_around,
    known_by,
    leg,
    measured,
    range_to,
    walk_about,
)


def test_before_the_first_measurement_there_is_no_estimate() -> None:
    tracker = TargetTracker(TrackerParams())
    assert tracker.estimate(0.0) is None
    assert len(tracker.hypotheses) == 0


def test_the_first_range_and_bearing_are_inverted() -> None:
    tracker = walk_about([(10.0, 5.0, HEIGHT_M)], (40.0, 45.0), True, True)
    estimate = estimate_of(tracker)
    assert estimate.position_enu_m == pytest.approx((40.0, 45.0))
    assert estimate.state is EstimateState.SEARCHING
    own2 = FilterParams().own_position_sigma_m ** 2
    assert estimate.covariance_m2[0][0] == pytest.approx(30.0**2 + own2)


def test_a_single_range_is_a_ring() -> None:
    tracker = walk_about([(0.0, 0.0, HEIGHT_M)], (40.0, 0.0), True, False)
    positions = np.array([h.state.mean[:2] for h in tracker.hypotheses])
    np.testing.assert_allclose(np.hypot(*positions.T), 40.0)
    assert estimate_of(tracker).state is EstimateState.SEARCHING


def test_a_single_bearing_is_a_ray() -> None:
    tracker = walk_about([(0.0, 0.0, HEIGHT_M)], (30.0, 30.0), False, True)
    positions = np.array([h.state.mean[:2] for h in tracker.hypotheses])
    np.testing.assert_allclose(positions[:, 0], positions[:, 1])
    assert np.hypot(*positions.T).min() < 10.0
    assert np.hypot(*positions.T).max() > 100.0


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
    estimate = estimate_of(walk_about(corner_walk(), target, has_range, has_bearing))
    assert math.dist(estimate.position_enu_m, target) <= 3.2
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m
    assert estimate.state in (EstimateState.LOCALISED, EstimateState.SEARCHING)


@pytest.mark.parametrize("target", [(30.0, 25.0), (45.0, -40.0)])
def test_a_straight_walk_with_ranges_only_leaves_a_mirror_image(target: Point) -> None:
    tracker = walk_about(leg((0.0, 0.0), (80.0, 0.0), 80), target, True, False)
    estimate = estimate_of(tracker)
    assert estimate.state is EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is not None
    found = sorted([estimate.position_enu_m, estimate.alternative_enu_m], key=lambda p: p[1])
    mirrored = sorted([target, (target[0], -target[1])], key=lambda p: p[1])
    for position, expected in zip(found, mirrored, strict=True):
        assert math.dist(position, expected) < 6.0
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m


def test_a_turn_ends_the_ambiguity() -> None:
    target = (30.0, 25.0)
    there, aside = (
        leg((0.0, 0.0), (80.0, 0.0), 80),
        leg((80.0, 1.0), (80.0, 60.0), 60),
    )
    estimate = estimate_of(walk_about(there + aside, target, True, False))
    assert estimate.state is not EstimateState.AMBIGUOUS
    assert estimate.alternative_enu_m is None
    assert math.dist(estimate.position_enu_m, target) <= estimate.r95_m


@pytest.mark.parametrize("turned_rad", [math.pi, 2.5, -2.0])
def test_an_estimate_that_contradicts_its_measurements_starts_again(turned_rad: float) -> None:
    """Bearings right behind scatter about the cut, to one side and the other."""
    tracker = TargetTracker(TrackerParams())
    assert fly_around(tracker, (0.0, 0.0), range(120)) == 0
    assert estimate_of(tracker).state is EstimateState.LOCALISED
    assert fly_around(tracker, (0.0, 0.0), range(120, 140), turned_rad) == 0
    assert fly_around(tracker, (0.0, 0.0), range(140, 120 + CONTRADICTION_COUNT), turned_rad) == 1
    assert tracker.integrity.restarts == 1
    assert estimate_of(tracker).state is EstimateState.DIVERGED


@pytest.mark.slow
def test_a_few_contradictions_are_forgiven() -> None:
    tracker = TargetTracker(TrackerParams())
    fly_around(tracker, (0.0, 0.0), range(120))
    for start in range(120, 420, 30):
        assert fly_around(tracker, (0.0, 0.0), range(start, start + 9), math.pi) == 0
        assert fly_around(tracker, (0.0, 0.0), range(start + 9, start + 30)) == 0


@pytest.mark.slow
def test_well_specified_noise_never_restarts_it() -> None:
    tracker = TargetTracker(TrackerParams())
    assert fly_around(tracker, (10.0, -5.0), range(600)) == 0


def test_a_lost_covariance_restarts_it_and_says_so() -> None:
    """A radio configured as impossibly precise takes the rounding out of the covariance."""
    azimuth = AntennaParams(kind="azimuth")
    believed = FilterParams(own_position_sigma_m=0.0, near_target_terms=False, antenna=azimuth)
    tracker = TargetTracker(TrackerParams(filter=believed))
    position = (0.0, 0.0, HEIGHT_M)
    restarted = False
    for step in range(20):
        seen = RangingMeasurement(
            emitter_id=1,
            measured_at_s=float(step),
            range_m=50.0,
            range_sigma_m=1e-30,
            bearing_enu_rad=0.3,
            bearing_sigma_rad=1e-30,
            least_sigmas=(1e-30, 1e-30, None),
        )
        report = tracker.fuse(seen, position, float(step))
        restarted = restarted or report.restarted
        if report.restarted:
            assert report.update is None
            break
    assert restarted
    assert tracker.integrity.restarts == 1
    estimate = estimate_of(tracker)
    assert estimate.state is EstimateState.DIVERGED
    assert all(math.isfinite(v) for row in estimate.covariance_m2 for v in row)
    for step in range(20, 20 + CONTRADICTION_COUNT):
        assert estimate_of(tracker).state is EstimateState.DIVERGED
        seen = measured(float(step), 50.0 + 0.1 * (step % 3), 0.3 + 0.01 * (step % 2))
        tracker.fuse(seen, (float(step), 0.0, HEIGHT_M), float(step))
    assert estimate_of(tracker).state is not EstimateState.DIVERGED


def test_a_moved_frame_forgets_the_place_but_not_the_emitter() -> None:
    tracker = walk_about(corner_walk(), (30.0, 40.0), True, True)
    tracker.restart()
    assert tracker.estimate(0.0) is None
    assert tracker.emitter_id == 1
    assert tracker.last_accepted_s is None
    tracker.fuse(measured(500.0, 60.0, 0.0), (0.0, 0.0, 0.0), 500.0)
    assert estimate_of(tracker).position_enu_m == pytest.approx((60.0, 0.0))


def test_without_adaptation_the_inflation_is_one() -> None:
    tracker = TargetTracker(TrackerParams(adapt_inflation=False))
    fly_around(tracker, (0.0, 0.0), range(50))
    assert set(tracker.health.inflation) == {1.0}


def test_reflections_are_counted() -> None:
    tracker = TargetTracker(TrackerParams())
    fly_around(tracker, (0.0, 0.0), range(200))
    assert tracker.health.nlos_share < 0.2
    rng = np.random.default_rng(3)
    for step in range(200, 500):
        angle = 0.25 * step
        position = (25.0 * math.cos(angle), 25.0 * math.sin(angle), HEIGHT_M)
        range_m = range_to(position, (0.0, 0.0)) + 8.0 + float(rng.normal(0.0, 0.5))
        tracker.fuse(
            measured(float(step), range_m, bearing_to(position, (0, 0))), position, float(step)
        )
    assert tracker.health.nlos_share > 0.3


CHECKED_STEPS = (20, 30, 40)
RUNS = 100
STEP_M = 5.0


def _coverage_of_run(seed: int, p_nlos: float, kind: AntennaKind) -> list[bool]:
    """One search from 30 to 60 m away; whether R95 holds the truth at each checked step.

    All is as the filter believes it, the error of the vehicle's own position included, but for
    reflections.
    """
    rng = np.random.default_rng(seed)
    configured = TrackerParams(filter=FilterParams(antenna=AntennaParams(kind=kind)))
    tracker, planner = TargetTracker(configured, 1), LatchedCrossing(LatchedCrossingParams())
    params = tracker.params.filter
    offset_m = rng.normal(0.0, params.range_offset_sigma_m)
    offset_rad = rng.normal(0.0, math.radians(params.bearing_offset_sigma_deg))
    bearing_sigma_rad = math.radians(params.bearing_sigma_deg)
    start_rad, start_m = rng.uniform(-math.pi, math.pi), rng.uniform(30.0, 60.0)
    position: PositionEnu = (start_m * math.cos(start_rad), start_m * math.sin(start_rad), HEIGHT_M)
    own_error_m = rng.normal(0.0, params.own_position_sigma_m, 2)
    memory: Latch | None = None
    covered = []
    for step in range(1, max(CHECKED_STEPS) + 1):
        is_nlos = rng.random() < p_nlos
        range_m = range_to(position, (0.0, 0.0)) + offset_m + rng.normal(0.0, params.range_sigma_m)
        bearing_rad = bearing_to(position, (0.0, 0.0)) + offset_rad
        bearing_rad += rng.normal(0.0, bearing_sigma_rad)
        if is_nlos:
            range_m += rng.exponential(8.0)
            bearing_rad += rng.normal(0.0, math.radians(5.0))
        believed = (position[0] + own_error_m[0], position[1] + own_error_m[1], HEIGHT_M)
        tracker.fuse(measured(float(step), max(range_m, 0.1), bearing_rad), believed, float(step))
        estimate = estimate_of(tracker)
        if step in CHECKED_STEPS:
            covered.append(math.hypot(*estimate.position_enu_m) <= estimate.r95_m)
        plan = planner.plan(PlanRequest(position[:2], estimate), memory)
        memory = plan.memory
        aim = plan.waypoint.position_enu_m
        share = min(1.0, STEP_M / math.dist(position[:2], aim))
        east, north = (position[i] + share * (aim[i] - position[i]) for i in range(2))
        position = (east, north, HEIGHT_M)
    return covered


@pytest.mark.slow
@pytest.mark.parametrize("p_nlos", [0.0, 0.9])
def test_r95_holds_the_truth_as_often_as_it_says(p_nlos: float) -> None:
    covered = np.array([_coverage_of_run(seed, p_nlos, "azimuth") for seed in range(RUNS)])
    shares = covered.mean(axis=0)
    assert (shares >= 0.93).all(), shares
    assert (shares <= 0.995).all(), shares


@pytest.mark.slow
def test_r95_of_an_antenna_that_is_not_configured_promises_no_more() -> None:
    covered = np.array([_coverage_of_run(seed, 0.9, "auto") for seed in range(RUNS)])
    assert (covered.mean(axis=0) >= 0.93).all()


def test_ranges_alone_need_a_base_line_as_long_as_the_height() -> None:
    ranges = walk_about(corner_walk()[:30], (30.0, 40.0), True, False)
    assert ranges.baseline_m(25.0) == 25.0
    both = walk_about(corner_walk()[:30], (30.0, 40.0), True, True)
    assert both.baseline_m(25.0) == 0.0


# -- Duplicates and delays -----------------------------------------------------------------------


def test_the_estimate_is_always_that_of_now_however_often_it_was_asked_for() -> None:
    tracker, accuracy = TargetTracker(TrackerParams()), PositionAccuracy(1.0, 2.0)

    def check() -> None:
        kept = tracker.estimate(9.0)
        tracker._kept_estimate = KeptEstimate()
        assert tracker.estimate(9.0) == kept

    for step, position in enumerate(corner_walk()[:90]):
        is_ranging = step % 7 != 3
        seen = measured(float(step), 40.0 if is_ranging else 900.0, None)
        tracker.fuse(seen, position, float(step), accuracy if step > 30 else None)
        check()
        if step == 40:
            tracker.move((3.0, -2.0, 1.5), 0.1, 0.5)
        check()
    belief = tracker.belief
    assert belief is not None
    tracker.restart()
    check()
    assert tracker.resume(belief, 5.0, 95.0) is None
    check()


# -- What is tracked -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_filter_can_be_chosen_and_finds_the_target(kind: FilterKind) -> None:
    tracker = TargetTracker(TrackerParams(kind=kind))
    assert fly_around(tracker, (10.0, -5.0), range(150)) == 0
    estimate = estimate_of(tracker)
    assert estimate.state is EstimateState.LOCALISED
    assert math.dist(estimate.position_enu_m, (10.0, -5.0)) <= estimate.r95_m
    assert type(filter_of(kind, FilterParams())) is KINDS[kind]


def test_the_filters_are_not_all_the_same() -> None:
    params = WindowParams(enabled=False)
    found = set()
    for kind in KINDS:
        tracker = TargetTracker(TrackerParams(kind=kind, window=params))
        rng = np.random.default_rng(4)
        for step, position in enumerate(corner_walk()):
            longer_m = float(rng.exponential(8.0))
            seen = measured(
                float(step),
                range_to(position, (30.0, 40.0)) + longer_m,
                bearing_to(position, (30, 40)),
            )
            tracker.fuse(seen, position, float(step))
        found.add(known_by(tracker)[0])
    assert len(found) == len(KINDS)


def _in_space(params: FilterParams, up_m: float, scale: float) -> TargetEstimate:
    """A climbing walk past a target of unknown height with a radio of wrong scale."""
    tracker, rng = TargetTracker(TrackerParams(filter=params)), np.random.default_rng(3)
    target, restarts = (30.0, 40.0, up_m), 0
    for step, (east, north, _) in enumerate(corner_walk() + corner_walk()[::-1]):
        position = (east, north, 15.0 + 0.1 * step)
        slant_m = math.dist(position, target)
        up_rad = math.asin((up_m - position[2]) / slant_m) + float(rng.normal(0.0, 0.05))
        seen = replace(
            measured(
                float(step),
                (1.0 + scale) * slant_m + float(rng.normal(0.0, 1.0)),
                bearing_to(position, target[:2]) + float(rng.normal(0.0, 0.03)),
            ),
            range_sigma_m=1.0,
            elevation_rad=up_rad,
            elevation_sigma_rad=0.05,
        )
        restarts += tracker.fuse(seen, position, float(step)).restarted
    assert restarts == 0
    return estimate_of(tracker)


def test_height_and_scale_are_estimated_and_reported() -> None:
    params = FilterParams(
        range_sigma_m=1.0,
        elevation_sigma_deg=2.0,
        range_scale_sigma=0.05,
        target_height_sigma_m=10.0,
        range_k_long=None,
    )
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
    tracker.fuse(measured(0.0, 50.0), (0.0, 0.0, HEIGHT_M), 0.0)
    assert tracker.baseline_m(25.0) == 19.0


def test_planners_are_reported_the_noise_of_what_is_measured() -> None:
    params = FilterParams(range_sigma_m=1.2, own_position_sigma_m=0.5, bearing_sigma_deg=3.0)
    tracker = TargetTracker(TrackerParams(filter=params, adapt_inflation=False))
    assert tracker.latest_sigmas is None
    tracker.fuse(measured(0.0, None, 0.3), (0.0, 0.0, HEIGHT_M), 0.0)
    assert tracker.latest_sigmas == (math.inf, pytest.approx(math.radians(3.0)), math.inf)
    tracker.fuse(measured(1.0, 40.0, None), (1.0, 0.0, HEIGHT_M), 1.0)
    assert tracker.latest_sigmas == (
        pytest.approx(1.3),
        pytest.approx(math.radians(3.0)),
        math.inf,
    )


def test_what_the_track_can_tell_is_a_live_value() -> None:
    tracker = TargetTracker(TrackerParams())
    assert tracker.health.observability is None
    target = (30.0, 25.0)
    line = leg((0.0, 0.0), (80.0, 0.0), 60)
    for step, position in enumerate(line):
        tracker.fuse(measured(float(step), range_to(position, target)), position, float(step))
    straight = tracker.health.observability
    assert straight is not None
    assert straight.is_collinear
    assert straight.bilateral_share > 0.9
    for step, position in enumerate(leg((80.0, 1.0), (80.0, 60.0), 60)):
        tracker.fuse(measured(60.0 + step, range_to(position, target)), position, 60.0 + step)
    turned = tracker.health.observability
    assert turned is not None
    assert not turned.is_collinear
    assert turned.min_eigenvalue > straight.min_eigenvalue


def test_a_straight_flight_towards_the_target_has_no_curvature_across_it() -> None:
    """Its normal equations are singular but for rounding, of which no accuracy is made."""
    tracker = TargetTracker(TrackerParams())
    for step in range(30):
        x_m, t_s = 0.25 * step, 0.5 * step
        tracker.fuse(measured(t_s, x_m + 17.0), (x_m, 2.64, 0.0), t_s)
    estimate = tracker.estimate(14.5)
    assert estimate is None or estimate.state is not EstimateState.LOCALISED
