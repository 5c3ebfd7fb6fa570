"""Flight time that several processes share: it waits for none of them."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from companion.io.shared_clock import LEEWAY_S, VARIABLE, Pacer, SharedClock, clock_of
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
    assert machine.pacer.now_s() == pytest.approx(40.0, abs=4.0 * STEP_S)
    assert machine.follower.now_s() == pytest.approx(machine.pacer.now_s())
    assert machine.pacer.speed == 4.0


@pytest.mark.parametrize("late", ["pacer", "follower"])
def test_a_process_that_is_kept_waiting_loses_hardly_more_than_in_real_time(
    machine: Machine, late: str
) -> None:
    machine.pass_time(1.0)
    before_s = machine.follower.now_s()
    machine.pass_time(0.4, **{late: False})
    clocks = (machine.follower.now_s(), machine.pacer.now_s())
    assert clocks[0] == pytest.approx(clocks[1])
    # the leeway, and the one step after which the pacer sees that the other is late
    assert 0.4 < clocks[0] - before_s <= 0.4 + LEEWAY_S + 4.0 * STEP_S


def test_one_stall_changes_no_speed_and_a_machine_that_is_too_slow_does(machine: Machine) -> None:
    machine.pass_time(2.0)
    machine.pass_time(0.4, follower=False)
    machine.pass_time(4.0)
    assert machine.pacer.speed == 4.0
    for _ in range(60):
        machine.pass_time(0.2, follower=False)
        machine.pass_time(0.02)
    assert machine.pacer.speed == 1.0
    assert machine.follower.delay_s(machine.follower.now_s() + 1.0) == pytest.approx(1.0)


def test_no_clock_goes_back_whatever_happens(machine: Machine) -> None:
    shown_s = 0.0
    for number in range(300):
        machine.pass_time(0.03, pacer=number % 7 > 2, follower=number % 5 > 1)
        for clock in (machine.pacer, machine.follower):
            assert clock.now_s() >= shown_s - 1e-9
        shown_s = machine.follower.now_s()


def test_who_is_excused_holds_nobody_up_until_it_is_back(machine: Machine) -> None:
    machine.pass_time(1.0)
    before_s = machine.pacer.now_s()
    for _ in range(10):
        machine.pacer.excuse()
        machine.pass_time(0.1, follower=False)
    assert machine.pacer.now_s() - before_s == pytest.approx(4.0)
    assert machine.pacer.speed == 4.0


def test_a_flight_slower_than_real_time_stays_as_slow(tmp_path: Path) -> None:
    pacer = Pacer(tmp_path / "clock", 0.5)
    time.sleep(0.1)
    before_s, wall_s = pacer.now_s(), time.monotonic()
    time.sleep(0.5)
    passed_s = time.monotonic() - wall_s
    assert pacer.now_s() - before_s == pytest.approx(0.5 * passed_s, rel=0.05)


def test_a_child_process_finds_the_clock_in_its_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert type(clock_of(3.0)) is Clock
    pacer = Pacer(tmp_path / "a:clock", 4.0)
    monkeypatch.setenv(VARIABLE, pacer.environment(1)[VARIABLE])
    clock = clock_of(3.0)
    assert isinstance(clock, SharedClock)
    assert clock.speed == 4.0
