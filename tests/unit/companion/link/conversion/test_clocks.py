from __future__ import annotations

import random

import pytest

from companion.link.conversion.sender_clock import MAX_GAIN_S, ClockStep, SenderClock


def run(speed: float, seconds: float, delay_s: float = 0.0) -> tuple[SenderClock, float]:
    """A clock of some speed, read at 20 Hz; when it was first called wild."""
    clock, rng, wild_s = SenderClock(), random.Random(1), float("inf")
    for step in range(round(seconds / 0.05)):
        now_s = 0.05 * step
        clock.read(speed * now_s, now_s + rng.uniform(0.0, delay_s))
        if clock.is_too_fast:
            wild_s = min(wild_s, now_s)
    return clock, wild_s


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.0001, 1.1])
@pytest.mark.parametrize("delay_s", [0.0, 0.5])
def test_a_clock_about_as_fast_as_ours_is_never_wild(speed: float, delay_s: float) -> None:
    assert run(speed, 60.0, delay_s)[1] == float("inf")


def test_a_clock_of_twice_the_speed_is_wild_after_a_second() -> None:
    clock, wild_s = run(2.0, 10.0)
    assert wild_s == pytest.approx(MAX_GAIN_S, abs=0.11)
    assert clock.is_too_fast


def test_a_slow_clock_falls_behind_and_so_do_its_readings() -> None:
    clock, _ = run(0.5, 2.0)
    assert 3.0 - clock.read(1.5, 3.0).time_s > 0.5


def test_a_clock_that_stands_still_gives_no_new_time() -> None:
    clock, _ = run(1.0, 2.0)
    readings = [clock.read(2.0, 2.0 + 0.05 * step).time_s for step in range(40)]
    assert max(readings) == pytest.approx(2.0, abs=1e-3)


def test_a_wild_clock_that_calms_down_is_believed_again() -> None:
    clock, _ = run(2.0, 3.0)
    for step in range(60):
        clock.read(6.0 + 0.05 * step, 3.0 + 0.05 * step)
    assert not clock.is_too_fast


def test_what_a_line_held_back_at_the_start_makes_a_clock_wild_for_two_seconds_only() -> None:
    clock = SenderClock()
    for step in range(100):
        clock.read(0.05 * step, 5.0 + 0.0001 * step)
    assert clock.is_too_fast
    for step in range(60):
        now_s = 5.05 + 0.05 * step
        clock.read(now_s, now_s)
    assert not clock.is_too_fast


def test_what_a_line_held_back_later_changes_nothing() -> None:
    clock, _ = run(1.0, 2.0)
    for step in range(100):
        clock.read(2.0 + 0.05 * step, 7.0 + 0.0001 * step)
    assert not clock.is_too_fast


@pytest.mark.parametrize("confirm_s", [1.0, 10.0, 60.0])
def test_stamps_that_are_late_for_good_are_a_new_clock_after_a_while(confirm_s: float) -> None:
    clock, _ = run(1.0, 10.0)
    restarted_s = [
        now_s
        for now_s in (30.0 + 0.05 * step for step in range(2000))
        if clock.read(now_s - 12.0, now_s, late_confirm_s=confirm_s).step is ClockStep.RESTART
    ]
    assert restarted_s == pytest.approx([30.0 + confirm_s], abs=0.051)
