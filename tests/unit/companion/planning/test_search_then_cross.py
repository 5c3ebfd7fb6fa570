from __future__ import annotations

import pytest

from companion.domain import EstimateState, TargetEstimate, WaypointReason
from companion.geometry.polygons import Point
from companion.planning.crossing import LatchedCrossing, LatchedCrossingParams
from companion.planning.planner import Plan, PlanRequest
from companion.planning.search import (
    LawnmowerParams,
    SearchPlanner,
    SearchThenCross,
    SearchThenCrossMemory,
)
from companion.planning.views import Latch

FIELD = ((0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0))
PLANNER = SearchThenCross(
    SearchPlanner(LawnmowerParams(area_enu_m=FIELD)),
    LatchedCrossing(LatchedCrossingParams()),
    lost_after_s=10.0,
)
Memory = SearchThenCrossMemory[Latch | None]


def _estimate(state: EstimateState = EstimateState.SEARCHING) -> TargetEstimate:
    covariance = ((9.0, 0.0), (0.0, 9.0))
    return TargetEstimate(0.0, state, (50.0, 40.0), covariance, 7.0, 0.0, 0.0, 1)


def _plan(
    vehicle: Point,
    memory: Memory,
    estimate: TargetEstimate | None = None,
    time_s: float = 0.0,
    contact_s: float | None = None,
) -> Plan[Memory]:
    request = PlanRequest(vehicle, estimate, time_s=time_s, contact_s=contact_s)
    return PLANNER.plan(request, memory)


def _on_a_lane() -> Memory:
    memory = _plan((0.0, 10.0), SearchThenCrossMemory()).memory
    return _plan((30.0, 10.0), memory).memory


def test_it_searches_until_there_is_an_estimate() -> None:
    plan = _plan((40.0, 10.0), _on_a_lane())
    assert plan.waypoint.reason is WaypointReason.SEARCH
    assert not plan.memory.is_crossing
    crossed = _plan((40.0, 10.0), plan.memory, _estimate())
    assert crossed.waypoint.reason is WaypointReason.APPROACH
    assert crossed.memory.is_crossing
    assert crossed.memory.search == plan.memory.search


def test_it_does_not_hand_over_on_an_estimate_that_contradicts_itself() -> None:
    memory = _on_a_lane()
    diverged = _estimate(EstimateState.DIVERGED)
    assert _plan((40.0, 10.0), memory, diverged).waypoint.reason is WaypointReason.SEARCH
    crossing = _plan((40.0, 10.0), memory, _estimate()).memory
    assert _plan((40.0, 10.0), crossing, diverged).memory.is_crossing  # nor back for that alone


def test_contact_that_is_lost_for_long_leads_back_to_the_place_it_was_left_at() -> None:
    memory = _on_a_lane()
    for time_s in (1.0, 5.0, 10.9):
        plan = _plan((45.0, 20.0), memory, _estimate(), time_s=time_s, contact_s=0.9)
        assert plan.memory.is_crossing
        memory = plan.memory
    lost = _plan((50.0, 44.0), memory, _estimate(), time_s=11.0, contact_s=0.9)
    assert lost.waypoint.reason is WaypointReason.SEARCH
    assert lost.waypoint.position_enu_m == pytest.approx((30.0, 10.0))
    assert lost.memory.crossing is None
    again = _plan((50.0, 44.0), lost.memory, _estimate(), time_s=12.0, contact_s=12.0)
    assert again.memory.is_crossing
    assert again.memory.crossing is not None
    assert again.memory.crossing.crossings == 0


def test_a_forgotten_target_is_searched_for() -> None:
    crossing = _plan((40.0, 10.0), _on_a_lane(), _estimate()).memory
    assert not _plan((40.0, 10.0), crossing, None).memory.is_crossing


def test_it_says_how_long_it_waits() -> None:
    assert PLANNER.search_after_s == 10.0
