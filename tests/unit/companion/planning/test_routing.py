from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import Waypoint, WaypointReason
from companion.geometry.obstacles import FreeSpace, between
from companion.geometry.polygons import Point
from companion.planning.planner import (
    NO_ROOM,
    PlanRequest,
    cut_by_fence,
    hold_position,
    is_reachable,
    kept_inside,
    pushed_beyond,
    route_to,
    way_finder,
)
from tests.unit.companion.geometry.test_obstacles import positions, stars

SQUARE = ((-50.0, -50.0), (50.0, -50.0), (50.0, 50.0), (-50.0, 50.0))
HOUSE = ((-10.0, -10.0), (10.0, -10.0), (10.0, 10.0), (-10.0, 10.0))
WALL = ((-2.0, -60.0), (2.0, -60.0), (2.0, 60.0), (-2.0, 60.0))


def _request(
    vehicle: Point,
    *keep_outs: tuple[Point, ...],
    leg_from: Point | None = None,
    margin_m: float = 3.0,
) -> PlanRequest:
    return PlanRequest(
        vehicle,
        fence_enu_m=SQUARE,
        fence_margin_m=margin_m,
        keep_out_enu_m=keep_outs,
        leg_from_enu_m=leg_from,
    )


def _routed(request: PlanRequest, goal: Point) -> Waypoint:
    return route_to(request, Waypoint(goal, WaypointReason.CROSSING, "crossing 1", 4.0))


def test_without_limits_nothing_is_changed() -> None:
    wanted = Waypoint((1e9, 0.0), WaypointReason.CROSSING, "far")
    request = PlanRequest((0.0, 0.0))
    assert route_to(request, wanted) is wanted
    assert way_finder(request) is None
    assert is_reachable((1e9, 0.0), request)
    assert kept_inside((1e9, 0.0), (0.0, 0.0), request) == (1e9, 0.0)
    assert pushed_beyond((1e9, 0.0), (1.0, 0.0), request) == (1e9, 0.0)
    assert cut_by_fence((1e9, 0.0), (0.0, 0.0), request) == (1e9, 0.0)


def test_a_clear_leg_is_flown_as_wanted() -> None:
    wanted = Waypoint((30.0, 0.0), WaypointReason.APPROACH, "crossing 2", -4.0)
    assert route_to(_request((20.0, 20.0), HOUSE), wanted) == wanted


def test_around_a_house_corner_by_corner() -> None:
    position, goal, seen = (-30.0, 1.0), (30.0, 1.0), []
    for _ in range(10):
        waypoint = _routed(_request(position, HOUSE), goal)
        seen.append((waypoint.reason.value, waypoint.detail))
        assert waypoint.altitude_offset_m == 4.0
        position = waypoint.position_enu_m
        if position == goal:
            break
    assert seen == [
        ("detour", "2 corners to go: crossing 1"),
        ("detour", "1 corner to go: crossing 1"),
        ("crossing", "crossing 1"),
    ]


def test_the_leg_begins_at_the_setpoint_where_there_is_one() -> None:
    """The vehicle lags behind and still sees the house; its setpoint is around the corner."""
    lagging = _request((-13.5, -5.0), HOUSE, leg_from=(-9.0, -14.0))
    assert _routed(lagging, (30.0, -14.0)).reason is WaypointReason.CROSSING
    assert _routed(_request((-13.5, -5.0), HOUSE), (30.0, -14.0)).reason is WaypointReason.DETOUR


def test_a_goal_in_a_keep_out_is_moved_to_the_nearest_allowed_point() -> None:
    waypoint = _routed(_request((30.0, 0.0), HOUSE), (7.0, 1.0))
    assert waypoint.position_enu_m == pytest.approx((13.0, 1.0), abs=1e-5)
    assert waypoint.reason is WaypointReason.CROSSING


def test_out_of_a_keep_out_it_is_the_shortest_way() -> None:
    waypoint = _routed(_request((8.0, 1.0), HOUSE), (-30.0, 0.0))
    assert waypoint.position_enu_m == pytest.approx((13.0, 1.0), abs=1e-5)
    assert waypoint.reason is WaypointReason.DETOUR
    assert waypoint.detail == "back into free space: crossing 1"


def test_a_hair_inside_the_margin_is_where_it_is() -> None:
    assert _routed(_request((13.0 - 1e-3, 1.0), HOUSE), (30.0, 1.0)).reason is (
        WaypointReason.CROSSING
    )


