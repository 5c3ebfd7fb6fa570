"""The guard and the battery that must bring the vehicle home."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.guard.gate import Guard, Guarded, GuardReason
from companion.guard.limits import Reserve
from tests.unit.companion.guard.gate_helpers import LIMITS, START, flown


class TestTheWayHome:
    def test_a_leash_is_not_left(self) -> None:
        guard = Guard(replace(LIMITS, distance_home_m=40.0))
        steps = flown((90.0, 0.0, 30.0), guard=guard)
        assert steps[-1].position_enu_m == pytest.approx((40.0, 0.0, 30.0), abs=1e-6)
        assert max(step.position_enu_m[0] for step in steps) <= 40.0 + 1e-9
        assert steps[-1].reasons == (GuardReason.LEASH,)
        assert flown((0.0, 40.0, 30.0), guard=guard)[-1].reasons == ()

    @pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
    def test_a_leash_of_nothing_is_refused(self, value: float) -> None:
        with pytest.raises(ValueError, match=r"^distance_home_m: must be above 0$"):
            replace(LIMITS, distance_home_m=value)

    def test_a_short_leash_is_one(self) -> None:
        assert replace(LIMITS, distance_home_m=0.5).distance_home_m == 0.5

    LOW = Guard(replace(LIMITS, reserve=Reserve(20.0, 100.0)))

    def test_a_battery_that_reaches_no_farther_is_the_end_of_the_way_out(self) -> None:
        steps = flown((90.0, 0.0, 30.0), guard=self.LOW, battery_pct=25.0)
        assert steps[-1].position_enu_m == pytest.approx((50.0, 0.0, 30.0), abs=1e-6)
        assert steps[-1].reasons == (GuardReason.BATTERY,)

    def test_there_is_always_a_way_back(self) -> None:
        steps = flown((0.0, 0.0, 30.0), start=(90.0, 0.0, 30.0), guard=self.LOW, battery_pct=5.0)
        assert all(not step.reasons for step in steps)
        assert steps[-1].position_enu_m == pytest.approx(START, abs=1e-6)

    def test_an_unknown_battery_goes_no_farther_and_says_so(self) -> None:
        last = flown((90.0, 0.0, 30.0), start=(10.0, 0.0, 30.0), guard=self.LOW, ticks=50)[-1]
        assert last == Guarded((10.0, 0.0, 30.0), (GuardReason.BATTERY_UNKNOWN,))

    def test_the_nearer_of_leash_and_battery_counts(self) -> None:
        guard = Guard(replace(LIMITS, reserve=Reserve(20.0, 100.0), distance_home_m=40.0))
        assert flown((90.0, 0.0, 30.0), guard=guard, battery_pct=90.0)[-1].reasons == (
            GuardReason.LEASH,
        )
        both = flown((90.0, 0.0, 30.0), guard=guard, battery_pct=22.0)[-1]
        assert both.reasons == (GuardReason.LEASH, GuardReason.BATTERY)
        assert both.position_enu_m[0] == pytest.approx(20.0, abs=1e-6)
