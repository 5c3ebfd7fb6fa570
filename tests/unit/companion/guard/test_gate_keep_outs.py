"""The guard and keep-outs."""

from __future__ import annotations

from dataclasses import replace

from companion.guard.gate import Guard, Guarded, GuardReason
from companion.guard.limits import Fence
from tests.unit.companion.guard.gate_helpers import LIMITS, SQUARE, motion

HOUSE = ((10.0, -20.0), (20.0, -20.0), (20.0, 20.0), (10.0, 20.0))


class TestKeepOuts:
    GUARD = Guard(replace(LIMITS, fence=Fence(SQUARE.polygon_enu_m, 5.0, (HOUSE,))))

    def test_the_straight_way_from_the_vehicle_must_be_free(self) -> None:
        """Round the corner of a house the setpoint waits until the vehicle has turned it."""
        last = Guarded((8.0, 25.1, 30.0))
        goal = (40.0, 25.1, 30.0)
        behind = self.GUARD.towards(goal, last, motion((5.0, 20.0, 30.0)), 0.1)
        assert behind.position_enu_m[0] > 8.0
        last = Guarded((9.3, 25.1, 30.0))
        behind = self.GUARD.towards(goal, last, motion((6.5, 19.8, 30.0)), 0.1)
        assert behind.position_enu_m == (9.3, 25.1, 30.0)
        assert GuardReason.CUT_OFF in behind.reasons
        turned = self.GUARD.towards(goal, last, motion((7.0, 25.1, 30.0)), 0.1)
        assert turned.position_enu_m[0] > 9.3

    def test_a_vehicle_pushed_behind_a_corner_starts_again_where_it_is(self) -> None:
        last = Guarded((15.0, 25.1, 30.0), (), (1.0, 0.0, 0.0))
        pushed = motion((6.5, 18.0, 31.0))
        anew = self.GUARD.towards((40.0, 25.1, 30.0), last, pushed, 0.1)
        assert anew == Guarded((6.5, 18.0, 31.0), (GuardReason.CUT_OFF,))

    def test_a_goal_behind_a_keep_out_is_not_called_outside(self) -> None:
        """The way ends before the house; the goal itself is allowed."""
        last = Guarded((0.0, 0.0, 30.0))
        stopped = self.GUARD.towards((40.0, 0.0, 30.0), last, motion(last.position_enu_m), 0.1)
        assert stopped.reasons == ()
        inside = self.GUARD.towards((15.0, 0.0, 30.0), last, motion(last.position_enu_m), 0.1)
        assert inside.reasons == (GuardReason.FENCE,)

    def test_the_way_is_looked_at_from_where_the_setpoint_will_find_the_vehicle(self) -> None:
        """At 4 m/s southwards the vehicle is 2 m farther behind the house after the latency."""
        last = Guarded((9.0, 25.1, 30.0))
        position = (6.5, 20.2, 30.0)
        still = self.GUARD.towards((40.0, 25.1, 30.0), last, motion(position), 0.1)
        assert still.position_enu_m[0] > 9.0
        moving = motion(position, (0.0, -4.0, 0.0))
        kept = self.GUARD.towards((40.0, 25.1, 30.0), last, moving, 0.1)
        assert kept.position_enu_m == (9.0, 25.1, 30.0)
        assert GuardReason.CUT_OFF in kept.reasons

    def test_and_from_where_it_is_now(self) -> None:
        """At 4 m/s northwards it will be past the corner, but a frame may come early."""
        last = Guarded((9.3, 25.1, 30.0))
        kept = self.GUARD.towards(
            (40.0, 25.1, 30.0), last, motion((6.5, 19.8, 30.0), (0.0, 4.0, 0.0)), 0.1
        )
        assert kept.position_enu_m == last.position_enu_m
        assert GuardReason.CUT_OFF in kept.reasons
