"""Promises of the guard about every setpoint, whatever goals, clocks and vehicles do.

The geometry is judged by shapely, which shares no line with the guard's own. A setpoint either

- went on from the one before: by elapsed time no faster, and no faster changed, than the limits
  allow, or it stayed exactly where it was; and if it moved, it may be the last one: inside by the
  margin, its stop and the straight ways to it three sigma from every border; or
- comes in from outside or the margin, no farther out than the vehicle, by the same limits; or
- begins anew where the vehicle is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon
from shapely.geometry import Point as ShapelyPoint

from companion.geometry.polygons import Point, deepest_point, depth_m
from companion.guard.gate import Guard, Guarded, GuardLimits, GuardReason, Motion, Position
from companion.guard.limits import MAX_TICK_S, Envelope, Fence, Reserve, Stopping

HOME_UP_M = 10.0
ROUNDING_M = 1e-6
WAY_IN = (GuardReason.OUTSIDE, GuardReason.MARGIN)
ANEW = (*WAY_IN, GuardReason.JUMPED, GuardReason.TOO_FAST, GuardReason.CUT_OFF)


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick: what is wanted, how the vehicle moved, and how late it is."""

    goal_enu_m: Position
    drift_m: Point
    velocity_enu_mps: Position
    follows: float
    """The share of the way to its setpoint that the vehicle has flown since."""
    dt_s: float
    cap_mps: float
    battery_pct: float | None


wild = st.floats(-1e9, 1e9) | st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308])
near = st.floats(-150.0, 150.0)
speeds = st.floats(-12.0, 12.0)
goals = st.tuples(near, near, st.floats(-50.0, 150.0)) | st.tuples(near | wild, near | wild, wild)
ticks = st.builds(
    Tick,
    goals,
    st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)),
    st.tuples(speeds, speeds, st.floats(-3.0, 3.0)) | st.just((0.0, 0.0, 0.0)),
    st.floats(0.0, 1.0),
    st.sampled_from([0.05, 0.1]) | st.floats(-1.0, 1e6),
    st.just(math.inf) | st.floats(0.0, 8.0),
    st.none() | st.floats(0.0, 100.0),
)


@st.composite
def polygons(draw: st.DrawFn, least_m: float, most_m: float) -> tuple[Point, ...]:
    """Star-shaped, convex or not, in either direction."""
    radii = draw(st.lists(st.floats(least_m, most_m), min_size=3, max_size=8))
    first = draw(st.floats(0.0, 2.0 * math.pi))
    turns = [first + 2.0 * math.pi * i / len(radii) for i in range(len(radii))]
    polygon = tuple(
        (r * math.cos(turn), r * math.sin(turn)) for r, turn in zip(radii, turns, strict=True)
    )
    return polygon if draw(st.booleans()) else polygon[::-1]


@st.composite
def fences(draw: st.DrawFn) -> Fence:
    polygon = draw(polygons(30.0, 150.0))
    margin_m = draw(st.floats(0.01, 0.5)) * depth_m(polygon, deepest_point(polygon))
    keep_out, (east, north) = draw(polygons(1.0, 20.0)), draw(st.tuples(near, near))
    moved = tuple((e + east, n + north) for e, n in keep_out)
    try:
        return Fence(polygon, margin_m, draw(st.sampled_from([(moved,), ()])))
    except ValueError:  # it leaves nothing
        return Fence(polygon, margin_m)


@st.composite
def guards(draw: st.DrawFn) -> Guard:
    fence = draw(fences())
    acceleration_mps2 = draw(st.floats(0.5, 8.0))
    envelope = Envelope(
        altitude_min_m=draw(st.floats(1.0, 20.0)),
        altitude_max_m=draw(st.floats(150.0, 200.0)),
        speed_mps=draw(st.floats(0.1, 20.0)),
        climb_mps=draw(st.floats(0.1, 5.0)),
        acceleration_mps2=acceleration_mps2,
        step_m=draw(st.floats(0.5, 20.0)),
    )
    sigma_m = draw(st.floats(0.0, 0.999)) * fence.margin_m / 3.0  # all of it, but for rounding
    stopping = Stopping(draw(st.floats(0.0, 1.0)), acceleration_mps2, sigma_m)
    leash_m = draw(st.just(math.inf) | st.floats(10.0, 200.0))
    reserve = draw(st.none() | st.just(Reserve(20.0, 500.0)))
    return Guard(GuardLimits(fence, envelope, stopping, leash_m, reserve))


class Oracle:
    """The same fence for shapely."""

    def __init__(self, fence: Fence) -> None:
        self.inside = Polygon(fence.polygon_enu_m)
        self.keep_outs = [Polygon(corners) for corners in fence.keep_out_enu_m]

    def clearance_m(self, *way: Point) -> float:
        """Distance of a straight way from the nearest border; negative if it leaves."""
        shape = LineString(way) if len(set(way)) > 1 else ShapelyPoint(way[0])
        if not self.inside.contains(shape) or any(shape.intersects(k) for k in self.keep_outs):
            return -1.0
        borders = [self.inside.exterior, *(keep_out.exterior for keep_out in self.keep_outs)]
        return float(min(shape.distance(border) for border in borders))


