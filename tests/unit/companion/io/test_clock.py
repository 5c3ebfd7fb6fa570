from __future__ import annotations

import math
import time

import pytest

from companion.io.shell import Clock


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_the_clock_starts_at_zero_and_runs_at_its_speed(wall: list[float]) -> None:
    clock = Clock(speed=4.0)
    assert clock.now_s() == 0.0
    wall[0] += 2.5
    assert clock.now_s() == 10.0


def test_a_delay_is_in_wall_seconds(wall: list[float]) -> None:
    clock = Clock(speed=4.0)
    wall[0] += 1.0
    assert clock.delay_s(8.0) == 1.0


def test_what_is_past_needs_no_delay(wall: list[float]) -> None:
    clock = Clock()
    wall[0] += 5.0
    assert clock.delay_s(4.0) == 0.0


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf])
def test_a_clock_that_cannot_run_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed"):
        Clock(speed)
