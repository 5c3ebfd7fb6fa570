from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.domain import WaypointReason
from companion.planning.crossing import (
    BEND_RAD,
    LatchedCrossing,
    LatchedCrossingParams,
    SensorGeometry,
)
from companion.planning.planner import PlanRequest
from companion.planning.views import (
    GOLDEN_ANGLE_RAD,
    Antenna,
    best_reach_m,
    direction,
    leg_over,
)
from tests.unit.companion.planning.test_latched_crossing import (
    PLANNER,
    direction_rad,
    latch_of,
    target_at,
)

LEVEL = Antenna((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), 1, True, math.pi)
NONE = LEVEL._replace(rows=0)
SURE = ((0.01, 0.0), (0.0, 0.01))


def _sighted(antenna: Antenna = LEVEL, *, descend: bool = False, is_configured: bool = True) -> Any:
    sensor = SensorGeometry(
        antenna, 5.0, 2.5, lowest_m=6.0, room_m=14.0, is_height_configured=is_configured
    )
    return LatchedCrossing(LatchedCrossingParams(descend=descend), sensor)


def _seen(**changes: Any) -> PlanRequest:
    """A sure target 20 m below, by bearings alone."""
    request = PlanRequest(
        (-30.0, 0.0),
        target_at(covariance_m2=SURE),
        height_m=20.0,
        altitude_offset_m=0.0,
        sigmas=(math.inf, 0.05, math.inf),
    )
    return replace(request, **changes)


def test_an_array_is_crossed_as_wide_as_its_height_wants() -> None:
    wide = latch_of(_sighted().plan(_seen(), None)).overshoot_m
    low = latch_of(_sighted().plan(_seen(height_m=6.0), None)).overshoot_m
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
    overshoot_m = latch_of(planner.plan(seen, None)).overshoot_m
    assert overshoot_m == pytest.approx(best_reach_m(leg, 2.0, 80.0))
    assert 40.0 < overshoot_m < 60.0


def test_an_overshoot_is_never_shorter_than_what_both_sides_need() -> None:
    doubtful = _seen(height_m=2.0, estimate=target_at(covariance_m2=((25.0, 0.0), (0.0, 1.0))))
    assert latch_of(_sighted().plan(doubtful, None)).overshoot_m >= 15.0


@pytest.mark.parametrize(
    ("planner", "changes"),
    [
        (_sighted(NONE), {}),  # an azimuth is as good at any height
        (_sighted(NONE, descend=True), {}),
        (
            _sighted(NONE, is_configured=False),
            {"baseline_m": 20.0},
        ),  # ranges to a target in the plane
        (_sighted(), {"sigmas": None}),
    ],
)
def test_without_array_or_configured_height_it_is_the_planner_of_the_paper(
    planner: Any, changes: dict[str, Any]
) -> None:
    request = _seen(**changes)
    assert planner.plan(request, None) == PLANNER.plan(request, None)


def test_ranges_alone_to_a_configured_height_are_crossed_widely_and_turned_otherwise() -> None:
    planner, ranges = _sighted(NONE), _seen(baseline_m=20.0, sigmas=(1.0, math.inf, math.inf))
    first = planner.plan(ranges, None)
    assert latch_of(first).overshoot_m == pytest.approx(20.0)
    there = replace(ranges, vehicle_enu_m=first.waypoint.position_enu_m)
    second = latch_of(planner.plan(there, first.memory))
    assert direction_rad(second) == pytest.approx(GOLDEN_ANGLE_RAD)


def test_a_turn_begins_where_braking_would() -> None:
    latch = latch_of(_sighted().plan(_seen(), None))
    near = (latch.point_enu_m[0] - 4.5, 0.0)
    assert latch_of(_sighted().plan(_seen(vehicle_enu_m=near), latch)).crossings == 1
    level = _seen(vehicle_enu_m=near, estimate=target_at())
    assert latch_of(PLANNER.plan(level, latch)).crossings == 1
    assert latch_of(_sighted().plan(_seen(vehicle_enu_m=(0.0, 0.0)), latch)).crossings == 0


