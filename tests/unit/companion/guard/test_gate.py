"""The guard against everything that a goal, a clock and a vehicle can do.

What is promised of `towards`, from a previous setpoint that came from the guard itself: inside the
fence by the margin, in the altitude band, no farther from the previous one than speed and climb
allow, and never farther ahead of the vehicle than the step limit by its own doing. `here` keeps
fence and band, and is the only one that may jump: it says where the stream begins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.geometry.polygons import Point, deepest_point, depth_m
from companion.guard.fence import Fence
from companion.guard.gate import (
    MAX_TICK_S,
    Guard,
    Guarded,
    GuardLimits,
    GuardReason,
    Position,
)

SQUARE = Fence(((-100.0, -100.0), (100.0, -100.0), (100.0, 100.0), (-100.0, 100.0)), 5.0)
LIMITS = GuardLimits(
    fence=SQUARE,
    altitude_min_m=5.0,
    altitude_max_m=60.0,
    speed_mps=5.0,
    climb_mps=2.0,
    step_m=8.0,
)
GUARD = Guard(LIMITS)
HOME_UP_M = 10.0
ROUNDING_M = 1e-9


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick: what is wanted, where the vehicle has got to, and how late it is."""

    goal_enu_m: Position
    drift_m: Point
    dt_s: float


wild = st.floats(-1e9, 1e9) | st.sampled_from([math.nan, math.inf, -math.inf, 1e9, 1e308, -1e308])
near = st.floats(-300.0, 300.0)
goals = st.tuples(near | wild, near | wild, st.floats(-50.0, 150.0) | wild)
ticks = st.builds(
    Tick,
    goals,
    st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)),
    st.sampled_from([0.05, 0.1]) | st.floats(-1.0, 1e6),
)


@st.composite
def guards(draw: st.DrawFn) -> Guard:
    radii = draw(st.lists(st.floats(30.0, 200.0), min_size=3, max_size=8))
    polygon = tuple(
        (
            radius * math.cos(2.0 * math.pi * i / len(radii)),
            radius * math.sin(2.0 * math.pi * i / len(radii)),
        )
        for i, radius in enumerate(radii)
    )
    margin_m = draw(st.floats(0.0, 0.8)) * depth_m(polygon, deepest_point(polygon))
    return Guard(
        GuardLimits(
            fence=draw(st.sampled_from([Fence(polygon, margin_m), None])),
            altitude_min_m=draw(st.floats(1.0, 20.0)),
            altitude_max_m=draw(st.floats(21.0, 120.0)),
            speed_mps=draw(st.floats(0.1, 20.0)),
            climb_mps=draw(st.floats(0.1, 5.0)),
            step_m=draw(st.floats(0.5, 20.0)),
        )
    )


def assert_inside(guard: Guard, position: Position) -> None:
    """Inside the fence by the margin and in the altitude band, and a number at all."""
    limits, (east, north, up) = guard.limits, position
    assert all(math.isfinite(v) for v in position)
    low, high = HOME_UP_M + limits.altitude_min_m, HOME_UP_M + limits.altitude_max_m
    assert low - ROUNDING_M <= up <= high + ROUNDING_M
    if limits.fence is not None:
        depth = depth_m(limits.fence.polygon_enu_m, (east, north))
        assert depth >= limits.fence.margin_m


def assert_reachable(guard: Guard, before: Position, after: Position, dt_s: float) -> None:
    """No faster than the limits, whatever the clock says."""
    tick_s = min(max(dt_s, 0.0), MAX_TICK_S)
    step_m = math.dist(before[:2], after[:2])
    assert step_m <= guard.limits.speed_mps * tick_s + ROUNDING_M
    assert abs(after[2] - before[2]) <= guard.limits.climb_mps * tick_s + ROUNDING_M


def assert_lead(guard: Guard, before: Position, after: Position, vehicle: Position) -> None:
    """Within the step limit, or no farther from the vehicle than it was."""
    lead_m = math.dist(after[:2], vehicle[:2])
    was_m = math.dist(before[:2], vehicle[:2])
    assert lead_m <= max(guard.limits.step_m, was_m) + ROUNDING_M


