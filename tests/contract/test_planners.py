"""Promises of every planner, whatever its memory."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.config.schema import CompanionConfig, CrossingKind, PatternKind, PlannerConfig
from companion.domain import EstimateState, TargetEstimate, Waypoint, WaypointReason
from companion.flight_setup import build_planner
from companion.geometry.obstacles import FreeSpace, between
from companion.geometry.polygons import Point, deepest_point, depth_m
from companion.kernel import frozen
from companion.planning.crossing import (
    LatchedCrossing,
    LatchedCrossingParams,
    SensorGeometry,
)
from companion.planning.fim import FimParams, FimPlanner
from companion.planning.planner import NO_ROOM, SLACK_M, START_TOLERANCE_M, Planner, PlanRequest
from companion.planning.search import (
    ExpandingSquareParams,
    LawnmowerParams,
    SearchPlanner,
    SearchThenCross,
    SectorParams,
)
from companion.planning.search_probability import ProbabilityPlanner
from companion.planning.views import Antenna
from companion.search.detection_model import DetectionModel
from companion.search.outlook import LegTable
from tools.study.case import Case
from tools.study.reactive_crossing import ReactiveCrossing

HOOK = ((-40.0, -40.0), (40.0, -40.0), (40.0, 0.0), (0.0, 0.0), (0.0, 40.0), (-40.0, 40.0))

DOWN = Antenna((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), 2, False, math.pi / 3.0)
SIGHT = SensorGeometry(DOWN, 5.0, 2.5, lowest_m=6.0, room_m=14.0, is_height_configured=True)


def as_configured(kinds: object) -> dict[str, Planner[Any]]:
    """Every planner of those that the configuration knows, with its defaults."""
    configs = {kind: PlannerConfig(kind=kind) for kind in get_args(kinds)}
    return {kind: build_planner(CompanionConfig(planner=each)) for kind, each in configs.items()}


CROSSING: dict[str, Planner[Any]] = as_configured(CrossingKind) | {
    "reactive": ReactiveCrossing(Case()),
    "reactive, parking": ReactiveCrossing(Case(stop_distance_m=500.0)),
    "latched, without a sensor": LatchedCrossing(LatchedCrossingParams()),
    "latched, tight": LatchedCrossing(LatchedCrossingParams(overshoot_max_m=2.0)),
    "latched, swinging": LatchedCrossing(LatchedCrossingParams(altitude_swing_m=5.0)),
    "latched, by the antenna": LatchedCrossing(LatchedCrossingParams(descend=True), SIGHT),
    "fim, by the antenna": FimPlanner(FimParams(), antenna=DOWN),
    "fim, printed": FimPlanner(FimParams(near_target_terms=False), 0.5, 0.01),
}
SEARCHING: dict[str, Planner[Any]] = {
    kind: build_planner(CompanionConfig(planner=PlannerConfig(kind="survey", search=kind)))
    for kind in get_args(PatternKind)
} | {
    "probability, without a map": ProbabilityPlanner(
        LawnmowerParams(), LegTable(DetectionModel(reach_m=40.0), 20.0, 5.0)
    ),
    "lawnmower, hook": SearchPlanner(
        LawnmowerParams(area_enu_m=HOOK, lane_heading_deg=30.0, start_corner="north_east")
    ),
    "expanding square, close": SearchPlanner(ExpandingSquareParams(spacing_m=15.0)),
    "sector, elsewhere": SearchPlanner(SectorParams(datum_enu_m=(10.0, -20.0))),
}
BOTH: dict[str, Planner[Any]] = {
    "lawnmower, then latched": SearchThenCross(
        SearchPlanner(LawnmowerParams()), LatchedCrossing(LatchedCrossingParams()), 5.0
    ),
    "square, then reactive": SearchThenCross(
        SearchPlanner(ExpandingSquareParams()),
        ReactiveCrossing(Case()),
        5.0,
    ),
}
PLANNERS = CROSSING | SEARCHING | BOTH

ROUNDING_M = 1e-9

positions = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))


@pytest.fixture(params=PLANNERS)
def planner(request: pytest.FixtureRequest) -> Planner[Any]:
    return PLANNERS[request.param]


@pytest.fixture(params=CROSSING)
def crossing(request: pytest.FixtureRequest) -> Planner[Any]:
    return CROSSING[request.param]


def an_estimate(
    position_enu_m: Point,
    sigma_m: float = 3.0,
    correlation: float = 0.0,
    state: EstimateState = EstimateState.SEARCHING,
) -> TargetEstimate:
    variance, covariance = sigma_m**2, correlation * sigma_m**2
    return TargetEstimate(
        time_s=0.0,
        state=state,
        position_enu_m=position_enu_m,
        covariance_m2=((variance, covariance), (covariance, variance)),
        r95_m=2.45 * sigma_m,
        range_offset_m=0.0,
        bearing_offset_rad=0.0,
        measurements=1,
    )


estimates = st.builds(
    an_estimate,
    positions,
    st.floats(0.0, 100.0),
    st.floats(-0.99, 0.99),
    st.sampled_from(EstimateState),
)


@st.composite
def stars(draw: st.DrawFn, least_m: float, most_m: float) -> tuple[Point, ...]:
    """A star-shaped polygon, convex or not, in either direction."""
    centre = draw(st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)))
    radii = draw(st.lists(st.floats(least_m, most_m), min_size=3, max_size=8))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    polygon = tuple(
        (
            centre[0] + radius * math.cos(first + 2.0 * math.pi * i / len(radii)),
            centre[1] + radius * math.sin(first + 2.0 * math.pi * i / len(radii)),
        )
        for i, radius in enumerate(radii)
    )
    return polygon if draw(st.booleans()) else polygon[::-1]


@dataclass(frozen=True)
class Ground:
    """Fence, keep-outs and other limits of a flight."""

    fence: tuple[Point, ...]
    margin_m: float
    keep_out: tuple[tuple[Point, ...], ...]

    @property
    def space(self) -> FreeSpace:
        return FreeSpace(self.fence, self.keep_out, self.margin_m - ROUNDING_M)

    def request(
        self, vehicle: Point, estimate: TargetEstimate | None, time_s: float = 0.0
    ) -> PlanRequest:
        return PlanRequest(
            vehicle,
            estimate,
            self.fence,
            self.margin_m,
            keep_out_enu_m=self.keep_out,
            time_s=time_s,
            contact_s=None if estimate is None else 0.0,
            height_m=20.0,
            altitude_offset_m=0.0,
            yaw_enu_rad=0.3,
            sigmas=(0.5, 0.05, math.inf),
        )


@st.composite
def grounds(draw: st.DrawFn) -> Ground:
    """A fence with a margin that leaves something of it, and up to three keep-outs."""
    fence = draw(stars(20.0, 200.0))
    margin_m = draw(st.floats(0.0, 0.95)) * depth_m(fence, deepest_point(fence))
    return Ground(fence, margin_m, tuple(draw(st.lists(stars(3.0, 40.0), max_size=3))))


flights = st.lists(
    st.tuples(positions, st.none() | estimates, st.floats(0.0, 20.0)), min_size=1, max_size=6
)


SLENDER_CORNER = Ground(
    fence=(
        (19.541225277989515, -13.74083169681408),
        (16.829419696157927, -28.806046117362797),
        (4.259168303185921, -37.54122527798951),
        (-10.806046117362795, -34.82941969615793),
        (-19.541225277989515, -22.259168303185923),
        (-16.82941969615793, -7.193953882637205),
        (-4.259168303185923, 1.5412252779895148),
        (10.806046117362795, -1.170580303842069),
    ),
    margin_m=0.0,
    keep_out=(
        ((-1.5, -2.598076211353315), (-1.5, 2.598076211353316), (3.0, 0.0)),
        (
            (2.931183791698427, -15.361124754522113),
            (2.5244129544236893, -17.62090691760442),
            (0.6388752454778881, -18.931183791698427),
            (-1.6209169076044193, -18.52441295442369),
            (-2.931183791698427, -16.638875245477887),
            (-2.5244129544236893, -14.379093082395581),
            (-4.046209888026627, 2.5641640140900392),
            (9.185139199758376, -1.6949932582657592),
        ),
    ),
)
"""A keep-out ends next to the fence: the way back goes to where the two almost touch."""


@settings(max_examples=20, deadline=None)
@given(ground=grounds(), flown=flights)
@example(SLENDER_CORNER, [((0.0, 0.0), None, 0.0)])
def test_every_waypoint_and_every_leg_keeps_the_margin(
    ground: Ground, flown: list[tuple[Point, TargetEstimate | None, float]]
) -> None:
    space = ground.space
    has_room = space.nearest_allowed(deepest_point(ground.fence)) is not None
    for planner in PLANNERS.values():
        memory: Any = None
        for vehicle, estimate, time_s in flown:
            plan = planner.plan(ground.request(vehicle, estimate, time_s), memory)
            memory, waypoint = plan.memory, plan.waypoint
            assert waypoint.detail
            if waypoint.detail == NO_ROOM:
                assert not has_room
                continue
            assert space.allows(waypoint.position_enu_m)
            _check_leg(ground, vehicle, waypoint)


def _check_leg(ground: Ground, begin: Point, waypoint: Waypoint) -> None:
    """Assert that a leg stays in free space, or is the shortest way back to it.

    Where two borders meet at a slender angle a micrometre of margin moves the corner by many, so
    the shortest way is held between those of a little more and a little less free space.
    """
    space, end = ground.space, waypoint.position_enu_m
    if not space.allows(begin):
        shortest_m = _way_back_m(space, begin)
        if shortest_m > 2.0 * START_TOLERANCE_M:
            narrower = FreeSpace(ground.fence, ground.keep_out, ground.margin_m + 2.0 * SLACK_M)
            assert shortest_m - 1e-9 <= math.dist(begin, end)
            assert math.dist(begin, end) <= _way_back_m(narrower, begin) + 1e-9
        return
    for step in range(51):
        assert space.allows(between(begin, end, step / 50.0))


def _way_back_m(space: FreeSpace, begin: Point) -> float:
    nearest = space.nearest_allowed(begin)
    return math.inf if nearest is None else math.dist(begin, nearest)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(ground=grounds(), flown=flights)
def test_the_same_memory_and_request_give_the_same_plan(
    ground: Ground, flown: list[tuple[Point, TargetEstimate | None, float]]
) -> None:
    for planner in PLANNERS.values():
        memory: Any = None
        seen = []
        for vehicle, estimate, time_s in flown:
            request = ground.request(vehicle, estimate, time_s)
            kept = copy.deepcopy(memory)
            plan = planner.plan(request, memory)
            assert memory == kept
            seen.append((request, memory, plan))
            memory = plan.memory
        for request, before, plan in reversed(seen):  # later calls left no trace
            assert planner.plan(request, before) == plan


def test_flying_only_its_waypoints_stays_in_free_space(planner: Planner[Any]) -> None:
    square = ((-60.0, -60.0), (60.0, -60.0), (60.0, 60.0), (-60.0, 60.0))
    house = ((-10.0, 10.0), (20.0, 10.0), (20.0, 25.0), (-10.0, 25.0))
    ground = Ground(square, 5.0, (house,))
    vehicle: Point = (-50.0, 0.0)
    memory: Any = None
    for step in range(200):
        estimate = an_estimate((70.0 * math.cos(step), 50.0), sigma_m=20.0)
        plan = planner.plan(ground.request(vehicle, estimate, float(step % 20)), memory)
        _check_leg(ground, vehicle, plan.waypoint)
        memory, vehicle = plan.memory, plan.waypoint.position_enu_m


def test_around_a_house_it_gets_to_the_far_side(crossing: Planner[Any]) -> None:
    """The target is behind a wall-like keep-out; every crossing planner comes to it or parks."""
    wall = ((0.0, -30.0), (4.0, -30.0), (4.0, 30.0), (0.0, 30.0))
    vehicle, nearest_m = (-25.0, 0.0), math.inf
    memory: Any = None
    reasons = set()
    for _ in range(60):
        request = PlanRequest(
            vehicle, an_estimate((25.0, 0.0)), fence_margin_m=2.0, keep_out_enu_m=(wall,)
        )
        plan = crossing.plan(request, memory)
        memory, vehicle = plan.memory, plan.waypoint.position_enu_m
        reasons.add(plan.waypoint.reason)
        nearest_m = min(nearest_m, math.dist(vehicle, (25.0, 0.0)))
    if WaypointReason.APPROACH in reasons:
        assert WaypointReason.DETOUR in reasons
        assert nearest_m <= 10.0


def test_without_a_fence_it_plans_as_inside_one_that_is_too_far_to_matter(
    crossing: Planner[Any],
) -> None:
    request = PlanRequest((0.0, 0.0), an_estimate((1000.0, 0.0)))
    wide = ((-1e6, -1e6), (1e6, -1e6), (1e6, 1e6), (-1e6, 1e6))
    plan = crossing.plan(request, None)
    assert crossing.plan(replace(request, fence_enu_m=wide), None) == plan
    assert (plan.waypoint.position_enu_m == (0.0, 0.0)) == (
        plan.waypoint.reason is WaypointReason.HOLD
    )


def test_without_an_estimate_crossing_holds_and_searching_searches(planner: Planner[Any]) -> None:
    square = ((-100.0, -100.0), (100.0, -100.0), (100.0, 100.0), (-100.0, 100.0))
    request = PlanRequest((7.0, 8.0), None, square, 3.0)
    waypoint = planner.plan(request, None).waypoint
    if planner.search_after_s is None:
        assert (waypoint.position_enu_m, waypoint.reason) == ((7.0, 8.0), WaypointReason.HOLD)
        assert waypoint.detail
    else:
        assert waypoint.reason is WaypointReason.SEARCH


HOSTILE = {
    "on the estimate": an_estimate((7.0, 7.0)),
    "nothing unsure": an_estimate((20.0, -3.0), sigma_m=0.0),
    "all unsure": an_estimate((20.0, -3.0), sigma_m=1e6, correlation=0.999),
    "wider than the universe": an_estimate((20.0, -3.0), sigma_m=1e30),
    "far away": an_estimate((1e7, -1e7)),
    "on the far side of the earth": an_estimate((-2e12, 1e9), sigma_m=1e9),
    "inside the house": an_estimate((32.0, 32.0)),
    "recovering": an_estimate((20.0, -3.0), state=EstimateState.DIVERGED),
}


@pytest.mark.parametrize("estimate", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("has_fence", [True, False])
def test_whatever_it_is_reported_the_waypoint_is_a_place(
    planner: Planner[Any], estimate: TargetEstimate, has_fence: bool
) -> None:
    square = ((-60.0, -60.0), (60.0, -60.0), (60.0, 60.0), (-60.0, 60.0))
    house = ((25.0, 25.0), (40.0, 25.0), (40.0, 40.0), (25.0, 40.0))
    ground = Ground(square, 3.0, (house,))
    vehicle: Point = (7.0, 7.0)
    memory: Any = None
    joint = frozen(np.diag([1e12, 0.0, 0.0, 0.0]))
    for _ in range(5):
        request = replace(
            ground.request(vehicle, estimate) if has_fence else PlanRequest(vehicle, estimate),
            joint_covariance=joint if estimate is HOSTILE["all unsure"] else None,
        )
        plan = planner.plan(request, memory)
        memory, waypoint = plan.memory, plan.waypoint
        assert all(math.isfinite(v) for v in waypoint.position_enu_m)
        assert math.isfinite(waypoint.altitude_offset_m)
        assert isinstance(waypoint.reason, WaypointReason)
        if has_fence:
            assert ground.space.allows(waypoint.position_enu_m)
            vehicle = waypoint.position_enu_m


def test_a_fence_without_room_sends_to_its_deepest_point(planner: Planner[Any]) -> None:
    polygon = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
    plan = planner.plan(PlanRequest((50.0, 0.0), an_estimate((90.0, 0.0)), polygon, 20.0), None)
    assert plan.waypoint.position_enu_m == deepest_point(polygon)
    assert plan.waypoint.reason is WaypointReason.HOLD


def test_a_vehicle_in_a_keep_out_takes_the_shortest_way_out(planner: Planner[Any]) -> None:
    house = ((-20.0, -10.0), (20.0, -10.0), (20.0, 10.0), (-20.0, 10.0))
    square = ((-90.0, -90.0), (90.0, -90.0), (90.0, 90.0), (-90.0, 90.0))
    request = Ground(square, 2.0, (house,)).request((3.0, 8.0), an_estimate((60.0, -60.0)))
    waypoint = planner.plan(request, None).waypoint
    assert waypoint.position_enu_m == pytest.approx((3.0, 12.0), abs=1e-5)


def test_behind_walls_on_all_sides_it_stays_and_says_why(planner: Planner[Any]) -> None:
    """A horseshoe closed by a second keep-out: the target is inside, the vehicle is not."""
    walls = (
        ((-20.0, -20.0), (20.0, -20.0), (20.0, -16.0), (-20.0, -16.0)),
        ((-20.0, 16.0), (20.0, 16.0), (20.0, 20.0), (-20.0, 20.0)),
        ((-20.0, -17.0), (-16.0, -17.0), (-16.0, 17.0), (-20.0, 17.0)),
        ((16.0, -17.0), (20.0, -17.0), (20.0, 17.0), (16.0, 17.0)),
    )
    tight = ((-21.0, -21.0), (50.0, -21.0), (50.0, 21.0), (-21.0, 21.0))
    request = PlanRequest(
        (0.0, 0.0), an_estimate((40.0, 0.0), sigma_m=0.1), tight, 0.5, keep_out_enu_m=walls
    )
    plan = planner.plan(request, None)
    position, memory = plan.waypoint.position_enu_m, plan.memory
    for _ in range(20):
        assert max(map(abs, position)) <= 15.5
        plan = planner.plan(replace(request, vehicle_enu_m=position), memory)
        position, memory = plan.waypoint.position_enu_m, plan.memory
        assert plan.waypoint.detail
