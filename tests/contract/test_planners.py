"""What every planner promises, whatever it has in mind."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, Point, TargetEstimate, WaypointReason
from companion.geometry.polygons import deepest_point, depth_m
from companion.planning.base import Planner, PlanRequest
from companion.planning.latched_crossing import LatchedCrossing, LatchedCrossingParams
from companion.planning.reactive_crossing import ReactiveCrossing, ReactiveCrossingParams

PLANNERS: dict[str, Planner[Any]] = {
    "reactive": ReactiveCrossing(ReactiveCrossingParams()),
    "reactive, parking": ReactiveCrossing(ReactiveCrossingParams(stop_distance_m=500.0)),
    "latched": LatchedCrossing(LatchedCrossingParams()),
    "latched, tight": LatchedCrossing(
        LatchedCrossingParams(overshoot_max_m=2.0, arrival_radius_m=0.1)
    ),
}

ROUNDING_M = 1e-9

places = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))


@pytest.fixture(params=PLANNERS)
def planner(request: pytest.FixtureRequest) -> Planner[Any]:
    return PLANNERS[request.param]


def an_estimate(
    position_enu_m: Point, sigma_m: float = 3.0, correlation: float = 0.0
) -> TargetEstimate:
    variance, covariance = sigma_m**2, correlation * sigma_m**2
    return TargetEstimate(
        time_s=0.0,
        state=EstimateState.SEARCHING,
        position_enu_m=position_enu_m,
        covariance_m2=((variance, covariance), (covariance, variance)),
        r95_m=2.45 * sigma_m,
        range_offset_m=0.0,
        bearing_offset_rad=0.0,
        measurements=1,
    )


estimates = st.builds(an_estimate, places, st.floats(0.0, 100.0), st.floats(-0.99, 0.99))


@st.composite
def fences(draw: st.DrawFn) -> tuple[tuple[Point, ...], float]:
    """A star-shaped polygon, convex or not, and a margin that leaves something of it."""
    centre = draw(st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)))
    radii = draw(st.lists(st.floats(20.0, 200.0), min_size=3, max_size=9))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    polygon = tuple(
        (
            centre[0] + radius * math.cos(first + 2.0 * math.pi * i / len(radii)),
            centre[1] + radius * math.sin(first + 2.0 * math.pi * i / len(radii)),
        )
        for i, radius in enumerate(radii)
    )
    depth = depth_m(polygon, deepest_point(polygon))
    return polygon, draw(st.floats(0.0, 0.95)) * depth


@settings(max_examples=60, deadline=None)
@given(fence=fences(), flown=st.lists(st.tuples(places, estimates), min_size=1, max_size=8))
def test_every_waypoint_is_inside_the_fence_by_the_margin(
    fence: tuple[tuple[Point, ...], float], flown: list[tuple[Point, TargetEstimate]]
) -> None:
    polygon, margin_m = fence
    for planner in PLANNERS.values():
        memory = planner.initial_memory()
        for vehicle, estimate in flown:
            plan = planner.plan(PlanRequest(vehicle, estimate, polygon, margin_m), memory)
            memory = plan.memory
            depth = depth_m(polygon, plan.waypoint.position_enu_m)
            assert depth >= margin_m - ROUNDING_M
            assert plan.waypoint.detail


@settings(max_examples=60, deadline=None)
@given(flown=st.lists(st.tuples(places, estimates), min_size=2, max_size=8))
def test_the_same_memory_and_request_give_the_same_plan(
    flown: list[tuple[Point, TargetEstimate]],
) -> None:
    for planner in PLANNERS.values():
        memory = planner.initial_memory()
        seen = []
        for vehicle, estimate in flown:
            request = PlanRequest(vehicle, estimate)
            plan = planner.plan(request, memory)
            seen.append((request, memory, plan))
            memory = plan.memory
        for request, before, plan in reversed(seen):  # later calls left no trace
            assert planner.plan(request, before) == plan


def test_flying_only_its_waypoints_stays_inside(planner: Planner[Any]) -> None:
    polygon = ((-60.0, -60.0), (60.0, -60.0), (60.0, 60.0), (-60.0, 60.0))
    vehicle, memory = (-50.0, 0.0), planner.initial_memory()
    for step in range(200):
        estimate = an_estimate((70.0 * math.cos(step), 50.0), sigma_m=20.0)
        plan = planner.plan(PlanRequest(vehicle, estimate, polygon, 5.0), memory)
        memory, vehicle = plan.memory, plan.waypoint.position_enu_m
        assert depth_m(polygon, vehicle) >= 5.0 - ROUNDING_M


def test_without_a_fence_nothing_is_cut_short(planner: Planner[Any]) -> None:
    plan = planner.plan(
        PlanRequest((0.0, 0.0), an_estimate((1000.0, 0.0))), planner.initial_memory()
    )
    assert plan.waypoint.position_enu_m[0] > 0.0
    assert plan.waypoint.position_enu_m[1] == pytest.approx(0.0)


def test_on_top_of_the_estimate_there_is_still_a_waypoint(planner: Planner[Any]) -> None:
    plan = planner.plan(PlanRequest((7.0, 7.0), an_estimate((7.0, 7.0))), planner.initial_memory())
    assert all(math.isfinite(v) for v in plan.waypoint.position_enu_m)
    assert isinstance(plan.waypoint.reason, WaypointReason)


def test_a_fence_without_room_sends_to_its_deepest_point(planner: Planner[Any]) -> None:
    polygon = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
    plan = planner.plan(
        PlanRequest((50.0, 0.0), an_estimate((90.0, 0.0)), polygon, 20.0), planner.initial_memory()
    )
    assert plan.waypoint.position_enu_m == deepest_point(polygon)
