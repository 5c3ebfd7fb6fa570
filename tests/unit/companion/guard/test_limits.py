from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.guard.limits import Envelope

ENVELOPE = Envelope(
    altitude_min_m=5.0,
    altitude_max_m=60.0,
    speed_mps=5.0,
    climb_mps=2.0,
    acceleration_mps2=2.0,
    step_m=8.0,
)


def test_a_velocity_changes_no_faster_than_the_acceleration_allows() -> None:
    assert ENVELOPE.next_velocity((0.0, 0.0), (3.0, 4.0), 0.5) == pytest.approx((0.6, 0.8))
    assert ENVELOPE.next_velocity((3.0, 4.0), (0.0, 0.0), 0.5) == pytest.approx((2.4, 3.2))
    assert ENVELOPE.next_velocity((1.0, 0.0), (1.0, -4.0), 0.1) == pytest.approx((1.0, -0.2))


def test_a_velocity_in_reach_is_taken_exactly() -> None:
    assert ENVELOPE.next_velocity((1.0, 2.0), (1.5, 2.5), 1.0) == (1.5, 2.5)
    assert ENVELOPE.next_velocity((1.0, 2.0), (3.0, 2.0), 1.0) == (3.0, 2.0)
    assert ENVELOPE.next_velocity((1.0, 2.0), (1.0, 2.0), 0.0) == (1.0, 2.0)


def test_no_time_is_no_change() -> None:
    assert ENVELOPE.next_velocity((1.0, 2.0), (3.0, 4.0), 0.0) == (1.0, 2.0)


@pytest.mark.parametrize("name", ["speed_mps", "climb_mps", "acceleration_mps2", "step_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_that_limit_nothing_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{name}: must be a finite number above 0$"):
        replace(ENVELOPE, **{name: value})


def test_slow_and_low_limits_are_limits_all_the_same() -> None:
    slow = Envelope(0.5, 0.9, 0.5, 0.5, 0.5, 0.5)
    assert slow.next_velocity((0.0, 0.0), (1.0, 0.0), 1.0) == (0.5, 0.0)


@pytest.mark.parametrize(
    ("low_m", "high_m"),
    [(0.0, 60.0), (-5.0, 60.0), (60.0, 60.0), (61.0, 60.0), (5.0, math.inf), (math.nan, 60.0)],
)
def test_an_empty_altitude_band_is_refused(low_m: float, high_m: float) -> None:
    with pytest.raises(ValueError, match=r"^altitude_min_m: must be above 0 and below"):
        replace(ENVELOPE, altitude_min_m=low_m, altitude_max_m=high_m)