@settings(max_examples=150, deadline=None)
@given(guards(), st.tuples(near, near, near), st.lists(ticks, min_size=1, max_size=12))
def test_every_setpoint_is_safe_to_be_the_last(
    guard: Guard, vehicle: Position, flown: list[Tick]
) -> None:
    setpoint = guard.here(vehicle, HOME_UP_M).position_enu_m
    assert_inside(guard, setpoint)
    for tick in flown:
        vehicle = (vehicle[0] + tick.drift_m[0], vehicle[1] + tick.drift_m[1], vehicle[2])
        guarded = guard.towards(tick.goal_enu_m, setpoint, vehicle, HOME_UP_M, tick.dt_s)
        assert_inside(guard, guarded.position_enu_m)
        if GuardReason.JUMPED in guarded.reasons:
            assert math.dist(setpoint[:2], vehicle[:2]) > 2.0 * guard.limits.step_m
            assert guarded.position_enu_m[:2] == guard.here(vehicle, HOME_UP_M).position_enu_m[:2]
        else:
            assert_reachable(guard, setpoint, guarded.position_enu_m, tick.dt_s)
            assert_lead(guard, setpoint, guarded.position_enu_m, vehicle)
        if not all(math.isfinite(v) for v in tick.goal_enu_m):
            assert guarded == Guarded(setpoint, (GuardReason.NOT_FINITE,))
        setpoint = guarded.position_enu_m


@settings(max_examples=100, deadline=None)
@given(guards(), st.tuples(near, near, near), st.tuples(near, near, near))
def test_a_setpoint_from_elsewhere_comes_inside_and_stays(
    guard: Guard, previous: Position, goal: Position
) -> None:
    """One that the guard did not make may be anywhere; the next one is inside already."""
    for _ in range(3):
        previous = guard.towards(goal, previous, previous, HOME_UP_M, 0.1).position_enu_m
        if guard.limits.fence is not None:
            assert guard.limits.fence.allows(previous[:2])


def _flown(goal: Position, start: Position = (0.0, 0.0, 30.0), ticks: int = 1000) -> list[Guarded]:
    """A vehicle that is always where its setpoint is."""
    flown = [Guarded(start, ())]
    for _ in range(ticks):
        at = flown[-1].position_enu_m
        flown.append(GUARD.towards(goal, at, at, HOME_UP_M, 0.1))
    return flown


def test_a_goal_within_the_limits_is_reached_exactly_and_in_time() -> None:
    flown = _flown((30.0, 40.0, 40.0))
    assert all(not guarded.reasons for guarded in flown)
    places = [guarded.position_enu_m for guarded in flown]
    # 50 m at 5 m/s and 10 m at 2 m/s.
    assert places[99][:2] != (30.0, 40.0)
    assert places[101][:2] == (30.0, 40.0)
    assert places[49][2] < 40.0
    assert places[51][2] == 40.0


def test_a_goal_outside_the_fence_ends_at_the_margin() -> None:
    last = _flown((1e9, 0.0, 30.0))[-1]
    assert last.position_enu_m == pytest.approx((95.0, 0.0, 30.0), abs=1e-9)
    assert last.reasons == (GuardReason.FENCE,)


@pytest.mark.parametrize(("up_m", "end_m"), [(1e9, 70.0), (-1e9, 15.0)])
def test_a_goal_outside_the_band_ends_at_its_edge(up_m: float, end_m: float) -> None:
    last = _flown((0.0, 0.0, up_m))[-1]
    assert last.position_enu_m == (0.0, 0.0, end_m)
    assert last.reasons == (GuardReason.ALTITUDE,)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_goal_that_is_no_number_keeps_the_setpoint(axis: int, value: float) -> None:
    goal = (*(0.0, 0.0, 30.0)[:axis], value, *(0.0, 0.0, 30.0)[axis + 1 :])
    before = (1.0, 2.0, 30.0)
    guarded = GUARD.towards((goal[0], goal[1], goal[2]), before, before, HOME_UP_M, 0.1)
    assert guarded == Guarded(before, (GuardReason.NOT_FINITE,))


def test_a_vehicle_home_or_clock_that_is_no_number_keeps_the_setpoint() -> None:
    goal, before = (30.0, 0.0, 30.0), (1.0, 2.0, 30.0)
    kept = Guarded(before, (GuardReason.NOT_FINITE,))
    assert GUARD.towards(goal, before, (math.nan, 2.0, 30.0), HOME_UP_M, 0.1) == kept
    assert GUARD.towards(goal, before, before, math.nan, 0.1) == kept
    assert GUARD.towards(goal, before, before, HOME_UP_M, math.nan) == kept


