"""The guard against everything that a goal, a clock and a vehicle can do, one thing at a time.

What holds for arbitrary sequences of all of it is in tests/property/test_guard_promises.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from companion.guard.gate import Guard, Guarded, GuardReason, Motion
from companion.guard.limits import Fence
from tests.unit.companion.guard.gate_helpers import (
    ENVELOPE,
    GUARD,
    HIGH_M,
    HOME,
    LIMITS,
    LOW_M,
    SQUARE,
    START,
    STOPPING,
    flown,
    motion,
)


class TestTheWayToAGoal:
    def test_a_goal_within_the_limits_is_reached_and_kept(self) -> None:
        steps = flown((30.0, 40.0, 40.0))
        assert all(not step.reasons for step in steps)
        assert steps[-1].position_enu_m == pytest.approx((30.0, 40.0, 40.0), abs=1e-9)
        assert steps[-1].velocity_enu_mps == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)

    def test_it_takes_as_long_as_speed_and_acceleration_say(self) -> None:
        """50 m: 2.5 s to reach 5 m/s, as long to brake, and 7.5 s in between; 10 m up: 6 s."""
        steps = flown((30.0, 40.0, 40.0))
        distances = [math.dist(step.position_enu_m[:2], (30.0, 40.0)) for step in steps]
        assert distances[123] > 0.05
        assert distances[129] < 0.05
        ups = [40.0 - step.position_enu_m[2] for step in steps]
        assert ups[58] > 0.02
        assert ups[64] < 0.02
        speeds = [math.hypot(*step.velocity_enu_mps[:2]) for step in steps]
        assert max(speeds) == pytest.approx(5.0)
        assert max(step.velocity_enu_mps[2] for step in steps) == pytest.approx(2.0)

    def test_it_begins_and_ends_gently(self) -> None:
        steps = flown((30.0, 0.0, 30.0))
        assert steps[1].velocity_enu_mps == pytest.approx((0.2, 0.0, 0.0))
        assert steps[1].position_enu_m == pytest.approx((0.02, 0.0, 30.0))
        assert steps[2].velocity_enu_mps == pytest.approx((0.4, 0.0, 0.0))
        for before, after in pairwise(steps):
            change = math.dist(before.velocity_enu_mps[:2], after.velocity_enu_mps[:2])
            assert change <= 0.2 + 1e-9
        left_m = 30.0 - steps[80].position_enu_m[0]
        assert left_m > 0.0
        assert steps[80].velocity_enu_mps[0] ** 2 <= 4.0 * left_m + 1e-9

    def test_it_turns_no_faster_than_it_accelerates(self) -> None:
        east = Guarded(START, (), (5.0, 0.0, 0.0))
        turned = GUARD.towards((0.0, 50.0, 30.0), east, motion(START), 0.1)
        change = (turned.velocity_enu_mps[0] - 5.0, turned.velocity_enu_mps[1])
        assert math.hypot(*change) == pytest.approx(0.2)
        assert turned.velocity_enu_mps[1] > 0.1

    def test_a_descent_is_braked_like_a_climb(self) -> None:
        steps = flown((0.0, 0.0, 20.0))
        rates = [step.velocity_enu_mps[2] for step in steps]
        assert min(rates) == pytest.approx(-2.0)
        assert rates[1] == pytest.approx(-0.2)
        assert min(step.position_enu_m[2] for step in steps) >= 20.0
        assert steps[-1].position_enu_m[2] == pytest.approx(20.0, abs=1e-9)

    def test_a_speed_cap_slows_it_down_but_no_faster_than_it_brakes(self) -> None:
        fast = Guarded(START, (), (5.0, 0.0, 2.0))
        slower = GUARD.towards((50.0, 0.0, 60.0), fast, motion(START), 0.1, 1.0)
        assert slower.velocity_enu_mps == pytest.approx((4.8, 0.0, 1.8))
        steps = flown((50.0, 0.0, 60.0), cap_mps=1.0)
        assert max(step.velocity_enu_mps[0] for step in steps) == pytest.approx(1.0)
        assert max(step.velocity_enu_mps[2] for step in steps) == pytest.approx(1.0)
        for cap_mps in (0.0, 0.5):
            capped = GUARD.towards((50.0, 0.0, 30.0), Guarded(START), motion(START), 0.1, cap_mps)
            assert capped.reasons == ()
        stopped = flown((50.0, 0.0, 60.0), cap_mps=0.0)
        assert stopped[-1].position_enu_m == START

    @pytest.mark.parametrize(
        ("dt_s", "moved_m"),
        [(-1.0, 0.0), (0.0, 0.0), (0.1, 0.5), (0.2, 1.0), (0.3, 1.0), (5.0, 1.0), (1e9, 1.0)],
    )
    def test_a_late_tick_moves_no_farther_than_a_slow_one(
        self, dt_s: float, moved_m: float
    ) -> None:
        fast = Guarded(START, (), (5.0, 0.0, 0.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), fast, motion(START), dt_s)
        assert guarded.position_enu_m == pytest.approx((moved_m, 0.0, 30.0))
        assert guarded.velocity_enu_mps == pytest.approx((5.0, 0.0, 0.0))

    def test_who_is_at_the_goal_and_still_moves_brakes(self) -> None:
        fast = Guarded(START, (), (5.0, 0.0, 0.0))
        guarded = GUARD.towards(START, fast, motion(START), 0.1)
        assert guarded.velocity_enu_mps == pytest.approx((4.8, 0.0, 0.0))
        assert guarded.position_enu_m == pytest.approx((0.48, 0.0, 30.0))


class TestHolding:
    def test_holding_stops_at_once(self) -> None:
        fast = Guarded(START, (), (5.0, 1.0, 2.0))
        held = GUARD.hold(fast, motion((-5.0, 0.0, 30.0)), 0.1)
        assert held == Guarded(START)

    def test_holding_still_looks_at_the_vehicle(self) -> None:
        held = GUARD.hold(Guarded(START), motion((60.0, 0.0, 30.0)), 0.1)
        assert held == Guarded((60.0, 0.0, 30.0), (GuardReason.JUMPED,))

    def test_a_hold_outside_a_band_that_moved_comes_back_slowly(self) -> None:
        held = GUARD.hold(Guarded((0.0, 0.0, 10.0)), motion(START), 0.1)
        assert held.position_enu_m == pytest.approx((0.0, 0.0, 10.02))
        assert held.reasons == (GuardReason.ALTITUDE,)

    def test_standing_moves_nothing_even_outside_of_fence_and_band(self) -> None:
        for position in (START, (150.0, 0.0, 30.0), (0.0, 0.0, 90.0), (0.0, 0.0, 3.0)):
            assert GUARD.freeze(position) == Guarded(position)
        with pytest.raises(ValueError, match=r"^the position to hold is not a number$"):
            GUARD.freeze((0.0, math.nan, 30.0))


class TestTheFence:
    def test_a_goal_outside_ends_at_the_margin(self) -> None:
        for east in (96.0, 500.0, 1e9, 1e308):
            steps = flown((east, 0.0, 30.0))
            assert steps[-1].position_enu_m == pytest.approx((95.0, 0.0, 30.0), abs=1e-5)
            assert steps[-1].reasons == (GuardReason.FENCE,)

    def test_what_a_far_goal_means_is_its_direction(self) -> None:
        last = flown((-1e9, 1e5, 30.0), ticks=2000)[-1].position_enu_m
        assert last == pytest.approx((-95.0, 9.5, 30.0), abs=1e-3)

    def test_near_the_border_it_is_slow_enough_to_stop_with_latency(self) -> None:
        """Every setpoint: v t + v^2 / 2a + 3 sigma fits into what is left of the fence."""
        for step in flown((500.0, 0.0, 30.0)):
            speed = step.velocity_enu_mps[0]
            needed_m = 0.5 * speed + speed * speed / 4.0 + 3.0
            assert step.position_enu_m[0] + needed_m <= 100.0 + 1e-6

    def test_a_margin_of_three_sigma_is_enough_and_slower(self) -> None:
        limits = replace(LIMITS, fence=Fence(SQUARE.polygon_enu_m, 3.0))
        steps = flown((500.0, 0.0, 30.0), guard=Guard(limits))
        assert steps[-1].position_enu_m[0] == pytest.approx(97.0, abs=0.01)
        near = next(step for step in steps if step.position_enu_m[0] >= 95.0)
        assert near.velocity_enu_mps[0] <= 2.0 * math.sqrt(0.25 + 2.0) - 1.0

    def test_a_setpoint_whose_stop_is_not_inside_stays_where_it_was(self) -> None:
        """Sideways to its goal it may be too fast, though its goal is near."""
        fast = Guarded((93.0, 0.0, 30.0), (), (4.0, 0.0, 0.0))
        kept = GUARD.towards((93.0, 50.0, 30.0), fast, motion((90.0, 0.0, 30.0)), 0.1)
        assert kept == Guarded((93.0, 0.0, 30.0), (GuardReason.CUT_OFF,))

    def test_a_setpoint_that_would_leave_stays_where_it_was(self) -> None:
        """Its stop would still keep 3 sigma, but not the margin."""
        slow = Guarded((94.99, 0.0, 30.0), (), (0.5, 0.0, 0.0))
        kept = GUARD.towards((94.99, 50.0, 30.0), slow, motion((94.0, 0.0, 30.0)), 0.1)
        assert kept == Guarded((94.99, 0.0, 30.0), (GuardReason.CUT_OFF,))

    def test_without_a_fence_nothing_moves(self) -> None:
        guard = Guard(replace(LIMITS, fence=None))
        fast = Guarded(START, (), (5.0, 0.0, 0.0))
        kept = Guarded(START, (GuardReason.NO_FENCE,))
        assert guard.towards((50.0, 0.0, 30.0), fast, motion(START), 0.1) == kept
        assert guard.here(motion((1.0, 2.0, 30.0))) == Guarded(
            (1.0, 2.0, 30.0), (GuardReason.NO_FENCE,)
        )

    def test_a_fence_may_become_known(self) -> None:
        guard = Guard(replace(LIMITS, fence=None))
        guard.use(LIMITS)
        assert guard.limits is LIMITS
        assert flown((500.0, 0.0, 30.0), guard=guard)[-1].reasons == (GuardReason.FENCE,)


class TestTheAltitudeBand:
    @pytest.mark.parametrize(("up_m", "end_m"), [(1e9, HIGH_M), (-1e9, LOW_M), (67.1, HIGH_M)])
    def test_a_goal_outside_ends_three_sigma_inside(self, up_m: float, end_m: float) -> None:
        steps = flown((0.0, 0.0, up_m))
        assert steps[-1].position_enu_m == pytest.approx((0.0, 0.0, end_m), abs=1e-9)
        assert steps[-1].reasons == (GuardReason.ALTITUDE,)
        assert all(LOW_M <= step.position_enu_m[2] <= HIGH_M for step in steps)

    @pytest.mark.parametrize("up_m", [LOW_M, HIGH_M])
    def test_its_ends_belong_to_it(self, up_m: float) -> None:
        assert flown((0.0, 0.0, up_m))[-1].reasons == ()

    def test_a_band_that_three_sigma_close_is_refused(self) -> None:
        with pytest.raises(
            ValueError, match=r"^altitude_min_m: nothing is left of 5 to 11 m at 3 "
        ):
            replace(LIMITS, envelope=replace(ENVELOPE, altitude_max_m=11.0))
        ok = replace(LIMITS, envelope=replace(ENVELOPE, altitude_max_m=11.1))
        assert ok.altitude_m == pytest.approx((8.0, 8.1))


class TestWhatIsNoNumber:
    FAST = Guarded((1.0, 2.0, 30.0), (), (5.0, 0.0, 0.0))
    KEPT = Guarded((1.0, 2.0, 30.0), (GuardReason.NOT_FINITE,))

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_a_goal_keeps_the_setpoint(self, axis: int, value: float) -> None:
        goal = list(START)
        goal[axis] = value
        position = (goal[0], goal[1], goal[2])
        assert GUARD.towards(position, self.FAST, motion(START), 0.1) == self.KEPT

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("value", [math.nan, math.inf, -1e6 - 0.5, 1e6 + 0.5])
    def test_a_vehicle_keeps_the_setpoint(self, axis: int, value: float) -> None:
        odd = list(START)
        odd[axis] = value
        position = (odd[0], odd[1], odd[2])
        for strange in (
            Motion(position, START, HOME),
            Motion(START, position, HOME),
            Motion(START, START, position),
        ):
            assert GUARD.towards((50.0, 0.0, 30.0), self.FAST, strange, 0.1) == self.KEPT

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_no_vehicle_stays_at_an_invalid_position(self, axis: int, value: float) -> None:
        odd = list(START)
        odd[axis] = value
        position = (odd[0], odd[1], odd[2])
        problem = "the position of vehicle or home is not a number"
        for guard in (GUARD, Guard(replace(LIMITS, fence=None))):
            for nowhere in (motion(position), Motion(START, (0.0, 0.0, 0.0), position)):
                with pytest.raises(ValueError, match=f"^{problem}$"):
                    guard.here(nowhere)
                with pytest.raises(ValueError, match=f"^{problem}$"):
                    guard.towards((9.0, 0.0, 30.0), Guarded(position), nowhere, 0.1)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_after_a_setpoint_that_was_none_it_begins_again(self, axis: int, value: float) -> None:
        odd = list(START)
        odd[axis] = value
        position = (odd[0], odd[1], odd[2])
        at_the_vehicle = Guarded((4.0, 5.0, 30.0), (GuardReason.NOT_FINITE,))
        for guard in (GUARD, Guard(replace(LIMITS, fence=None))):
            for last in (Guarded(position), Guarded(START, (), position)):
                now = motion((4.0, 5.0, 30.0), (1.0, 0.0, 0.0))
                assert guard.towards((9.0, 0.0, 30.0), last, now, 0.1) == at_the_vehicle
                assert guard.hold(Guarded(position), now, 0.1) == at_the_vehicle

    def test_a_home_far_away_is_still_a_place(self) -> None:
        far = Motion(START, (0.0, 0.0, 0.0), (-1e6, 1e6, 10.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), Guarded(START), far, 0.1)
        assert guarded.reasons == ()

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_a_clock_keeps_the_setpoint(self, value: float) -> None:
        assert GUARD.towards(START, self.FAST, motion(START), value) == self.KEPT

    @pytest.mark.parametrize("value", [math.nan, -0.1])
    def test_a_speed_cap_keeps_the_setpoint(self, value: float) -> None:
        assert GUARD.towards(START, self.FAST, motion(START), 0.1, value) == self.KEPT


class TestTheLead:
    def test_it_waits_for_a_vehicle_that_stands(self) -> None:
        last = Guarded(START)
        for _ in range(200):
            last = GUARD.towards((50.0, 0.0, 30.0), last, motion(START), 0.1)
        assert last.position_enu_m == pytest.approx((8.0, 0.0, 30.0), abs=1e-3)
        assert last.position_enu_m[0] <= 8.0
        assert last.reasons == (GuardReason.LAGGING,)

    def test_it_is_as_fast_as_a_vehicle_that_follows_from_afar(self) -> None:
        ahead = Guarded((9.0, 0.0, 30.0), (), (3.0, 0.0, 0.0))
        follows = motion(START, (3.0, 1.0, 0.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), ahead, follows, 0.1)
        assert guarded.velocity_enu_mps == pytest.approx((3.0, 0.0, 0.0))
        assert guarded.reasons == (GuardReason.LAGGING,)
        northwards = Guarded((0.0, 9.0, 30.0), (), (0.0, 3.0, 0.0))
        follows = motion(START, (1.0, 3.0, 0.0))
        guarded = GUARD.towards((0.0, 50.0, 30.0), northwards, follows, 0.1)
        assert guarded.velocity_enu_mps == pytest.approx((0.0, 3.0, 0.0))

    def test_a_vehicle_that_flies_away_from_it_counts_as_standing(self) -> None:
        ahead = Guarded((9.0, 0.0, 30.0), (), (0.0, 0.0, 0.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), ahead, motion(START, (-3.0, 0.0, 0.0)), 0.1)
        assert guarded.position_enu_m == (9.0, 0.0, 30.0)

    def test_a_lead_within_the_step_is_nothing_to_wait_for(self) -> None:
        ahead = Guarded((5.0, 0.0, 30.0), (), (5.0, 0.0, 0.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), ahead, motion(START, (5.0, 0.0, 0.0)), 0.1)
        assert guarded.reasons == ()
        assert guarded.velocity_enu_mps == pytest.approx((5.0, 0.0, 0.0))

    def test_a_short_step_makes_a_short_lead_one_to_wait_for(self) -> None:
        guard = Guard(replace(LIMITS, envelope=replace(ENVELOPE, step_m=0.5)))
        ahead = Guarded((0.4, 0.0, 30.0), (), (5.0, 0.0, 0.0))
        guarded = guard.towards((50.0, 0.0, 30.0), ahead, motion(START), 0.1)
        assert guarded.reasons == (GuardReason.LAGGING,)

    def test_a_vehicle_that_keeps_up_exactly_does_not_lag(self) -> None:
        pace_mps = STOPPING.speed_mps(4.0, 0.1)
        ahead = Guarded((4.0, 0.0, 30.0))
        guarded = GUARD.towards((50.0, 0.0, 30.0), ahead, motion(START), 0.1, pace_mps)
        assert guarded.reasons == ()

    def test_it_may_come_back_to_a_vehicle_that_fell_behind(self) -> None:
        """Blown 15 m away, the setpoint still moves when that brings it nearer."""
        guarded = GUARD.towards((-50.0, 0.0, 30.0), Guarded(START), motion((-15.0, 0.0, 30.0)), 0.1)
        assert guarded.velocity_enu_mps == pytest.approx((-0.2, 0.0, 0.0))
        assert guarded.reasons == ()
        guarded = GUARD.towards((0.0, -50.0, 30.0), Guarded(START), motion((1.0, -15.0, 30.0)), 0.1)
        assert guarded.velocity_enu_mps == pytest.approx((0.0, -0.2, 0.0))

    def test_a_vehicle_that_jumped_away_is_not_flown_back_across_the_gap(self) -> None:
        """An autopilot's position may jump by tens of metres when its estimator resets."""
        for away in ((16.1, 0.0, 30.0), (0.0, -60.0, 30.0)):
            guarded = GUARD.towards((50.0, 0.0, 30.0), Guarded(START), motion(away), 0.05)
            assert guarded == Guarded(away, (GuardReason.JUMPED,))
        near = GUARD.towards((50.0, 0.0, 30.0), Guarded(START), motion((-16.0, 0.0, 30.0)), 0.05)
        assert near.reasons == (GuardReason.LAGGING,)


class TestHere:
    def test_here_is_where_the_vehicle_is(self) -> None:
        assert GUARD.here(motion((3.0, 4.0, 30.0), (5.0, 0.0, 0.0))) == Guarded((3.0, 4.0, 30.0))

    def test_here_is_where_it_is_outside_too_and_says_so(self) -> None:
        guarded = GUARD.here(motion((120.0, 0.0, 5.0)))
        both = (GuardReason.ALTITUDE, GuardReason.OUTSIDE)
        assert guarded == Guarded((120.0, 0.0, LOW_M), both)
        assert GUARD.here(motion((97.1, 0.0, 30.0))).reasons == (GuardReason.OUTSIDE,)
        assert GUARD.here(motion((96.9, 0.0, 30.0))).reasons == ()


class TestLimits:
    def test_a_margin_of_less_than_three_sigma_is_refused(self) -> None:
        with pytest.raises(ValueError, match=r"^fence_margin_m: 2\.9 m is less than 3 m, 3 sigma"):
            replace(LIMITS, fence=Fence(SQUARE.polygon_enu_m, 2.9))
