"""The guard's way back inside, for a vehicle in a keep-out, outside, or out of the band."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from companion.guard.gate import AT_REST, Guard, Guarded, GuardReason, Motion, Position
from companion.guard.limits import Fence
from tests.unit.companion.guard.gate_helpers import (
    GUARD,
    HIGH_M,
    HOME,
    LIMITS,
    LOW_M,
    SQUARE,
    motion,
)

HOUSE = ((10.0, -20.0), (20.0, -20.0), (20.0, 20.0), (10.0, 20.0))
HOUSED = Guard(replace(LIMITS, fence=Fence(SQUARE.polygon_enu_m, 5.0, (HOUSE,))))
GOAL = (-50.0, 0.0, 30.0)
DT_S = 0.1
OUT = (110.0, 20.0, 30.0)


def come_in(
    position: Position,
    *,
    guard: Guard = GUARD,
    follow_s: float = 1.0,
    ticks: int = 600,
    drift: Position = AT_REST,
) -> tuple[list[Guarded], list[Position]]:
    """Held, a vehicle that is drawn to its setpoint, lags by this time, and drifts in a wind."""
    vehicles, steps = [position], [guard.here(motion(position))]
    for _ in range(ticks):
        last = vehicles[-1]
        rates = [
            (to - at) / follow_s + blown
            for at, to, blown in zip(last, steps[-1].position_enu_m, drift, strict=True)
        ]
        e, n, u = (at + rate * DT_S for at, rate in zip(last, rates, strict=True))
        vehicles.append((e, n, u))
        now = Motion((e, n, u), (rates[0], rates[1], rates[2]), HOME)
        steps.append(guard.hold(steps[-1], now, DT_S))
    return steps, vehicles


def assert_is_gentle(steps: list[Guarded]) -> None:
    """Assert steps from the vehicle's position within speed, climb and acceleration."""
    for before, after in pairwise(steps):
        assert math.dist(before.position_enu_m[:2], after.position_enu_m[:2]) <= 5.0 * DT_S + 1e-9
        climbed_m = abs(after.position_enu_m[2] - before.position_enu_m[2])
        assert climbed_m <= 2.0 * DT_S + 1e-9
        faster = math.hypot(*after.velocity_enu_mps[:2]) - math.hypot(*before.velocity_enu_mps[:2])
        assert faster <= 2.0 * DT_S + 1e-9