def ahead(position: Point, velocity: Position, time_s: float) -> Point:
    return (position[0] + velocity[0] * time_s, position[1] + velocity[1] * time_s)


def assert_may_be_last(guard: Guard, oracle: Oracle, setpoint: Guarded, motion: Motion) -> None:
    """Assert that a setpoint that moved may be the last one."""
    stopping, position = guard.limits.stopping, setpoint.position_enu_m[:2]
    fence, velocity = guard.limits.fence, setpoint.velocity_enu_mps
    assert fence is not None
    assert oracle.clearance_m(position) >= fence.margin_m - ROUNDING_M
    speed_mps = math.hypot(*velocity[:2])
    braking_m = speed_mps * speed_mps / (2.0 * stopping.deceleration_mps2)
    needed_m = speed_mps * stopping.latency_s + braking_m
    stop = position if speed_mps == 0.0 else ahead(position, velocity, needed_m / speed_mps)
    three_sigma_m = 3.0 * stopping.navigation_sigma_m - ROUNDING_M
    assert oracle.clearance_m(position, stop) >= three_sigma_m
    vehicle = motion.position_enu_m[:2]
    assert oracle.clearance_m(vehicle, position) >= three_sigma_m
    arrival = ahead(vehicle, motion.velocity_enu_mps, stopping.latency_s)
    assert oracle.clearance_m(arrival, position) >= three_sigma_m


def out_m(guard: Guard, position: Position) -> float:
    """Return the distance, m, of a position from the nearest that is allowed."""
    assert guard.limits.fence is not None
    return math.dist(position[:2], guard.limits.fence.nearest_allowed(position[:2]))


def assert_comes_in(
    guard: Guard, before: Guarded, after: Guarded, tick: Tick, vehicle: Position
) -> None:
    """Assert a way in within speed, climb and acceleration, or a start at the vehicle."""
    envelope, dt_s = guard.limits.envelope, min(max(tick.dt_s, 0.0), MAX_TICK_S)
    at = after.position_enu_m[:2]
    moved_m = min(math.dist(before.position_enu_m[:2], at), math.dist(vehicle[:2], at))
    was_mps = math.hypot(*before.velocity_enu_mps[:2])
    most_mps = min(max(envelope.speed_mps, was_mps), was_mps + envelope.acceleration_mps2 * dt_s)
    assert moved_m <= most_mps * dt_s + ROUNDING_M
    assert math.hypot(*after.velocity_enu_mps[:2]) <= most_mps + ROUNDING_M
    climbed_m = abs(after.position_enu_m[2] - before.position_enu_m[2])
    most_mps = max(envelope.climb_mps, abs(before.velocity_enu_mps[2]))
    assert climbed_m <= most_mps * dt_s + ROUNDING_M
    outs = [out_m(guard, position) for position in (before.position_enu_m, vehicle)]
    assert out_m(guard, after.position_enu_m) <= max(outs) + ROUNDING_M


def assert_within_envelope(guard: Guard, before: Guarded, after: Guarded, tick: Tick) -> None:
    envelope, dt_s = guard.limits.envelope, min(max(tick.dt_s, 0.0), MAX_TICK_S)
    speed_mps = math.hypot(*after.velocity_enu_mps[:2])
    was_mps = math.hypot(*before.velocity_enu_mps[:2])
    assert speed_mps <= envelope.speed_mps + ROUNDING_M
    assert speed_mps <= max(tick.cap_mps, was_mps) + ROUNDING_M
    moved_m = math.dist(before.position_enu_m[:2], after.position_enu_m[:2])
    assert math.isclose(moved_m, speed_mps * dt_s, abs_tol=ROUNDING_M)
    climbed_m = after.position_enu_m[2] - before.position_enu_m[2]
    assert math.isclose(climbed_m, after.velocity_enu_mps[2] * dt_s, abs_tol=ROUNDING_M)
    assert abs(after.velocity_enu_mps[2]) <= envelope.climb_mps + ROUNDING_M
    most_mps = envelope.acceleration_mps2 * dt_s + ROUNDING_M
    if after.velocity_enu_mps[2] != 0.0:
        assert abs(after.velocity_enu_mps[2] - before.velocity_enu_mps[2]) <= most_mps
    if after.velocity_enu_mps[:2] != (0.0, 0.0):
        change = math.dist(before.velocity_enu_mps[:2], after.velocity_enu_mps[:2])
        assert change <= most_mps


