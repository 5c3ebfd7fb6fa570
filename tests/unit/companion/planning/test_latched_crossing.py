from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.domain import EstimateState, TargetEstimate, WaypointReason
from companion.geometry.polygons import Point
from companion.planning.crossing import (
    BEND_RAD,
    LatchedCrossing,
    LatchedCrossingParams,
    SensorGeometry,
)
from companion.planning.planner import Plan, PlanRequest
from companion.planning.views import (
    GOLDEN_ANGLE_RAD,
    Antenna,
    Latch,
    best_reach_m,
    direction,
    leg_over,
)

PLANNER = LatchedCrossing(LatchedCrossingParams())
SQUARE = ((-50.0, -50.0), (50.0, -50.0), (50.0, 50.0), (-50.0, 50.0))


def _target(
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
    return PLANNER.plan(PlanRequest(vehicle, target or _target(), fence, 3.0), memory)


def _latch(plan: Plan[Latch | None]) -> Latch:
    assert plan.memory is not None
    return plan.memory


def _direction_rad(latch: Latch) -> float:
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
    plan = _plan((-30.0, 0.0), target=_target(covariance_m2=covariance_m2))
    assert plan.waypoint.position_enu_m == pytest.approx((overshoot_m, 0.0))


@pytest.mark.parametrize(("baseline_m", "overshoot_m"), [(0.0, 2.0), (12.0, 12.0), (60.0, 20.0)])
def test_without_bearings_the_overshoot_is_at_least_the_base_line_that_ranges_need(
    baseline_m: float, overshoot_m: float
) -> None:
    sure = _target(covariance_m2=((0.01, 0.0), (0.0, 0.01)))
    plan = PLANNER.plan(PlanRequest((-30.0, 0.0), sure, baseline_m=baseline_m), None)
    assert plan.waypoint.position_enu_m == pytest.approx((overshoot_m, 0.0))


def test_it_stays_latched_until_the_point_is_reached() -> None:
    latch = _latch(_plan((-30.0, 0.0)))
    for east in (-20.0, -3.0, 0.0, 3.0, 4.4):
        plan = _plan((east, 0.0), latch, _target((0.5, 0.5)))
        assert plan.memory is latch
        assert plan.waypoint.position_enu_m == latch.point_enu_m
    reached = _latch(_plan((4.6, 0.0), latch))
    assert reached.crossings == 1
    assert _direction_rad(reached) == pytest.approx(GOLDEN_ANGLE_RAD)


def test_a_shorter_overshoot_ends_a_crossing_that_was_latched_with_a_longer_one() -> None:
    latch = _latch(_plan((-30.0, 0.0)))
    shrunk = _target(covariance_m2=((0.1, 0.0), (0.0, 0.1)))
    assert _plan((-3.0, 0.0), latch, shrunk).memory is latch
    assert _plan((1.9, 0.0), latch, shrunk).memory is latch
    turned = _latch(_plan((2.1, 0.0), latch, shrunk))
    assert turned.crossings == 1
    assert turned.overshoot_m == 2.0
    assert _direction_rad(turned) == pytest.approx(GOLDEN_ANGLE_RAD)


@pytest.mark.parametrize(
    ("moved_m", "sigma_m", "aims_anew"),
    [(2.9, 0.1, False), (3.1, 0.1, True), (8.9, 6.0, False), (9.1, 6.0, True)],
)
def test_it_aims_anew_when_the_estimate_leaves_the_latch(
    moved_m: float, sigma_m: float, aims_anew: bool
) -> None:
    covariance_m2 = ((sigma_m**2, 0.0), (0.0, sigma_m**2))
    latch = _latch(_plan((-60.0, 0.0), target=_target(covariance_m2=covariance_m2)))
    moved = _target((0.0, moved_m), covariance_m2)
    plan = _plan((-50.0, 0.0), latch, moved)
    assert (plan.memory is not latch) is aims_anew
    if aims_anew:
        assert _latch(plan).direction == latch.direction
        assert _latch(plan).crossings == 0
        assert plan.waypoint.position_enu_m == pytest.approx((latch.overshoot_m, moved_m))


def test_approach_becomes_crossing_near_the_estimate_and_stays_so_beyond() -> None:
    latch = _latch(_plan((-30.0, 0.0)))
    reasons = [_plan((east, 0.0), latch).waypoint.reason for east in (-20.0, -5.0, 1.0, 4.0)]
    assert reasons == [WaypointReason.APPROACH] + 3 * [WaypointReason.CROSSING]


def test_the_golden_angle_covers_all_directions_evenly() -> None:
    """No gap between the directions of n crossings is wider than the golden angle promises."""
    directions, memory, vehicle = [], None, (-30.0, 0.0)
    for _ in range(55):
        latch = _latch(_plan(vehicle, memory))
        directions.append(_direction_rad(latch) % (2.0 * math.pi))
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
        memory = _latch(plan)
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
    plan = _plan((0.0, 0.0), target=_target((46.0, 0.0)), fence=SQUARE)
    latch = _latch(plan)
    assert latch.direction != pytest.approx((1.0, 0.0))
    assert math.dist(plan.waypoint.position_enu_m, (46.0, 0.0)) >= 0.9 * latch.overshoot_m


def test_where_the_fence_cuts_everything_the_longest_crossing_is_taken() -> None:
    corridor = ((-50.0, -4.0), (50.0, -4.0), (50.0, 4.0), (-50.0, 4.0))
    wide = _target((45.0, 0.0), ((100.0, 0.0), (0.0, 100.0)))
    plan = _plan((0.0, 0.0), target=wide, fence=corridor)
    east, north = plan.waypoint.position_enu_m
    assert abs(north) <= 1.0 + 1e-9
    # The fifth direction tried runs nearly along the corridor; east itself leaves only 2 m.
    along_m = 1.0 / abs(math.sin(4.0 * GOLDEN_ANGLE_RAD))
    assert math.dist((45.0, 0.0), (east, north)) == pytest.approx(along_m, abs=1e-4)


def test_a_crossing_that_is_reached_at_once_is_not_flown_forever() -> None:
    """A target outside the fence, with the vehicle already at the nearest allowed point."""
    outside = _target((80.0, 0.0))
    vehicle, memory, points = (47.0, 0.0), None, set()
    for _ in range(12):
        plan = _plan(vehicle, memory, outside, SQUARE)
        memory = _latch(plan)
        points.add(plan.waypoint.position_enu_m)
        vehicle = plan.waypoint.position_enu_m
    assert len(points) > 3
    assert memory is not None
    assert memory.crossings > 3


def test_an_empty_band_of_overshoots_is_refused() -> None:
    with pytest.raises(ValueError, match="overshoot_min_m"):
        LatchedCrossingParams(overshoot_min_m=5.0, overshoot_max_m=4.0)


def test_without_an_estimate_it_holds_and_forgets() -> None:
    plan = PLANNER.plan(PlanRequest((3.0, 4.0)), _latch(_plan((-30.0, 0.0))))
    assert plan.waypoint.position_enu_m == (3.0, 4.0)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.memory is None


def test_crossings_are_flown_above_and_below_by_turns() -> None:
    swinging = LatchedCrossing(LatchedCrossingParams(altitude_swing_m=4.0))
    offsets, memory, vehicle = [], None, (-30.0, 0.0)
    for _ in range(4):
        plan = swinging.plan(PlanRequest(vehicle, _target()), memory)
        offsets.append(plan.waypoint.altitude_offset_m)
        memory, vehicle = plan.memory, plan.waypoint.position_enu_m
    assert offsets == [4.0, -4.0, 4.0, -4.0]
    assert _plan((-30.0, 0.0)).waypoint.altitude_offset_m == 0.0


@pytest.mark.parametrize(("offset_m", "crossings"), [(1.9, 0), (2.1, 1), (4.0, 1), (None, 1)])
def test_a_crossing_ends_at_its_height(offset_m: float | None, crossings: int) -> None:
    swinging = LatchedCrossing(LatchedCrossingParams(altitude_swing_m=4.0))
    latch = swinging.plan(PlanRequest((-30.0, 0.0), _target()), None).memory
    there = PlanRequest((6.0, 0.0), _target(), altitude_offset_m=offset_m)
    assert _latch(swinging.plan(there, latch)).crossings == crossings
    level = _latch(PLANNER.plan(there, latch))
    assert level.crossings == 1


HOUSE = ((-4.0, -15.0), (20.0, -15.0), (20.0, 15.0), (-4.0, 15.0))


def _around_the_house(steps: int) -> tuple[list[Point], Latch]:
    """Flies about a target inside a keep-out, near its west wall, a metre at a time."""
    vehicle, memory, places = (-40.0, 0.0), None, []
    sure = _target(covariance_m2=((0.1, 0.0), (0.0, 0.1)))
    for _ in range(steps):
        request = PlanRequest(vehicle, sure, fence_margin_m=2.0, keep_out_enu_m=(HOUSE,))
        plan = PLANNER.plan(request, memory)
        memory, aim = plan.memory, plan.waypoint.position_enu_m
        share = min(1.0, 1.0 / math.dist(vehicle, aim)) if vehicle != aim else 1.0
        vehicle = (
            vehicle[0] + share * (aim[0] - vehicle[0]),
            vehicle[1] + share * (aim[1] - vehicle[1]),
        )
        places.append(vehicle)
    assert memory is not None
    return places, memory


def test_a_target_in_a_keep_out_is_seen_from_all_sides() -> None:
    """Nearest to every overshoot of 2 m is the west wall; it goes to the far side all the same."""
    places, latch = _around_the_house(600)
    assert latch.crossings > 4
    for side in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
        assert max(e * side[0] + n * side[1] for e, n in places) > 5.5
    assert max(e for e, _ in places) > 21.0


def test_a_point_pushed_beyond_a_keep_out_is_flown_to() -> None:
    _, latch = _around_the_house(1)
    assert latch.point_enu_m == pytest.approx((22.0, 0.0), abs=1e-5)
    assert latch.pushed_m == pytest.approx(22.0, abs=1e-5)
    beside = PlanRequest(
        (3.0, -17.5), _target(covariance_m2=((0.1, 0.0), (0.0, 0.1))), keep_out_enu_m=(HOUSE,)
    )
    assert PLANNER.plan(beside, latch).memory is latch  # 3 m behind the target is not yet there


def test_where_there_is_no_way_to_any_side_it_holds() -> None:
    moat = ((-2.0, -60.0), (2.0, -60.0), (2.0, 60.0), (-2.0, 60.0))
    request = PlanRequest((-30.0, 0.0), _target((40.0, 0.0)), SQUARE, 3.0, keep_out_enu_m=(moat,))
    plan = PLANNER.plan(request, None)
    assert plan.waypoint.reason is WaypointReason.HOLD
    assert plan.waypoint.detail == "no way to any side of the estimate"
    assert plan.memory is None


LEVEL = Antenna((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), 1, True, math.pi)
NONE = LEVEL._replace(rows=0)
SURE = ((0.01, 0.0), (0.0, 0.01))


def _sighted(antenna: Antenna = LEVEL, *, descend: bool = False, told: bool = True) -> Any:
    sensor = SensorGeometry(antenna, 5.0, 2.5, lowest_m=6.0, room_m=14.0, is_height_configured=told)
    return LatchedCrossing(LatchedCrossingParams(descend=descend), sensor)


def _seen(**changes: Any) -> PlanRequest:
    """A sure target 20 m below, by bearings alone."""
    request = PlanRequest(
        (-30.0, 0.0),
        _target(covariance_m2=SURE),
        height_m=20.0,
        altitude_offset_m=0.0,
        sigmas=(math.inf, 0.05, math.inf),
    )
    return replace(request, **changes)


def test_an_array_is_crossed_as_wide_as_its_height_wants() -> None:
    wide = _latch(_sighted().plan(_seen(), None)).overshoot_m
    low = _latch(_sighted().plan(_seen(height_m=6.0), None)).overshoot_m
    leg = leg_over(20.0, 10.0, (math.inf, 0.05, math.inf), LEVEL, 0.0)
    assert wide == pytest.approx(best_reach_m(leg, 2.0, 20.0))
    assert 2.0 < low < wide <= 20.0


def test_a_power_is_crossed_as_wide_as_its_height_wants() -> None:
    """Of any height configured, as the power is always that of the slant range."""
    planner = LatchedCrossing(
        LatchedCrossingParams(overshoot_max_m=80.0),
        SensorGeometry(NONE, 5.0, 2.5, lowest_m=6.0, room_m=14.0, is_height_configured=False),
    )
    seen = _seen(sigmas=(math.inf, 0.05, 0.6), baseline_m=20.0)
    leg = leg_over(20.0, 10.0, (math.inf, 0.05, 0.6), NONE, 0.0)
    overshoot_m = _latch(planner.plan(seen, None)).overshoot_m
    assert overshoot_m == pytest.approx(best_reach_m(leg, 2.0, 80.0))
    assert 40.0 < overshoot_m < 60.0


def test_an_overshoot_is_never_shorter_than_what_both_sides_need() -> None:
    doubtful = _seen(height_m=2.0, estimate=_target(covariance_m2=((25.0, 0.0), (0.0, 1.0))))
    assert _latch(_sighted().plan(doubtful, None)).overshoot_m >= 15.0


@pytest.mark.parametrize(
    ("planner", "changes"),
    [
        (_sighted(NONE), {}),  # an azimuth is as good at any height
        (_sighted(NONE, descend=True), {}),
        (_sighted(NONE, told=False), {"baseline_m": 20.0}),  # ranges to a target in the plane
        (_sighted(), {"sigmas": None}),
    ],
)
def test_without_array_or_told_height_it_is_the_planner_of_the_paper(
    planner: Any, changes: dict[str, Any]
) -> None:
    request = _seen(**changes)
    assert planner.plan(request, None) == PLANNER.plan(request, None)


def test_ranges_alone_to_a_told_height_are_crossed_widely_and_turned_in_another_direction() -> None:
    planner, ranges = _sighted(NONE), _seen(baseline_m=20.0, sigmas=(1.0, math.inf, math.inf))
    first = planner.plan(ranges, None)
    assert _latch(first).overshoot_m == pytest.approx(20.0)
    there = replace(ranges, vehicle_enu_m=first.waypoint.position_enu_m)
    second = _latch(planner.plan(there, first.memory))
    assert _direction_rad(second) == pytest.approx(GOLDEN_ANGLE_RAD)


def test_a_turn_begins_where_braking_would() -> None:
    latch = _latch(_sighted().plan(_seen(), None))
    near = (latch.point_enu_m[0] - 4.5, 0.0)
    assert _latch(_sighted().plan(_seen(vehicle_enu_m=near), latch)).crossings == 1
    assert _latch(PLANNER.plan(_seen(vehicle_enu_m=near, estimate=_target()), latch)).crossings == 1
    assert _latch(_sighted().plan(_seen(vehicle_enu_m=(0.0, 0.0)), latch)).crossings == 0


def test_a_lower_pass_is_flown_where_it_pays_and_kept() -> None:
    planner = _sighted(descend=True)
    first = planner.plan(_seen(), None)
    assert (first.waypoint.altitude_offset_m, first.waypoint.descent_m) == (-14.0, 14.0)
    low = _seen(vehicle_enu_m=first.waypoint.position_enu_m, height_m=6.0, altitude_offset_m=-14.0)
    second = planner.plan(low, first.memory)
    assert _latch(second).crossings == 1
    assert second.waypoint.descent_m == 14.0
    assert _latch(second).overshoot_m < _latch(_sighted().plan(_seen(), None)).overshoot_m


@pytest.mark.parametrize(
    ("changes", "descent_m"),
    [
        ({"altitude_offset_m": None}, 0.0),
        ({"estimate": _target(covariance_m2=((50.0, 0.0), (0.0, 1.0)))}, 0.0),  # still in doubt
        ({"height_m": 13.0}, 7.0),  # of a target up a slope: as high above it as above home
        ({"height_m": 6.5}, 0.0),
        ({"estimate": replace(_target(covariance_m2=SURE), height_sigma_m=3.0)}, 8.0),
        ({"height_m": 200.0}, 0.0),  # so high that it does not matter
    ],
)
def test_how_low_a_lower_pass_goes(changes: dict[str, Any], descent_m: float) -> None:
    plan = _sighted(descend=True).plan(_seen(**changes), None)
    assert plan.waypoint.descent_m == pytest.approx(descent_m)
    assert plan.waypoint.altitude_offset_m == pytest.approx(-descent_m)


def test_a_lower_pass_is_given_up_when_the_target_is_lost_again() -> None:
    planner = _sighted(descend=True)
    first = planner.plan(_seen(), None)
    lost = _target((40.0, 0.0), ((400.0, 0.0), (0.0, 400.0)))
    assert planner.plan(_seen(estimate=lost), first.memory).waypoint.descent_m == 0.0


FAR: dict[str, Any] = {"vehicle_enu_m": (-60.0, 0.0), "estimate": _target()}
RANGED = (0.3, 0.05, math.inf)


def test_a_far_target_is_approached_in_a_spiral_that_turns_the_line_of_sight() -> None:
    """tan(bend) log(distance / distance then); each leg a metre, as setpoints move on."""
    planner, place = _sighted(), (-60.0, 0.0)
    for _ in range(40):
        plan = planner.plan(_seen(**FAR | {"vehicle_enu_m": place}, sigmas=RANGED), None)
        assert plan.waypoint.reason is WaypointReason.APPROACH
        assert plan.memory is None
        ahead = direction(place, plan.waypoint.position_enu_m)
        place = (place[0] + ahead[0], place[1] + ahead[1])
    seen_rad = math.atan2(-place[1], -place[0])
    turned_rad = math.tan(BEND_RAD) * math.log(60.0 / math.hypot(*place))
    assert math.hypot(*place) == pytest.approx(60.0 - 40.0 * math.cos(BEND_RAD), abs=0.5)
    assert abs(seen_rad) == pytest.approx(turned_rad, abs=0.02)


@pytest.mark.parametrize(
    "changes",
    [
        {"vehicle_enu_m": (-12.0, 0.0)},  # near: it is crossed
        {"estimate": _target(covariance_m2=SURE)},
        {"sigmas": (math.inf, 0.05, math.inf)},  # directions alone
        {"fence_enu_m": ((-70.0, -4.0), (70.0, -4.0), (70.0, 4.0), (-70.0, 4.0))},  # no room
    ],
)
def test_otherwise_it_is_straight(changes: dict[str, Any]) -> None:
    plan = _sighted().plan(_seen(**{**FAR, "sigmas": RANGED, **changes}), None)
    assert _latch(plan).estimate_enu_m == (0.0, 0.0)
    assert plan.waypoint.position_enu_m[1] == pytest.approx(0.0)


def test_a_spiral_keeps_the_target_in_view() -> None:
    narrow = LEVEL._replace(half_view_rad=math.radians(35.0))
    plan = _sighted(narrow).plan(_seen(**FAR, sigmas=RANGED), None)
    east, north = direction((-60.0, 0.0), plan.waypoint.position_enu_m)
    assert abs(math.degrees(math.atan2(north, east))) == pytest.approx(30.0)


def test_after_the_first_crossing_nothing_is_bent() -> None:
    flown = _latch(_sighted().plan(_seen(**FAR | {"sigmas": (math.inf, 0.05, math.inf)}), None))
    request = _seen(**FAR, sigmas=RANGED)
    assert _sighted().plan(request, flown._replace(crossings=1)).memory is not None
    assert _sighted().plan(request, flown).memory is None


def test_descend_and_swing_are_two_wishes_for_one_height() -> None:
    with pytest.raises(ValueError, match="exclude each other"):
        LatchedCrossingParams(descend=True, altitude_swing_m=2.0)
