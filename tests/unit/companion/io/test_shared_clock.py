"""Flight time that several processes share: it waits for none of them."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from companion.io.child_processes import (
    ASLEEP_AFTER_S,
    LEEWAY_S,
    VARIABLE,
    Pacer,
    SharedClock,
    clock_of,
)
from companion.io.shell import Clock

STEP_S = 0.01


class Machine:
    """A monotonic clock that is set by hand, a pacer at four times real time and one follower."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall_s = 1000.0
        monkeypatch.setattr(time, "monotonic", lambda: self.wall_s)
        self.pacer = Pacer(folder / "clock", 4.0)
        self.follower = SharedClock(folder / "clock", 0)
        self.pacer.restart()
        self.follower.restart()

    def pass_time(self, seconds: float, *, pacer: bool = True, follower: bool = True) -> None:
        """Let real time pass, in which those wake up every 10 ms that are not kept waiting."""
        for _ in range(round(seconds / STEP_S)):
            self.wall_s += STEP_S
            if pacer:
                self.pacer.now_s()
            if follower:
                self.follower.now_s()


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_processes_that_keep_up_fly_at_the_speed_asked_for(machine: Machine) -> None:
    machine.pass_time(10.0)
    # but for the first step, before the pacer woke up
    assert machine.pacer.now_s() == pytest.approx(40.0, abs=8.0 * STEP_S)
    assert machine.follower.now_s() == pytest.approx(machine.pacer.now_s())
    assert machine.pacer.speed == 4.0


@pytest.mark.parametrize("late", ["pacer", "follower"])
def test_a_process_that_is_kept_waiting_loses_no_more_than_the_leeway(
    machine: Machine, late: str
) -> None:
    machine.pass_time(1.0)
    before_s = machine.follower.now_s()
    machine.pass_time(3.0, **{late: False})
    clocks = (machine.follower.now_s(), machine.pacer.now_s())
    assert clocks[0] == pytest.approx(clocks[1])
    # the leeway, and the one step after which the pacer sees that the other is late
    assert 0.0 < clocks[0] - before_s <= LEEWAY_S + 4.0 * STEP_S
    machine.pass_time(1.0)
    assert machine.follower.now_s() - clocks[0] >= 1.0


def test_one_stall_changes_no_speed_and_a_machine_that_is_too_slow_does(machine: Machine) -> None:
    machine.pass_time(2.0)
    machine.pass_time(0.4, follower=False)
    machine.pass_time(4.0)
    assert machine.pacer.speed == 4.0
    for _ in range(60):
        machine.pass_time(0.2, follower=False)
        machine.pass_time(0.02)
    assert machine.pacer.speed == 1.0
    assert machine.pacer.pace == "1x"
    for _ in range(10):
        machine.pass_time(0.6, follower=False)
        machine.pass_time(0.02)
    assert machine.pacer.pace == "less than 1x"
    assert machine.follower.delay_s(machine.follower.now_s() + 0.05) == pytest.approx(0.05)


def test_a_process_that_ended_is_not_waited_for_for_ever(machine: Machine) -> None:
    machine.pass_time(1.0)
    machine.pass_time(ASLEEP_AFTER_S, follower=False)
    before_s = machine.pacer.now_s()
    machine.pass_time(1.0, follower=False)
    assert machine.pacer.now_s() - before_s >= 0.9


def test_a_process_with_nothing_to_do_wakes_up_in_time_to_be_seen(machine: Machine) -> None:
    machine.pass_time(1.0)
    assert machine.follower.delay_s(math.inf) < LEEWAY_S / 4.0


def test_no_clock_goes_back_whatever_happens(machine: Machine) -> None:
    shown_s = 0.0
    for number in range(300):
        machine.pass_time(0.03, pacer=number % 7 > 2, follower=number % 5 > 1)
        for clock in (machine.pacer, machine.follower):
            assert clock.now_s() >= shown_s - 1e-9
        shown_s = machine.follower.now_s()


def test_an_excused_process_delays_no_other_until_it_is_back(machine: Machine) -> None:
    machine.pass_time(1.0)
    before_s = machine.pacer.now_s()
    for _ in range(10):
        machine.pacer.exclude_others()
        machine.pass_time(0.1, follower=False)
    assert machine.pacer.now_s() - before_s == pytest.approx(4.0)
    assert machine.pacer.speed == 4.0


def test_a_flight_slower_than_real_time_stays_as_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: wall_s)
    pacer = Pacer(tmp_path / "clock", 0.5)
    for _ in range(1001):
        pacer.now_s()
        wall_s += STEP_S
    assert pacer.now_s() == pytest.approx(5.0, abs=0.01)
    assert pacer.pace == "0.5x"


def test_a_child_process_finds_the_clock_in_its_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert type(clock_of(3.0)) is Clock
    pacer = Pacer(tmp_path / "a:clock", 4.0)
    monkeypatch.setenv(VARIABLE, pacer.environment(1)[VARIABLE])
    clock = clock_of(3.0)
    assert isinstance(clock, SharedClock)
    assert clock.speed == 4.0