def test_a_lower_pass_is_flown_where_it_pays_and_kept() -> None:
    planner = _sighted(descend=True)
    first = planner.plan(_seen(), None)
    assert (first.waypoint.altitude_offset_m, first.waypoint.descent_m) == (-14.0, 14.0)
    low = _seen(vehicle_enu_m=first.waypoint.position_enu_m, height_m=6.0, altitude_offset_m=-14.0)
    second = planner.plan(low, first.memory)
    assert latch_of(second).crossings == 1
    assert second.waypoint.descent_m == 14.0
    assert latch_of(second).overshoot_m < latch_of(_sighted().plan(_seen(), None)).overshoot_m


@pytest.mark.parametrize(
    ("changes", "descent_m"),
    [
        ({"altitude_offset_m": None}, 0.0),
        ({"estimate": target_at(covariance_m2=((50.0, 0.0), (0.0, 1.0)))}, 0.0),  # still in doubt
        ({"height_m": 13.0}, 7.0),  # of a target up a slope: as high above it as above home
        ({"height_m": 6.5}, 0.0),
        ({"estimate": replace(target_at(covariance_m2=SURE), height_sigma_m=3.0)}, 8.0),
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
    lost = target_at((40.0, 0.0), ((400.0, 0.0), (0.0, 400.0)))
    assert planner.plan(_seen(estimate=lost), first.memory).waypoint.descent_m == 0.0


FAR: dict[str, Any] = {"vehicle_enu_m": (-60.0, 0.0), "estimate": target_at()}
RANGED = (0.3, 0.05, math.inf)


def test_a_far_target_is_approached_in_a_spiral_that_turns_the_line_of_sight() -> None:
    """tan(bend) log(distance / distance then); each leg a metre, as setpoints move on."""
    planner, position = _sighted(), (-60.0, 0.0)
    for _ in range(40):
        plan = planner.plan(_seen(**FAR | {"vehicle_enu_m": position}, sigmas=RANGED), None)
        assert plan.waypoint.reason is WaypointReason.APPROACH
        assert plan.memory is None
        ahead = direction(position, plan.waypoint.position_enu_m)
        position = (position[0] + ahead[0], position[1] + ahead[1])
    seen_rad = math.atan2(-position[1], -position[0])
    turned_rad = math.tan(BEND_RAD) * math.log(60.0 / math.hypot(*position))
    assert math.hypot(*position) == pytest.approx(60.0 - 40.0 * math.cos(BEND_RAD), abs=0.5)
    assert abs(seen_rad) == pytest.approx(turned_rad, abs=0.02)


@pytest.mark.parametrize(
    "changes",
    [
        {"vehicle_enu_m": (-12.0, 0.0)},  # near: it is crossed
        {"estimate": target_at(covariance_m2=SURE)},
        {"sigmas": (math.inf, 0.05, math.inf)},  # directions alone
        {"fence_enu_m": ((-70.0, -4.0), (70.0, -4.0), (70.0, 4.0), (-70.0, 4.0))},  # no room
    ],
)
def test_otherwise_it_is_straight(changes: dict[str, Any]) -> None:
    plan = _sighted().plan(_seen(**{**FAR, "sigmas": RANGED, **changes}), None)
    assert latch_of(plan).estimate_enu_m == (0.0, 0.0)
    assert plan.waypoint.position_enu_m[1] == pytest.approx(0.0)


def test_a_spiral_keeps_the_target_in_view() -> None:
    narrow = LEVEL._replace(half_view_rad=math.radians(35.0))
    plan = _sighted(narrow).plan(_seen(**FAR, sigmas=RANGED), None)
    east, north = direction((-60.0, 0.0), plan.waypoint.position_enu_m)
    assert abs(math.degrees(math.atan2(north, east))) == pytest.approx(30.0)


def test_after_the_first_crossing_nothing_is_bent() -> None:
    flown = latch_of(_sighted().plan(_seen(**FAR | {"sigmas": (math.inf, 0.05, math.inf)}), None))
    request = _seen(**FAR, sigmas=RANGED)
    assert _sighted().plan(request, flown._replace(crossings=1)).memory is not None
    assert _sighted().plan(request, flown).memory is None


def test_descend_and_swing_are_two_wishes_for_one_height() -> None:
    with pytest.raises(ValueError, match="exclude each other"):
        LatchedCrossingParams(descend=True, altitude_swing_m=2.0)