class TestFromOutside:
    @pytest.mark.parametrize("out_m", [-2.9, 0.5, 5.0, 15.0, 50.0, 100.0])
    def test_it_comes_back_however_far_it_is(self, out_m: float) -> None:
        start = (100.0 + out_m, 20.0, 30.0)
        steps, vehicles = come_in(start)
        assert steps[0].position_enu_m == start
        assert_is_gentle(steps)
        for step, vehicle in zip(steps, vehicles, strict=True):
            assert step.position_enu_m[0] <= vehicle[0] + 1e-9
            assert step.position_enu_m[1] == pytest.approx(20.0, abs=1e-6)
        assert vehicles[-1] == pytest.approx((95.0, 20.0, 30.0), abs=0.01)
        assert steps[-1].reasons == ()

    def test_from_a_setpoint_that_is_far_away_it_starts_again_at_the_vehicle(self) -> None:
        step = GUARD.towards(GOAL, Guarded((0.0, 0.0, 30.0)), motion(OUT), DT_S)
        assert step == Guarded(OUT, (GuardReason.OUTSIDE,))

    def test_it_takes_as_long_as_speed_and_acceleration_say(self) -> None:
        """105 m: 21 s at 5 m/s, and 2.5 s to speed up and brake; latency near the border."""
        steps, _ = come_in((200.0, 0.0, 30.0))
        assert steps[210].position_enu_m[0] > 95.1
        assert steps[270].position_enu_m == pytest.approx((95.0, 0.0, 30.0), abs=1e-5)
        assert max(math.hypot(*s.velocity_enu_mps[:2]) for s in steps) == pytest.approx(5.0)
        assert steps[1].velocity_enu_mps == pytest.approx((-0.2, 0.0, 0.0))

    def test_a_plan_changes_nothing_until_it_is_inside(self) -> None:
        for goal in ((500.0, 20.0, 60.0), (0.0, 0.0, 18.0)):
            for cap_mps in (0.0, 3.0, math.inf):
                last = Guarded(OUT, (), (-2.0, 0.0, 0.0))
                guarded = GUARD.towards(goal, last, motion(OUT), DT_S, cap_mps)
                assert guarded.reasons == (GuardReason.OUTSIDE,)
                assert guarded.position_enu_m == pytest.approx((109.78, 20.0, 30.0))
                assert guarded.velocity_enu_mps == pytest.approx((-2.2, 0.0, 0.0))

    def test_within_the_margin_it_is_walked_in_too(self) -> None:
        position = (97.0, 20.0, 30.0)
        guarded = GUARD.towards(GOAL, Guarded(position), motion(position), DT_S)
        assert guarded.reasons == (GuardReason.MARGIN,)
        assert guarded.position_enu_m == pytest.approx((96.98, 20.0, 30.0))

    def test_a_setpoint_that_is_inside_already_stays_and_waits(self) -> None:
        inside = Guarded((95.0, 20.0, 30.0), (), (-1.0, 0.0, 0.0))
        kept = GUARD.towards(GOAL, inside, motion((101.0, 20.0, 30.0)), DT_S)
        assert kept == Guarded(inside.position_enu_m, (GuardReason.OUTSIDE,))

    def test_who_is_almost_there_is_there_with_the_next(self) -> None:
        almost = Guarded((95.1, 20.0, 30.0), (), (-5.0, 0.0, 0.0))
        there = GUARD.towards(GOAL, almost, motion((101.0, 20.0, 30.0)), DT_S)
        assert there.position_enu_m == pytest.approx((95.0, 20.0, 30.0), abs=1e-5)
        assert there.velocity_enu_mps == AT_REST

    @pytest.mark.parametrize(
        ("position", "is_on_it"),
        [
            ((109.0, 20.0), True),
            ((109.9, 21.9), True),
            ((110.0, 21.0), True),
            ((110.0, 22.0), True),
            ((109.9, 22.2), False),
            ((110.1, 20.0), False),
            ((94.5, 20.0), True),
            ((103.0, 24.9), True),
            ((103.0, 26.0), False),
        ],
    )
    def test_only_a_setpoint_on_the_way_is_gone_on_from(
        self, position: tuple[float, float], *, is_on_it: bool
    ) -> None:
        """Never one farther out than the vehicle, nor more than 2 m of a detour."""
        guarded = GUARD.towards(GOAL, Guarded((*position, 30.0)), motion(OUT), DT_S)
        from_vehicle = pytest.approx((109.98, 20.0, 30.0))
        assert (guarded.position_enu_m == from_vehicle) is not is_on_it

    @pytest.mark.parametrize("drift_mps", [0.001, 0.01, 0.1, 0.5, 1.0, 1.5])
    def test_a_wind_from_behind_forbids_no_position(self, drift_mps: float) -> None:
        """It blows the vehicle past a setpoint that has only begun to move."""
        steps, vehicles = come_in((130.0, 20.0, 30.0), drift=(-drift_mps, 0.0, 0.0))
        still, _ = come_in((130.0, 20.0, 30.0))
        assert steps[110].position_enu_m[0] <= still[110].position_enu_m[0] + 0.01
        assert vehicles[110][0] < 97.0
        for step, vehicle in zip(steps, vehicles, strict=True):
            assert step.position_enu_m[0] <= vehicle[0] + 1e-9 or vehicle[0] < 95.0

    @pytest.mark.parametrize("drift_mps", [-1.0, 1.0])
    def test_nor_does_one_that_carries_it_along_the_border(self, drift_mps: float) -> None:
        steps, vehicles = come_in((130.0, 20.0, 30.0), drift=(0.0, 4.0 * drift_mps, 0.0))
        assert vehicles[150][0] < 97.0
        assert abs(vehicles[-1][1] - 20.0) < 40.0
        assert steps[-1].reasons == ()

    def test_who_overtakes_a_setpoint_is_led_on_from_where_it_is_at_the_height_before(self) -> None:
        last = Guarded((110.3, 20.0, 40.0), (), (-2.0, 0.0, 0.0))
        guarded = GUARD.towards(GOAL, last, motion(OUT), DT_S)
        assert guarded.position_enu_m == pytest.approx((109.78, 20.0, 40.0))
        assert guarded.velocity_enu_mps == pytest.approx((-2.2, 0.0, 0.0))
        aside = Guarded((109.9, 22.2, 40.0), (), (-2.0, 0.0, 0.0))
        assert GUARD.towards(GOAL, aside, motion(OUT), DT_S) == guarded
        wrong = Guarded((110.3, 20.0, 40.0), (), (1.0, 0.0, 0.0))
        assert GUARD.towards(GOAL, wrong, motion(OUT), DT_S).position_enu_m == OUT

    def test_nor_one_farther_ahead_than_two_steps(self) -> None:
        vehicle = motion((120.0, 20.0, 30.0))
        near = GUARD.towards(GOAL, Guarded((104.0, 20.0, 30.0)), vehicle, DT_S)
        assert near.position_enu_m[0] <= 104.0
        far = GUARD.towards(GOAL, Guarded((103.9, 20.0, 30.0)), vehicle, DT_S)
        assert far.position_enu_m == (120.0, 20.0, 30.0)

    def test_nor_one_that_a_new_fence_finds_on_its_way_out(self) -> None:
        moving = Guarded(OUT, (), (5.0, 0.0, 0.0))
        anew = GUARD.towards(GOAL, moving, motion((110.5, 20.0, 30.0)), DT_S)
        assert anew == Guarded((110.5, 20.0, 30.0), (GuardReason.OUTSIDE,))

    def test_a_late_tick_is_no_excuse(self) -> None:
        fast = Guarded(OUT, (), (-5.0, 0.0, 0.0))
        guarded = GUARD.towards(GOAL, fast, motion(OUT), 10.0)
        assert guarded.position_enu_m == pytest.approx((109.0, 20.0, 30.0))

    @pytest.mark.parametrize("position", [(12.0, 0.0, 30.0), (18.5, 3.0, 30.0), (15.01, 0.0, 30.0)])
    def test_out_of_a_keep_out_it_goes_the_short_way(self, position: Position) -> None:
        steps, vehicles = come_in(position, guard=HOUSED)
        assert steps[0].position_enu_m == position
        assert_is_gentle(steps)
        end_m = 5.0 if position[0] < 15.0 else 25.0
        assert vehicles[-1] == pytest.approx((end_m, position[1], 30.0), abs=0.01)

    def test_who_shot_through_a_keep_out_is_not_called_back_through_it(self) -> None:
        """It is too fast to stop before the next one, and its setpoint is on the far side."""
        north, south = ((0.0, 10.0), (30.0, 11.0)), ((0.0, -30.0), (30.0, -29.0))
        walls = tuple(((w, s), (e, s), (e, n), (w, n)) for (w, s), (e, n) in (north, south))
        guard = Guard(replace(LIMITS, fence=Fence(SQUARE.polygon_enu_m, 5.0, walls)))
        far, near = (15.0, 11.5, 30.0), (15.0, -2.0, 30.0)
        fast = Motion(near, (0.0, -14.0, 0.0), HOME)
        assert guard.hold(Guarded(far), fast, DT_S) == Guarded(near, (GuardReason.CUT_OFF,))
        aside = (15.0, 1.0, 30.0)
        assert guard.hold(Guarded(aside), fast, DT_S) == Guarded(aside, (GuardReason.TOO_FAST,))