@pytest.mark.parametrize(
    ("dt_s", "moved_m"), [(-1.0, 0.0), (0.0, 0.0), (0.1, 0.5), (0.2, 1.0), (5.0, 1.0), (1e9, 1.0)]
)
def test_a_late_tick_moves_no_farther_than_a_slow_one(dt_s: float, moved_m: float) -> None:
    at = (0.0, 0.0, 30.0)
    guarded = GUARD.towards((50.0, 0.0, 30.0), at, at, HOME_UP_M, dt_s)
    assert guarded.position_enu_m == pytest.approx((moved_m, 0.0, 30.0))


def test_it_waits_for_a_vehicle_that_lags_behind() -> None:
    vehicle, setpoint = (0.0, 0.0, 30.0), (0.0, 0.0, 30.0)
    for _ in range(100):
        guarded = GUARD.towards((50.0, 0.0, 30.0), setpoint, vehicle, HOME_UP_M, 0.1)
        setpoint = guarded.position_enu_m
    assert setpoint == pytest.approx((8.0, 0.0, 30.0))
    assert guarded.reasons == (GuardReason.LAGGING,)
    onwards = GUARD.towards((50.0, 0.0, 30.0), setpoint, (4.0, 0.0, 30.0), HOME_UP_M, 0.1)
    assert onwards.position_enu_m == pytest.approx((8.5, 0.0, 30.0))
    assert onwards.reasons == ()


def test_it_may_come_back_to_a_vehicle_that_fell_behind() -> None:
    """Blown 15 m away, the setpoint still moves when that brings it nearer."""
    guarded = GUARD.towards(
        (-50.0, 0.0, 30.0), (0.0, 0.0, 30.0), (-15.0, 0.0, 30.0), HOME_UP_M, 0.1
    )
    assert guarded.position_enu_m == pytest.approx((-0.5, 0.0, 30.0))


def test_a_vehicle_that_jumped_away_is_not_flown_back_across_the_gap() -> None:
    """An autopilot's position may jump by tens of metres when its estimator resets."""
    hold = (10.0, 0.0, 30.0)
    guarded = GUARD.towards(hold, hold, (60.0, 0.0, 30.0), HOME_UP_M, 0.05)
    assert guarded == Guarded((60.0, 0.0, 30.0), (GuardReason.JUMPED,))


def test_here_is_where_the_vehicle_is() -> None:
    assert GUARD.here((3.0, 4.0, 30.0), HOME_UP_M) == Guarded((3.0, 4.0, 30.0), ())


def test_here_is_moved_inside_and_says_why() -> None:
    guarded = GUARD.here((120.0, 0.0, 5.0), HOME_UP_M)
    assert guarded.position_enu_m == pytest.approx((95.0, 0.0, 15.0), abs=1e-5)
    assert set(guarded.reasons) == {GuardReason.OUTSIDE, GuardReason.ALTITUDE}


def test_here_without_a_fence_only_keeps_the_band() -> None:
    guard = Guard(replace(LIMITS, fence=None))
    guarded = guard.here((1200.0, 0.0, 500.0), HOME_UP_M)
    assert guarded == Guarded((1200.0, 0.0, 70.0), (GuardReason.ALTITUDE,))


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_that_limit_nothing_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        replace(LIMITS, speed_mps=value)
    with pytest.raises(ValueError, match="must be positive"):
        replace(LIMITS, climb_mps=value)
    with pytest.raises(ValueError, match="must be positive"):
        replace(LIMITS, step_m=value)


@pytest.mark.parametrize(
    ("low_m", "high_m"),
    [(0.0, 60.0), (-5.0, 60.0), (60.0, 60.0), (61.0, 60.0), (5.0, math.inf), (math.nan, 60.0)],
)
def test_an_empty_altitude_band_is_refused(low_m: float, high_m: float) -> None:
    with pytest.raises(ValueError, match="altitude band"):
        replace(LIMITS, altitude_min_m=low_m, altitude_max_m=high_m)
