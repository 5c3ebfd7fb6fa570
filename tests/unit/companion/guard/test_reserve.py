from __future__ import annotations

import math

import pytest

from companion.guard.limits import Reserve

RESERVE = Reserve(reserve_pct=20.0, cost_pct_per_km=10.0)


@pytest.mark.parametrize(
    ("battery_pct", "reach_m"),
    [(100.0, 8000.0), (50.0, 3000.0), (20.0, 0.0), (19.0, 0.0), (0.0, 0.0), (21.0, 100.0)],
)
def test_what_is_left_beyond_the_reserve_is_a_distance(battery_pct: float, reach_m: float) -> None:
    assert RESERVE.reach_m(battery_pct) == pytest.approx(reach_m)


@pytest.mark.parametrize("battery_pct", [None, math.nan])
def test_an_unknown_battery_is_not_a_full_one(battery_pct: float | None) -> None:
    assert RESERVE.reach_m(battery_pct) == 0.0


def test_no_reserve_is_allowed_and_nearly_everything_too() -> None:
    assert Reserve(0.0, 10.0).reach_m(1.0) == pytest.approx(100.0)
    assert Reserve(99.5, 0.5).reach_m(100.0) == pytest.approx(1000.0)


@pytest.mark.parametrize(
    ("reserve_pct", "cost", "name"),
    [
        (-1.0, 10.0, "battery_reserve_pct"),
        (100.0, 10.0, "battery_reserve_pct"),
        (math.nan, 10.0, "battery_reserve_pct"),
        (20.0, 0.0, "battery_pct_per_km"),
        (20.0, -1.0, "battery_pct_per_km"),
        (20.0, math.inf, "battery_pct_per_km"),
        (20.0, math.nan, "battery_pct_per_km"),
    ],
)
def test_a_reserve_of_nothing_is_refused(reserve_pct: float, cost: float, name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: must be"):
        Reserve(reserve_pct, cost)