def test_without_a_way_it_stays_and_says_so() -> None:
    request = _request((-30.0, 0.0), WALL)
    assert not is_reachable((30.0, 0.0), request)
    waypoint = _routed(request, (30.0, 0.0))
    assert waypoint == Waypoint((-30.0, 0.0), WaypointReason.HOLD, "no path to: crossing 1")


def test_without_room_it_is_reported() -> None:
    narrow = _request((1.0, 0.0), margin_m=60.0)
    assert _routed(narrow, (3.0, 0.0)).reason is WaypointReason.HOLD
    assert _routed(narrow, (3.0, 0.0)).detail == NO_ROOM
    assert not is_reachable((3.0, 0.0), narrow)
    everywhere = ((-99.0, -99.0), (99.0, -99.0), (99.0, 99.0), (-99.0, 99.0))
    assert _routed(_request((1.0, 0.0), everywhere), (3.0, 0.0)).detail == NO_ROOM
    assert kept_inside((3.0, 0.0), (0.0, 0.0), _request((1.0, 0.0), everywhere)) == (3.0, 0.0)


def test_holding_is_at_the_setpoint() -> None:
    held_there = hold_position(_request((0.0, 20.0), HOUSE, leg_from=(0.0, 24.0)), "why")
    assert held_there == Waypoint((0.0, 24.0), WaypointReason.HOLD, "why")


def test_pushed_through_a_house_or_not_at_all() -> None:
    request = _request((-30.0, 0.0), HOUSE)
    assert pushed_beyond((2.0, 0.0), (1.0, 0.0), request) == pytest.approx((13.0, 0.0), abs=1e-5)
    assert pushed_beyond((20.0, 0.0), (1.0, 0.0), request) == (20.0, 0.0)
    assert pushed_beyond((0.0, 0.0), (0.0, 1.0), _request((-30.0, 0.0), WALL)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("point", "anchor", "kept"),
    [
        ((80.0, 0.0), (20.0, 0.0), (47.0, 0.0)),
        ((80.0, 60.0), (20.0, 20.0), (47.0, 38.0)),
        ((20.0, 0.0), (0.0, 0.0), (20.0, 0.0)),
    ],
)
def test_beyond_the_fence_is_cut_on_the_way_there(point: Point, anchor: Point, kept: Point) -> None:
    assert kept_inside(point, anchor, _request((0.0, 0.0))) == pytest.approx(kept, abs=1e-4)


def test_from_an_anchor_outside_it_is_cut_from_the_middle() -> None:
    east, north = cut_by_fence((80.0, 0.0), (90.0, 0.0), _request((0.0, 0.0)))
    assert east == pytest.approx(47.0, abs=1e-4)
    assert abs(north) < 3.0
    assert (
        math.hypot(*cut_by_fence((80.0, 0.0), (90.0, 0.0), _request((0.0, 0.0), margin_m=60.0)))
        < 4.0
    )


@settings(max_examples=60, deadline=None)
@given(
    st.none() | stars(50.0, 150.0),
    st.lists(stars(3.0, 40.0), max_size=4),
    st.sampled_from([0.0, 0.5, 3.0]),
    positions,
    positions,
    st.floats(20.0, 500.0),
)
def test_flown_in_steps_it_ends_at_the_goal_without_leaving_free_space(
    fence: tuple[Point, ...] | None,
    keep_outs: list[tuple[Point, ...]],
    margin_m: float,
    start: Point,
    goal: Point,
    step_m: float,
) -> None:
    space = FreeSpace(fence, keep_outs, margin_m)
    position, end = start, space.nearest_allowed(goal)
    has_been_inside = space.allows(position)
    for _ in range(2000):
        request = PlanRequest(position, None, fence, margin_m, keep_out_enu_m=tuple(keep_outs))
        waypoint = _routed(request, goal)
        aim = waypoint.position_enu_m
        if waypoint.reason is WaypointReason.HOLD:
            return
        if math.dist(position, aim) < 1e-9:
            break
        share = min(1.0, step_m / math.dist(position, aim))
        if has_been_inside:
            assert all(space.allows(between(position, aim, share * k / 10.0)) for k in range(11))
        position = between(position, aim, share)
        has_been_inside = has_been_inside or (share == 1.0)
    assert end is not None
    assert math.dist(position, goal) == pytest.approx(math.dist(end, goal), abs=1e-4)