class TestFromAboveOrBelow:
    @pytest.mark.parametrize(("up_m", "end_m"), [(3.0, LOW_M), (99.0, HIGH_M)])
    @pytest.mark.parametrize("east_m", [0.0, 130.0])
    def test_its_first_setpoint_is_in_the_band(
        self, up_m: float, end_m: float, east_m: float
    ) -> None:
        steps, vehicles = come_in((east_m, 0.0, up_m))
        assert {step.position_enu_m[2] for step in steps} == {end_m}
        assert vehicles[-1] == pytest.approx((min(east_m, 95.0), 0.0, end_m), abs=0.01)

    @pytest.mark.parametrize(("up_m", "end_m"), [(3.0, LOW_M), (99.0, HIGH_M)])
    @pytest.mark.parametrize("east_m", [0.0, 130.0])
    def test_one_that_others_made_out_of_it_is_held_into_it_by_the_climb_limits(
        self, up_m: float, end_m: float, east_m: float
    ) -> None:
        last = GUARD.freeze((east_m, 0.0, up_m))
        ups: list[float] = [up_m]
        for _ in range(600):
            last = GUARD.hold(last, motion((east_m, 0.0, up_m)), DT_S)
            ups.append(last.position_enu_m[2])
        assert ups[1] - up_m == pytest.approx(math.copysign(0.02, end_m - up_m))
        assert max(abs(after - before) for before, after in pairwise(ups)) <= 2.0 * DT_S + 1e-9
        outs = [abs(up - end_m) for up in ups]
        assert all(after <= before for before, after in pairwise(outs))
        assert outs[-1] == pytest.approx(0.0, abs=0.01)

    @pytest.mark.parametrize("up_m", [3.0, 99.0])
    def test_hold_stops_over_the_ground_at_once_and_still_climbs_into_the_band(
        self, up_m: float
    ) -> None:
        position = (0.0, 0.0, up_m)
        climb_mps = math.copysign(1.0, HIGH_M - up_m)
        last = Guarded(position, (), (5.0, 0.0, climb_mps))
        held = GUARD.hold(last, motion(position), DT_S)
        assert held.position_enu_m[:2] == position[:2]
        assert held.velocity_enu_mps == pytest.approx((0.0, 0.0, 1.2 * climb_mps))

    def test_in_the_band_a_way_in_stays_at_its_height(self) -> None:
        climbing = Guarded(OUT, (), (0.0, 0.0, 1.0))
        guarded = GUARD.towards((0.0, 0.0, 60.0), climbing, motion(OUT), DT_S)
        assert guarded.velocity_enu_mps[2] == pytest.approx(0.8)
