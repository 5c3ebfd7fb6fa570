"""Faults that happen to a whole flight, seen in the truth and on the wire."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from sim_link.autopilot.incidents import (
    BatteryCharge,
    EkfJump,
    Failsafe,
    OriginShift,
    PilotMode,
    VehicleReboot,
    WindChange,
)
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.faults.fault_models import (
    CompanionKilled,
    CompanionStalled,
    CompanionTerminated,
    Disarm,
    Fault,
    ForgedFrames,
    LinkBlackout,
    ModeFlap,
    Schedule,
    SecondSender,
)
from sim_link.lab.faults.faulty_link import FaultyLink, Injector
from sim_link.lab.lockstep import Flight, MemoryJournal, Operator
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import run_until

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))


class Ears(Observer):
    """Record of the frames that the companion received."""

    def __init__(self) -> None:
        self.genuine: list[float] = []
        self.forged: list[float] = []

    def heard(self, frame: Frame) -> None:
        (self.genuine if frame.is_genuine else self.forged).append(frame.time_s)


def flown(*faults: Fault, seed: int = 1) -> tuple[Flight, Ears, float]:
    """An engaged flight, in which faults begin now."""
    link = FaultyLink(Schedule(), seed)
    flight, ears = Flight(AUTO, Scenario(), seed, MemoryJournal(), wire=link), Ears()
    injector = Injector(flight, link, Operator(flight))
    flight.observers.append(ears)
    run_until(flight, lambda: flight.companion.session.phase is Phase.NORMAL, 60.0)
    injector.inject(Schedule(faults=faults))
    return flight, ears, flight.now_s


@pytest.mark.slow
def test_a_fault_of_the_link_counts_from_now() -> None:
    flight, ears, began_s = flown(LinkBlackout(start_s=1.0, duration_s=1.0))
    flight.run(3.0)
    heard = [t - began_s for t in ears.genuine]
    assert not [t for t in heard if 1.02 <= t < 2.0]
    assert [t for t in heard if 0.0 < t < 1.0]
    assert [t for t in heard if t > 2.0]


@pytest.mark.slow
@pytest.mark.parametrize("fault", [PilotMode(mode=FlightMode.RETURN), Failsafe()])
def test_the_mode_leaves(fault: Fault) -> None:
    flight, _, _ = flown(fault)
    flight.run(0.1)
    assert flight.mode is FlightMode.RETURN


@pytest.mark.slow
def test_the_mode_flaps_and_ends_foreign_or_ours() -> None:
    flight, _, _ = flown(ModeFlap(period_s=0.5, duration_s=2.0))
    modes = []
    for _ in range(10):
        flight.run(0.25)
        modes.append(flight.mode)
    assert FlightMode.HOLD in modes
    assert FlightMode.OFFBOARD in modes


@pytest.mark.slow
def test_the_vehicle_reboots_and_falls() -> None:
    flight, _, _ = flown(VehicleReboot(down_s=0.5))
    flight.run(10.0)
    assert flight.sim.vehicle.body.is_on_ground
    assert not flight.sim.vehicle.is_armed


@pytest.mark.slow
def test_motors_stop() -> None:
    flight, _, _ = flown(Disarm())
    flight.run(0.1)
    assert not flight.sim.vehicle.is_armed


@pytest.mark.slow
def test_the_estimate_jumps_and_the_origin_moves() -> None:
    flight, _, _ = flown(EkfJump(east_m=7.0))
    flight.run(0.1)
    assert flight.sim.vehicle.estimator.bias_enu_m[0] == pytest.approx(7.0)
    flight, _, _ = flown(OriginShift(east_m=10.0))
    before = flight.sim.vehicle.origin
    flight.run(0.1)
    position = flight.sim.vehicle.origin
    moved = before.enu_from_geodetic(
        position.latitude_deg, position.longitude_deg, position.altitude_m
    )
    assert moved[0] == pytest.approx(10.0, abs=0.02)


def test_the_wind_blows_and_calms_down() -> None:
    flight, _, _ = flown(WindChange(east_mps=12.0, duration_s=2.0))
    flight.run(1.0)
    assert flight.sim.vehicle.body.wind.east_mps == 12.0
    flight.run(2.0)
    assert flight.sim.vehicle.body.wind.east_mps == 0.0


def test_the_battery_drops() -> None:
    flight, _, _ = flown(BatteryCharge(share=0.1))
    flight.run(0.1)
    assert flight.sim.vehicle.battery.share == pytest.approx(0.1, abs=0.01)


def test_another_system_sends_setpoints() -> None:
    flight, _, _ = flown(SecondSender(east_m=-40.0, north_m=-40.0, rate_hz=50.0, duration_s=0.5))
    flight.is_link_up = False
    flight.run(0.4)
    goal_enu_m = flight.sim.vehicle.aircraft.controller.goal_enu_m
    assert goal_enu_m is not None
    assert math.dist(goal_enu_m[:2], (-40.0, -40.0)) < 0.01


@pytest.mark.slow
def test_the_companion_is_killed_and_started_again() -> None:
    flight, ears, began_s = flown(CompanionKilled(start_s=1.0, down_s=2.0))
    old = flight.companion
    flight.run(2.0)
    assert not flight.is_companion_up
    flight.run(2.0)
    assert flight.is_companion_up
    assert flight.companion is not old
    assert not [t for t in ears.genuine if began_s + 1.01 < t < began_s + 3.0]


@pytest.mark.slow
def test_the_companion_is_suspended() -> None:
    flight, ears, began_s = flown(CompanionStalled(duration_s=1.0))
    flight.run(2.0)
    assert not [t for t in ears.genuine if began_s < t < began_s + 0.99]


def test_the_companion_is_reported_to_end() -> None:
    flight, _, _ = flown(CompanionTerminated())
    flight.run(2.0)
    assert not flight.is_companion_up
    assert flight.mode is FlightMode.HOLD


@pytest.mark.slow
def test_an_attacker_sends_at_its_rate_and_its_frames_are_no_genuine_ones() -> None:
    flight, ears, _ = flown(ForgedFrames(rate_hz=500.0, duration_s=2.0))
    flight.run(3.0)
    assert len(ears.forged) == pytest.approx(1000, abs=12)
