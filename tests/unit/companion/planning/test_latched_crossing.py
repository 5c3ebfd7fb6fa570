from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, TargetEstimate, WaypointReason
from companion.geometry.polygons import Point
from companion.planning.crossing import (
    LatchedCrossing,
    LatchedCrossingParams,
)
from companion.planning.planner import Plan, PlanRequest
from companion.planning.views import (
    GOLDEN_ANGLE_RAD,
    Latch,
)

PLANNER = LatchedCrossing(LatchedCrossingParams())
SQUARE = ((-50.0, -50.0), (50.0, -50.0), (50.0, 50.0), (-50.0, 50.0))


def target_at(
    position_enu_m: Point = (0.0, 0.0),
    covariance_m2: tuple[tuple[float, float], tuple[float, float]] = ((4.0, 0.0), (0.0, 4.0)),
) -> TargetEstimate:
    return TargetEstimate(
        0.0, EstimateState.SEARCHING, position_enu_m, covariance_m2, 5.0, 0.0, 0.0, 1
    )


def _plan(
    vehicle: Point,
    memory: Latch | None = None,
    target: TargetEstimate | None = None,
    fence: tuple[Point, ...] | None = None,
) -> Plan[Latch | None]:
    return PLANNER.plan(PlanRequest(vehicle, target or target_at(), fence, 3.0), memory)


def latch_of(plan: Plan[Latch | None]) -> Latch:
    assert plan.memory is not None
    return plan.memory


def direction_rad(latch: Latch) -> float:
    return math.atan2(latch.direction[1], latch.direction[0])


def test_the_first_crossing_is_on_the_far_side() -> None:
    plan = _plan((-30.0, 0.0))
    assert plan.waypoint.position_enu_m == pytest.approx((6.0, 0.0))
    assert plan.waypoint.reason is WaypointReason.APPROACH
    assert plan.waypoint.detail == "crossing 1, 6.0 m beyond the estimate"


@pytest.mark.parametrize(
    ("covariance_m2", "overshoot_m"),
    [
        (((4.0, 0.0), (0.0, 1.0)), 6.0),
        (((1.0, 0.0), (0.0, 4.0)), 6.0),
        (((2.5, 1.5), (1.5, 2.5)), 6.0),  # the worst direction, 4 m^2, lies on the diagonal
        (((0.01, 0.0), (0.0, 0.01)), 2.0),
        (((0.0, 0.0), (0.0, 0.0)), 2.0),
        (((900.0, 0.0), (0.0, 1.0)), 20.0),
    ],
)
def test_the_overshoot_follows_the_worst_direction_within_limits(
    covariance_m2: tuple[tuple[float, float], tuple[float, float]], overshoot_m: float
) -> None:
    plan = _plan((-30.0, 0.0), target=target_at(covariance_m2=covariance_m2))
    assert plan.waypoint.position_enu_m == pytest.approx((overshoot_m, 0.0))


@pytest.mark.parametrize(("baseline_m", "overshoot_m"), [(0.0, 2.0), (12.0, 12.0), (60.0, 20.0)])
def test_without_bearings_the_overshoot_is_at_least_the_base_line_that_ranges_need(
    baseline_m: float, overshoot_m: float
) -> None:
    sure = target_at(covariance_m2=((0.01, 0.0), (0.0, 0.01)))
    plan = PLANNER.plan(PlanRequest((-30.0, 0.0), sure, baseline_m=baseline_m), None)
    assert plan.waypoint.position_enu_m == pytest.approx((overshoot_m, 0.0))


def test_it_stays_latched_until_the_point_is_reached() -> None:
    latch = latch_of(_plan((-30.0, 0.0)))
    for east in (-20.0, -3.0, 0.0, 3.0, 4.4):
        plan = _plan((east, 0.0), latch, target_at((0.5, 0.5)))
        assert plan.memory is latch
        assert plan.waypoint.position_enu_m == latch.point_enu_m
    reached = latch_of(_plan((4.6, 0.0), latch))
    assert reached.crossings == 1
    assert direction_rad(reached) == pytest.approx(GOLDEN_ANGLE_RAD)


def test_a_shorter_overshoot_ends_a_crossing_that_was_latched_with_a_longer_one() -> None:
    latch = latch_of(_plan((-30.0, 0.0)))
    shrunk = target_at(covariance_m2=((0.1, 0.0), (0.0, 0.1)))
    assert _plan((-3.0, 0.0), latch, shrunk).memory is latch
    assert _plan((1.9, 0.0), latch, shrunk).memory is latch
    turned = latch_of(_plan((2.1, 0.0), latch, shrunk))
    assert turned.crossings == 1
    assert turned.overshoot_m == 2.0
    assert direction_rad(turned) == pytest.approx(GOLDEN_ANGLE_RAD)


