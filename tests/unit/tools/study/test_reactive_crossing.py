from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, TargetEstimate, WaypointReason
from companion.geometry.polygons import Point
from companion.planning.planner import PlanRequest
from tools.study.case import Case
from tools.study.reactive_crossing import ReactiveCrossing

positions = st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))


def _target_at(position_enu_m: Point) -> TargetEstimate:
    covariance = ((9.0, 0.0), (0.0, 9.0))
    return TargetEstimate(
        0.0, EstimateState.SEARCHING, position_enu_m, covariance, 7.0, 0.0, 0.0, 1
    )


def _next(case: Case, vehicle: Point, target: Point) -> Point:
    request = PlanRequest(vehicle, _target_at(target))
    return ReactiveCrossing(case).plan(request, None).waypoint.position_enu_m


@settings(deadline=None)
@given(positions, positions, st.floats(0.1, 500.0), st.floats(0.1, 500.0))
def test_the_crossing_distance_as_printed_has_no_effect(
    vehicle: Point, target: Point, one_m: float, other_m: float
) -> None:
    assume(math.dist(vehicle, target) > 1e-3)
    one = _next(Case(crossing_distance_m=one_m), vehicle, target)
    other = _next(Case(crossing_distance_m=other_m), vehicle, target)
    assert one == pytest.approx(other, abs=1e-7)


@settings(deadline=None)
@given(positions, positions, st.floats(0.1, 50.0))
def test_each_step_flies_at_the_estimate_by_the_step_length(
    vehicle: Point, target: Point, step_m: float
) -> None:
    distance_m = math.dist(vehicle, target)
    assume(distance_m > 1e-3)
    there = _next(Case(step_m=step_m), vehicle, target)
    assert math.dist(vehicle, there) == pytest.approx(step_m, rel=1e-9)
    assert math.dist(there, target) == pytest.approx(abs(distance_m - step_m), abs=1e-7)


def test_it_crosses_by_overshooting_less_than_a_step() -> None:
    assert _next(Case(), (7.0, 0.0), (10.0, 0.0)) == pytest.approx((12.0, 0.0))


@pytest.mark.parametrize(("distance_m", "reason"), [(2.4, "hold"), (2.5, "crossing")])
def test_it_parks_closer_than_the_stop_distance(distance_m: float, reason: str) -> None:
    planner = ReactiveCrossing(Case(stop_distance_m=2.5))
    vehicle = (10.0 - distance_m, 0.0)
    waypoint = planner.plan(PlanRequest(vehicle, _target_at((10.0, 0.0))), None).waypoint
    assert waypoint.reason is WaypointReason(reason)
    assert (waypoint.position_enu_m == vehicle) is (reason == "hold")


def test_parking_outside_the_fence_is_parking_inside() -> None:
    planner = ReactiveCrossing(Case(stop_distance_m=10.0))
    square = ((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0))
    request = PlanRequest((25.0, 0.0), _target_at((26.0, 0.0)), square, 3.0)
    east, north = planner.plan(request, None).waypoint.position_enu_m
    assert east == pytest.approx(17.0)
    assert abs(north) < 1.0


def test_without_an_estimate_it_holds() -> None:
    plan = ReactiveCrossing(Case()).plan(PlanRequest((3.0, 4.0)), None)
    assert plan.waypoint.position_enu_m == (3.0, 4.0)
    assert plan.waypoint.reason is WaypointReason.HOLD
