"""The time to go: extrapolated while R95 shrinks, counted down once it is small enough."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from companion.view.snapshot import TimeToGo

RULE = (1.0, 10.0)
"""Radius to stop at, m, and its confirmation, s."""


def test_a_radius_that_halves_every_ten_seconds() -> None:
    rule = TimeToGo()
    to_go = [rule.observe(t / 2, 16.0 * 0.5 ** (t / 20), *RULE) for t in range(41)]
    assert to_go[5] is None
    # After 20 s R95 is 4 m: two more halvings, then the confirmation.
    assert to_go[40] == pytest.approx(30.0, abs=0.01)


def test_a_radius_that_grows_promises_nothing() -> None:
    rule = TimeToGo()
    assert [rule.observe(float(t), 2.0 + 0.1 * t, *RULE) for t in range(20)] == [None] * 20


def test_the_confirmation_is_counted_down_and_begins_again() -> None:
    rule = TimeToGo()
    assert rule.observe(0.0, 0.9, *RULE) == 10.0
    assert rule.observe(4.0, 0.8, *RULE) == 6.0
    assert rule.observe(20.0, 0.8, *RULE) == 0.0
    rule.observe(21.0, 1.5, *RULE)
    assert rule.observe(22.0, 0.9, *RULE) == 10.0


@pytest.mark.parametrize("r95_m", [None, 0.0, math.nan])
def test_no_radius_no_time(r95_m: float | None) -> None:
    assert TimeToGo().observe(0.0, r95_m, *RULE) is None


def test_another_radius_counts_at_once() -> None:
    session = SimpleNamespace(
        params=SimpleNamespace(stop_radius_m=1.0, stop_confirm_s=10.0),
        estimate=SimpleNamespace(settled_r95_m=1.5),
    )
    flight: Any = SimpleNamespace(session=session)
    rule = TimeToGo()
    assert rule.of_flight(flight, 0.0) is None
    session.params = SimpleNamespace(stop_radius_m=2.0, stop_confirm_s=4.0)
    assert rule.of_flight(flight, 1.0) == 4.0