@pytest.mark.parametrize(
    ("moved_m", "sigma_m", "aims_anew"),
    [(2.9, 0.1, False), (3.1, 0.1, True), (8.9, 6.0, False), (9.1, 6.0, True)],
)
def test_it_aims_again_when_the_estimate_leaves_the_latch(
    moved_m: float, sigma_m: float, aims_anew: bool
) -> None:
    covariance_m2 = ((sigma_m**2, 0.0), (0.0, sigma_m**2))
    latch = latch_of(_plan((-60.0, 0.0), target=target_at(covariance_m2=covariance_m2)))
    moved = target_at((0.0, moved_m), covariance_m2)
    plan = _plan((-50.0, 0.0), latch, moved)
    assert (plan.memory is not latch) is aims_anew
    if aims_anew:
        assert latch_of(plan).direction == latch.direction
        assert latch_of(plan).crossings == 0
        assert plan.waypoint.position_enu_m == pytest.approx((latch.overshoot_m, moved_m))


def test_approach_becomes_crossing_near_the_estimate_and_stays_so_beyond() -> None:
    latch = latch_of(_plan((-30.0, 0.0)))
    reasons = [_plan((east, 0.0), latch).waypoint.reason for east in (-20.0, -5.0, 1.0, 4.0)]
    assert reasons == [WaypointReason.APPROACH] + 3 * [WaypointReason.CROSSING]


def test_the_golden_angle_covers_all_directions_evenly() -> None:
    """No gap between the directions of n crossings is wider than the golden angle promises."""
    directions, memory, vehicle = [], None, (-30.0, 0.0)
    for _ in range(55):
        latch = latch_of(_plan(vehicle, memory))
        directions.append(direction_rad(latch) % (2.0 * math.pi))
        memory, vehicle = latch, latch.point_enu_m
    for count in (8, 21, 55):
        turned = sorted(directions[:count])
        gaps = [
            b - a for a, b in zip(turned, [*turned[1:], turned[0] + 2.0 * math.pi], strict=True)
        ]
        assert max(gaps) < 2.0 * (2.0 * math.pi / count)


@settings(deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(25.0, 200.0))
def test_flown_in_steps_it_really_crosses_to_the_far_side(
    from_rad: float, distance_m: float
) -> None:
    vehicle = (distance_m * math.cos(from_rad), distance_m * math.sin(from_rad))
    outward = (math.cos(from_rad), math.sin(from_rad))
    memory: Latch | None = None
    farthest_m = math.inf
    for _ in range(400):
        plan = _plan(vehicle, memory)
        memory = latch_of(plan)
        if memory.crossings:
            break
        aim = plan.waypoint.position_enu_m
        share = min(1.0, 1.0 / math.dist(vehicle, aim))
        vehicle = (
            vehicle[0] + share * (aim[0] - vehicle[0]),
            vehicle[1] + share * (aim[1] - vehicle[1]),
        )
        farthest_m = min(farthest_m, vehicle[0] * outward[0] + vehicle[1] * outward[1])
    assert memory is not None
    assert memory.crossings == 1
    assert farthest_m <= -(6.0 - PLANNER.params.arrival_radius_m)


def test_a_direction_that_the_fence_cuts_short_is_turned_on() -> None:
    """The target sits at the east fence: the far side is outside, another direction is not."""
    plan = _plan((0.0, 0.0), target=target_at((46.0, 0.0)), fence=SQUARE)
    latch = latch_of(plan)
    assert latch.direction != pytest.approx((1.0, 0.0))
    assert math.dist(plan.waypoint.position_enu_m, (46.0, 0.0)) >= 0.9 * latch.overshoot_m


def test_where_the_fence_cuts_everything_the_longest_crossing_is_taken() -> None:
    corridor = ((-50.0, -4.0), (50.0, -4.0), (50.0, 4.0), (-50.0, 4.0))
    wide = target_at((45.0, 0.0), ((100.0, 0.0), (0.0, 100.0)))
    plan = _plan((0.0, 0.0), target=wide, fence=corridor)
    east, north = plan.waypoint.position_enu_m
    assert abs(north) <= 1.0 + 1e-9
    # The fifth direction tried runs nearly along the corridor; east itself leaves only 2 m.
    along_m = 1.0 / abs(math.sin(4.0 * GOLDEN_ANGLE_RAD))
    assert math.dist((45.0, 0.0), (east, north)) == pytest.approx(along_m, abs=1e-4)


