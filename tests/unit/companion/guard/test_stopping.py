from __future__ import annotations

import math

import pytest

from companion.guard.limits import Stopping, ahead

STOPPING = Stopping(latency_s=0.5, deceleration_mps2=2.0, navigation_sigma_m=0.3)


def test_a_vehicle_flies_on_for_the_latency_and_then_brakes() -> None:
    """At 4 m/s: 2 m of latency and 16 / 4 m of braking, in its own direction."""
    assert STOPPING.point((1.0, 2.0), (4.0, 0.0)) == pytest.approx((7.0, 2.0))
    assert STOPPING.point((1.0, 2.0), (0.0, -4.0)) == pytest.approx((1.0, -4.0))
    assert STOPPING.point((0.0, 0.0), (2.4, 3.2)) == pytest.approx((3.6, 4.8))
    assert STOPPING.point((1.0, 2.0), (0.0, 0.0)) == (1.0, 2.0)


def test_three_sigma_are_kept_to_all_sides() -> None:
    assert STOPPING.clearance_m == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("room_m", "wait_s", "speed_mps"),
    [(0.0, 0.5, 0.0), (6.0, 0.5, 4.0), (4.0, 0.0, 4.0), (0.25, 0.0, 1.0), (3.0, 1.0, 2.0)],
)
def test_the_greatest_speed_uses_up_the_room(
    room_m: float, wait_s: float, speed_mps: float
) -> None:
    assert STOPPING.speed_mps(room_m, wait_s) == pytest.approx(speed_mps)


def test_what_goes_on_is_elsewhere_after_a_time() -> None:
    assert ahead((1.0, 2.0), (3.0, -4.0), 0.5) == (2.5, 0.0)


@pytest.mark.parametrize(
    ("latency_s", "deceleration_mps2", "sigma_m", "name"),
    [
        (-0.1, 2.0, 0.3, "latency_s"),
        (math.inf, 2.0, 0.3, "latency_s"),
        (math.nan, 2.0, 0.3, "latency_s"),
        (0.5, 0.0, 0.3, "acceleration_mps2"),
        (0.5, -1.0, 0.3, "acceleration_mps2"),
        (0.5, math.inf, 0.3, "acceleration_mps2"),
        (0.5, math.nan, 0.3, "acceleration_mps2"),
        (0.5, 2.0, -0.1, "navigation_sigma_m"),
        (0.5, 2.0, math.inf, "navigation_sigma_m"),
        (0.5, 2.0, math.nan, "navigation_sigma_m"),
    ],
)
def test_what_is_no_number_or_stops_nothing_is_refused(
    latency_s: float, deceleration_mps2: float, sigma_m: float, name: str
) -> None:
    with pytest.raises(ValueError, match=f"^{name}: must be a finite number"):
        Stopping(latency_s, deceleration_mps2, sigma_m)


def test_weak_brakes_are_brakes_all_the_same() -> None:
    assert Stopping(0.0, 0.5, 0.0).point((0.0, 0.0), (1.0, 0.0)) == (1.0, 0.0)


def test_no_latency_and_perfect_navigation_are_allowed() -> None:
    perfect = Stopping(0.0, 2.0, 0.0)
    assert perfect.clearance_m == 0.0
    assert perfect.point((0.0, 0.0), (2.0, 0.0)) == (1.0, 0.0)
