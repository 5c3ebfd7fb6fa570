"""The guard with a vehicle that is where it must not be."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.geometry.polygons import Point, depth_m
from companion.guard.gate import Guard, Guarded, GuardReason
from companion.guard.limits import Fence
from sim_link.world.point_mass import MulticopterParams, PointMass, WindParams, approach_velocity
from tests.unit.companion.guard.gate_helpers import GUARD, LIMITS, START, motion


class TestAVehicleInTrouble:
    def test_within_the_margin_it_is_inside_while_three_sigma_are_kept(self) -> None:
        last = Guarded((95.0, 0.0, 30.0))
        drifted = GUARD.towards((0.0, 0.0, 30.0), last, motion((97.0, 0.0, 30.0)), 0.1)
        assert drifted.reasons == (GuardReason.LAGGING,)
        pushed = GUARD.towards((0.0, 0.0, 30.0), last, motion((97.1, 0.0, 30.0)), 0.1)
        assert pushed.reasons == (GuardReason.OUTSIDE,)

    @pytest.mark.parametrize(("speed_mps", "is_too_fast"), [(3.9, False), (4.1, True)])
    def test_too_fast_to_stop_it_brakes_where_it_is(
        self, speed_mps: float, is_too_fast: bool
    ) -> None:
        """At 4 m/s it needs 2 + 4 + 3 m: from 91 m on it is too fast."""
        last = Guarded((94.0, 0.0, 30.0), (), (1.0, 0.0, 0.0))
        fast = motion((91.0, 0.0, 31.0), (speed_mps, 0.0, 0.0))
        guarded = GUARD.towards((94.0, 0.0, 30.0), last, fast, 0.1)
        if is_too_fast:
            assert guarded == Guarded((91.0, 0.0, 31.0), (GuardReason.TOO_FAST,))
        else:
            assert GuardReason.TOO_FAST not in guarded.reasons

    @pytest.mark.parametrize("turn", [0, 1, 2, 3])
    def test_a_setpoint_that_a_fast_vehicle_has_passed_stays(self, turn: int) -> None:
        """It brakes hardest towards what lies behind it."""

        def turned(position: Point) -> Point:
            for _ in range(turn):
                position = (-position[1], position[0])
            return position

        fast = motion((*turned((91.0, 3.0)), 31.0), (*turned((8.0, 2.0)), 0.0))
        behind = Guarded((*turned((90.0, 3.0)), 30.0), (), (1.0, 0.0, 0.0))
        kept = GUARD.towards((0.0, 0.0, 30.0), behind, fast, 0.1)
        assert kept == Guarded(behind.position_enu_m, (GuardReason.TOO_FAST,))
        beside = Guarded((*turned((90.0, 7.0)), 30.0))
        assert GUARD.towards((0.0, 0.0, 30.0), beside, fast, 0.1).position_enu_m == (
            beside.position_enu_m
        )
        ahead = Guarded((*turned((90.0, 7.1)), 30.0))
        anew = GUARD.towards((0.0, 0.0, 30.0), ahead, fast, 0.1)
        assert anew == Guarded(fast.position_enu_m, (GuardReason.TOO_FAST,))

    def test_a_setpoint_in_the_margin_comes_in_while_a_fast_vehicle_brakes(self) -> None:
        """A wind keeps the vehicle off it, nearer to the border than it stands."""
        fast = motion((96.0, 2.0, 30.0), (1.0, 8.0, 0.0))
        last = Guarded((96.0, -1.0, 30.0))
        for tick in (1, 2, 3):
            last = GUARD.towards((0.0, 0.0, 30.0), last, fast, 0.1)
            assert last.reasons == (GuardReason.TOO_FAST, GuardReason.MARGIN)
            assert last.velocity_enu_mps == pytest.approx((-0.2 * tick, 0.0, 0.0))
        assert last.position_enu_m == pytest.approx((95.88, -1.0, 30.0))

    def test_the_plan_has_no_say_while_it_comes_in_beside_a_fast_vehicle(self) -> None:
        """Neither the height of a goal nor the speed that the planner wants."""
        fast, last = motion((96.0, 2.0, 30.0), (1.0, 8.0, 0.0)), Guarded((96.0, -1.0, 30.0))
        led = GUARD.towards((0.0, 0.0, 50.0), last, fast, 0.1, speed_cap_mps=0.01)
        assert led == GUARD.towards((0.0, 0.0, 30.0), last, fast, 0.1)
        assert led.position_enu_m == pytest.approx((95.98, -1.0, 30.0))

    def test_a_setpoint_in_the_margin_is_not_walked_in_farther_out_than_a_fast_vehicle(
        self,
    ) -> None:
        fast, last = motion((95.0, 2.0, 30.0), (1.0, 8.0, 0.0)), Guarded((96.0, -1.0, 30.0))
        kept = GUARD.towards((0.0, 0.0, 30.0), last, fast, 0.1)
        assert kept == Guarded(last.position_enu_m, (GuardReason.TOO_FAST,))

    def test_but_as_far_in_as_that_it_is(self) -> None:
        fast = motion((95.0, 2.0, 30.0), (1.0, 8.0, 0.0))
        last = Guarded((95.005, -1.0, 30.0), (), (-1.0, 0.0, 0.0))
        led = GUARD.towards((0.0, 0.0, 30.0), last, fast, 0.1)
        assert led.reasons == (GuardReason.TOO_FAST, GuardReason.MARGIN)
        assert led.position_enu_m == pytest.approx((95.0, -1.0, 30.0), abs=1e-5)

    @pytest.mark.parametrize("slope", [0.08, 0.1, 0.12, 0.15])
    def test_too_fast_along_a_slanting_border_a_wind_does_not_take_it_out(
        self, slope: float
    ) -> None:
        """The autopilot lets it stand 1.6 m down the wind of every setpoint."""
        corners = ((-100.0, 0.0), (100.0, 200.0 * slope), (100.0, 150.0), (-100.0, 150.0))
        stopping = replace(LIMITS.stopping, navigation_sigma_m=0.3)
        guard = Guard(replace(LIMITS, fence=Fence(corners, 3.0), stopping=stopping))
        params = MulticopterParams()
        east_m, north_m = -3.0, 97.0 * slope + 1.2
        body = PointMass(params, WindParams(north_mps=-15.0), (east_m, north_m, 30.0))
        body.velocity_enu_mps = (5.0, 0.0, 0.0)
        last, least_m = Guarded((east_m + 5.0, north_m + 5.0 * slope + 2.0, 30.0)), north_m
        for tick in range(400):
            body.step(
                approach_velocity(body.position_enu_m, last.position_enu_m, params), 0.0, 0.02
            )
            least_m = min(least_m, depth_m(corners, body.position_enu_m[:2]))
            if tick % 5 == 0:
                known = motion(body.position_enu_m, body.velocity_enu_mps)
                last = guard.towards((60.0, 60.0, 30.0), last, known, 0.1)
        assert least_m > 0.1

    def test_only_a_vehicle_that_is_too_fast_leaves_its_setpoint_behind(self) -> None:
        """A jump forwards is still a jump."""
        away = motion((60.0, 0.0, 30.0), (1.0, 0.0, 0.0))
        assert GUARD.towards(START, Guarded(START), away, 0.1).position_enu_m == (60.0, 0.0, 30.0)

    def test_a_climb_takes_no_room_from_the_way_to_stop(self) -> None:
        """4 m/s need 6 m of the 6.1 m to 3 sigma before the fence."""
        position, climbing = (90.9, 0.0, 30.0), (4.0, 0.0, 2.0)
        guarded = GUARD.towards(
            (0.0, 0.0, 30.0), Guarded(position), motion(position, climbing), 0.1
        )
        assert GuardReason.TOO_FAST not in guarded.reasons

    def test_a_setpoint_that_a_new_fence_forbids_begins_again_at_the_vehicle(self) -> None:
        """It is in the margin, where the vehicle itself might be."""
        position = (90.0, 0.0, 30.0)
        anew = GUARD.towards((0.0, 0.0, 30.0), Guarded((96.0, 0.0, 30.0)), motion(position), 0.1)
        assert anew == Guarded(position, (GuardReason.MARGIN,))