def test_a_crossing_that_is_reached_at_once_is_not_flown_forever() -> None:
    """A target outside the fence, with the vehicle already at the nearest allowed point."""
    outside = target_at((80.0, 0.0))
    vehicle, memory, points = (47.0, 0.0), None, set()
    for _ in range(12):
        plan = _plan(vehicle, memory, outside, SQUARE)
        memory = latch_of(plan)
        points.add(plan.waypoint.position_enu_m)
        vehicle = plan.waypoint.position_enu_m
    assert len(points) > 3
    assert memory is not None
    assert memory.crossings > 3


def test_an_empty_band_of_overshoots_is_refused() -> None:
    with pytest.raises(ValueError, match="overshoot_min_m"):
        LatchedCrossingParams(overshoot_min_m=5.0, overshoot_max_m=4.0)


def test_without_an_estimate_it_holds_and_forgets() -> None:
    plan = PLANNER.plan(PlanRequest((3.0, 4.0)), latch_of(_plan((-30.0, 0.0))))
    assert plan.waypoint.position_enu_m == (3.0, 4.0)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.memory is None


def test_crossings_are_flown_above_and_below_by_turns() -> None:
    swinging = LatchedCrossing(LatchedCrossingParams(altitude_swing_m=4.0))
    offsets, memory, vehicle = [], None, (-30.0, 0.0)
    for _ in range(4):
        plan = swinging.plan(PlanRequest(vehicle, target_at()), memory)
        offsets.append(plan.waypoint.altitude_offset_m)
        memory, vehicle = plan.memory, plan.waypoint.position_enu_m
    assert offsets == [4.0, -4.0, 4.0, -4.0]
    assert _plan((-30.0, 0.0)).waypoint.altitude_offset_m == 0.0


@pytest.mark.parametrize(("offset_m", "crossings"), [(1.9, 0), (2.1, 1), (4.0, 1), (None, 1)])
def test_a_crossing_ends_at_its_height(offset_m: float | None, crossings: int) -> None:
    swinging = LatchedCrossing(LatchedCrossingParams(altitude_swing_m=4.0))
    latch = swinging.plan(PlanRequest((-30.0, 0.0), target_at()), None).memory
    there = PlanRequest((6.0, 0.0), target_at(), altitude_offset_m=offset_m)
    assert latch_of(swinging.plan(there, latch)).crossings == crossings
    level = latch_of(PLANNER.plan(there, latch))
    assert level.crossings == 1


HOUSE = ((-4.0, -15.0), (20.0, -15.0), (20.0, 15.0), (-4.0, 15.0))


def _around_the_house(steps: int) -> tuple[list[Point], Latch]:
    """Flies about a target inside a keep-out, near its west wall, a metre at a time."""
    vehicle, memory, positions = (-40.0, 0.0), None, []
    sure = target_at(covariance_m2=((0.1, 0.0), (0.0, 0.1)))
    for _ in range(steps):
        request = PlanRequest(vehicle, sure, fence_margin_m=2.0, keep_out_enu_m=(HOUSE,))
        plan = PLANNER.plan(request, memory)
        memory, aim = plan.memory, plan.waypoint.position_enu_m
        share = min(1.0, 1.0 / math.dist(vehicle, aim)) if vehicle != aim else 1.0
        vehicle = (
            vehicle[0] + share * (aim[0] - vehicle[0]),
            vehicle[1] + share * (aim[1] - vehicle[1]),
        )
        positions.append(vehicle)
    assert memory is not None
    return positions, memory


def test_a_target_in_a_keep_out_is_seen_from_all_sides() -> None:
    """Nearest to every overshoot of 2 m is the west wall; it goes to the far side all the same."""
    positions, latch = _around_the_house(600)
    assert latch.crossings > 4
    for side in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
        assert max(e * side[0] + n * side[1] for e, n in positions) > 5.5
    assert max(e for e, _ in positions) > 21.0


def test_a_point_pushed_beyond_a_keep_out_is_flown_to() -> None:
    _, latch = _around_the_house(1)
    assert latch.point_enu_m == pytest.approx((22.0, 0.0), abs=1e-5)
    assert latch.pushed_m == pytest.approx(22.0, abs=1e-5)
    beside = PlanRequest(
        (3.0, -17.5), target_at(covariance_m2=((0.1, 0.0), (0.0, 0.1))), keep_out_enu_m=(HOUSE,)
    )
    assert PLANNER.plan(beside, latch).memory is latch  # 3 m behind the target is not yet there


def test_where_there_is_no_way_to_any_side_it_holds() -> None:
    moat = ((-2.0, -60.0), (2.0, -60.0), (2.0, 60.0), (-2.0, 60.0))
    request = PlanRequest((-30.0, 0.0), target_at((40.0, 0.0)), SQUARE, 3.0, keep_out_enu_m=(moat,))
    plan = PLANNER.plan(request, None)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.waypoint.detail == "no path to any side of the estimate"
    assert plan.memory is None
