"""Companion and vehicle in lockstep: repeatable, killed, suspended, observed."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.lockstep import Flight, MemoryJournal, Operator
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import reboot, run_until, take_off

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))


class Watcher(Observer):
    """Counts what it sees."""

    def __init__(self) -> None:
        self.log: list[tuple[float, str]] = []

    def sent(self, frame: Frame) -> None:
        assert frame.message is not None
        assert frame.message.get_srcComponent() == mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
        self.log.append((frame.time_s, "sent"))

    def heard(self, frame: Frame) -> None:
        self.log.append((frame.time_s, "heard"))

    def vehicle_sent(self, frame: Frame) -> None:
        self.log.append((frame.time_s, "vehicle sent"))

    def vehicle_heard(self, frame: Frame) -> None:
        self.log.append((frame.time_s, "vehicle heard"))

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:
        assert vehicle.time_s <= now_s + 1e-9
        self.log.append((now_s, "stepped"))

    def ticked(self, now_s: float) -> None:
        self.log.append((now_s, "ticked"))

    def companion_started(self, now_s: float) -> None:
        self.log.append((now_s, "started"))

    def companion_ended(self, now_s: float) -> None:
        self.log.append((now_s, "ended"))

    def times(self, what: str, after_s: float = -1.0) -> list[float]:
        return [time_s for time_s, each in self.log if each == what and time_s > after_s]


def flight_of(config: CompanionConfig = AUTO) -> tuple[Flight, Watcher]:
    flight, watcher = Flight(config, Scenario(), 1, MemoryJournal()), Watcher()
    flight.observers.append(watcher)
    return flight, watcher


def test_every_observer_sees_both_ends_of_the_wire_and_every_step() -> None:
    flight, watcher = flight_of()
    other = Watcher()
    flight.observers.append(other)
    flight.run(5.0)
    assert watcher.log == other.log
    assert len(watcher.times("stepped")) == pytest.approx(250, abs=2)
    assert len(watcher.times("ticked")) == pytest.approx(100, abs=2)
    assert len(watcher.times("sent")) == len(watcher.times("vehicle heard")) > 10
    assert len(watcher.times("heard")) == len(watcher.times("vehicle sent")) > 100


def test_actions_happen_at_their_time() -> None:
    flight, _ = flight_of()
    done: list[float] = []
    flight.at(1.23, lambda: done.append(flight.now_s))
    flight.run(1.0)
    assert done == []
    flight.run(1.0)
    assert done == [1.23]
    flight.at(0.5, lambda: done.append(flight.now_s))
    flight.run(0.1)
    assert done == [1.23, 2.0]


def test_a_killed_companion_is_silent_and_a_new_one_knows_nothing() -> None:
    flight, watcher = flight_of()
    run_until(flight, lambda: flight.companion.session.phase is Phase.NORMAL, 60.0)
    old = flight.companion
    flight.kill_companion()
    killed_s = flight.now_s
    flight.run(2.0)
    assert watcher.times("sent", killed_s) == watcher.times("heard", killed_s) == []
    flight.start_companion()
    assert flight.companion is not old
    assert flight.companion.session.phase is Phase.WAITING
    flight.run(2.0)
    assert watcher.times("sent", killed_s)
    assert watcher.times("ended") == [killed_s]
    assert watcher.times("started") == [killed_s + 2.0]


def test_a_suspended_companion_hears_late_what_its_socket_held() -> None:
    flight, watcher = flight_of()
    flight.run(3.0)
    flight.suspend_companion(1.5)
    flight.run(1.4)
    assert watcher.times("ticked", 3.0) == watcher.times("heard", 3.0) == []
    flight.run(0.2)
    heard = watcher.times("heard", 3.0)
    assert min(heard) == pytest.approx(4.5, abs=0.021)
    assert heard.count(min(heard)) > 50


def test_a_stopped_companion_hands_back_and_ends() -> None:
    flight, watcher = flight_of()
    run_until(flight, lambda: flight.companion.session.phase is Phase.NORMAL, 60.0)
    flight.stop_companion()
    flight.run(2.0)
    assert not flight.is_companion_up
    assert len(watcher.times("ended")) == 1


def test_a_pulled_cable_carries_nothing() -> None:
    flight, watcher = flight_of()
    flight.run(3.0)
    flight.is_link_up = False
    flight.run(1.0)
    assert watcher.times("heard", 3.0) == watcher.times("vehicle heard", 3.0) == []
    assert watcher.times("vehicle sent", 3.0)


def test_what_never_holds_is_reported() -> None:
    flight, _ = flight_of()
    with pytest.raises(TimeoutError, match="within 2 s"):
        run_until(flight, lambda: False, 2.0)


def test_an_operator_takes_off_and_the_vehicle_reboots_on_the_ground() -> None:
    flight, _ = flight_of(CompanionConfig())
    take_off(flight, Operator(flight), 12.0)
    assert flight.sim.vehicle.body.height_m == pytest.approx(12.0, abs=0.5)
    reboot(flight)
    flight.run(1.0)
    assert flight.sim.vehicle.body.is_on_ground
    assert not flight.sim.vehicle.is_armed