def assert_is_near_enough(
    guard: Guard, before: Guarded, after: Guarded, tick: Tick, motion: Motion
) -> None:
    """No farther from home than leash and battery allow, or than it was and can turn.

    It turns from its velocity straight to the wanted one, so braking and turning share the
    acceleration: what is left of the old direction lasts for |change of velocity| / a.
    """
    limits, home = guard.limits, motion.home_enu_m[:2]
    reach_m = limits.distance_home_m
    if limits.reserve is not None:
        charge_pct = 0.0 if motion.battery_pct is None else motion.battery_pct
        reach_m = min(reach_m, max(0.0, charge_pct - 20.0) / 500.0 * 1000.0)
    was_mps = math.hypot(*before.velocity_enu_mps[:2])
    change_mps = was_mps + min(limits.envelope.speed_mps, tick.cap_mps)
    turning_m = was_mps * change_mps / (2.0 * limits.envelope.acceleration_mps2)
    most_m = max(reach_m, math.dist(before.position_enu_m[:2], home)) + turning_m
    assert math.dist(after.position_enu_m[:2], home) <= most_m + ROUNDING_M


@settings(max_examples=200, deadline=None)
@given(guards(), st.tuples(near, near, near), st.lists(ticks, min_size=1, max_size=12))
def test_every_setpoint_may_be_the_last(
    guard: Guard, position: Position, flown: list[Tick]
) -> None:
    fence = guard.limits.fence
    assert fence is not None
    oracle = Oracle(fence)
    home = (0.0, 0.0, HOME_UP_M)
    low_m, high_m = (HOME_UP_M + height_m for height_m in guard.limits.altitude_m)
    before = guard.here(Motion(position, (0.0, 0.0, 0.0), home))
    for tick in flown:
        east, north = (
            was + tick.follows * (to - was) + drift
            for was, to, drift in zip(position, before.position_enu_m, tick.drift_m, strict=False)
        )
        position = (east, north, position[2])
        motion = Motion(position, tick.velocity_enu_mps, home, tick.battery_pct)
        after = guard.towards(tick.goal_enu_m, before, motion, tick.dt_s, tick.cap_mps)
        if after.position_enu_m[:2] not in (before.position_enu_m[:2], position[:2]):
            is_inside = oracle.clearance_m(after.position_enu_m[:2]) >= fence.margin_m - ROUNDING_M
            out = out_m(guard, after.position_enu_m)
            assert is_inside or out <= out_m(guard, position) + ROUNDING_M
        assert low_m - ROUNDING_M <= after.position_enu_m[2] <= high_m + ROUNDING_M
        comes_in = bool(set(after.reasons) & set(WAY_IN))
        is_restart = after.position_enu_m == guard.here(motion).position_enu_m
        if comes_in and not is_restart:
            assert_comes_in(guard, before, after, tick, position)
        elif not (is_restart and set(after.reasons) & set(ANEW)):
            assert_within_envelope(guard, before, after, tick)
            assert_is_near_enough(guard, before, after, tick, motion)
        if after.velocity_enu_mps[:2] != (0.0, 0.0) and tick.dt_s > 0.0 and not comes_in:
            assert_may_be_last(guard, oracle, after, motion)
        if not all(math.isfinite(v) for v in tick.goal_enu_m):
            assert after == Guarded(before.position_enu_m, (GuardReason.NOT_FINITE,))
        before = after


@settings(max_examples=100, deadline=None)
@given(guards(), st.tuples(near, near, near), st.tuples(near, near, near))
def test_a_setpoint_from_elsewhere_comes_inside_and_stays(
    guard: Guard, previous: Position, goal: Position
) -> None:
    """One that the guard did not make may be anywhere; it comes in, standing for a tick at most."""
    last, outs = Guarded(previous), [out_m(guard, previous)]
    assert guard.limits.fence is not None
    for _ in range(40):
        motion = Motion(last.position_enu_m, last.velocity_enu_mps, (0.0, 0.0, HOME_UP_M))
        last = guard.towards(goal, last, motion, 0.1)
        outs.append(out_m(guard, last.position_enu_m))
    for before, after in pairwise(outs):
        assert after <= before + ROUNDING_M
    for before, after in pairwise(outs[::2]):
        assert after < before or guard.limits.fence.allows(last.position_enu_m[:2])


@settings(max_examples=60, deadline=None)
@given(guards(), st.tuples(near, near, st.floats(60.0, 100.0)), st.data())
def test_a_goal_with_a_free_straight_way_is_reached(
    guard: Guard, goal: Position, data: st.DataObject
) -> None:
    """Safe is not enough: a vehicle that follows gets there, and nothing stops it on the way."""
    fence = guard.limits.fence
    assert fence is not None
    start = fence.nearest_allowed(data.draw(st.tuples(near, near)))
    inside = fence.nearest_allowed(goal[:2])
    if not fence.space.is_clear(start, inside) or guard.limits.reserve is not None:
        return
    goal, last = (*inside, goal[2]), Guarded((*start, goal[2]))
    home = (*inside, HOME_UP_M)
    for _ in range(60_000):
        motion = Motion(last.position_enu_m, last.velocity_enu_mps, home)
        last = guard.towards(goal, last, motion, 0.2)
        assert set(last.reasons) <= {GuardReason.LAGGING}
        if math.dist(last.position_enu_m, goal) < 0.01:
            break
    assert math.dist(last.position_enu_m, goal) < 0.01
