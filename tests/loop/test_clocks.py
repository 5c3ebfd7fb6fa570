"""Flights with an autopilot whose clock is slow, fast, slips or stands still."""

from __future__ import annotations

import random

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.phases import Phase
from sim_link.autopilot.incidents import AutopilotStall, ClockRate, ClockSlip, Incident
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import AUTO, Loop, outside

pytestmark = pytest.mark.slow

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
FLIGHT_S, FENCE_M = 180.0, 150.0
LONGEST_PAUSE_S = 6.0


def flight(flavour: FlavourName, *incidents: Incident, seed: int = 1) -> Loop:
    """The canonical search, until something is reported."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour), incidents=incidents)
    loop = Loop(AUTO, scenario, seed)
    loop.run_until(lambda: bool(loop.notes.results), FLIGHT_S)
    return loop


def holds_s(loop: Loop) -> list[float]:
    """Return the length of each hold on a stale position, by the texts to the operator."""
    begun_s, lengths_s = None, []
    for time_s, text in loop.notes.texts:
        if text == "hold: vehicle position is stale":
            begun_s = time_s
        elif begun_s is not None and text.startswith(("following the plan", "localised")):
            lengths_s.append(time_s - begun_s)
            begun_s = None
    return lengths_s if begun_s is None else [*lengths_s, loop.now_s - begun_s]


def check(loop: Loop) -> None:
    """Assert a good report, a flight inside, no long hold, and no supposed restart."""
    assert len(loop.notes.results) == 1, loop.notes.texts
    assert loop.error_m <= 1.5
    assert max(holds_s(loop), default=0.0) <= LONGEST_PAUSE_S, loop.notes.texts
    assert not loop.said("autopilot restarted")
    assert not loop.said("control yielded")
    assert outside(loop.true_positions, FENCE_M) == []


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("rate", [0.95, 0.988, 1.05])
def test_a_slow_or_fast_clock_costs_nothing(flavour: FlavourName, rate: float) -> None:
    loop = flight(flavour, ClockRate(rate=rate))
    check(loop)
    assert holds_s(loop) == []
    assert not loop.said("link delay jumped")


@pytest.mark.parametrize("rate", [0.95, 0.988, 1.05])
def test_on_the_ground_setpoints_flow_for_minutes_by_any_clock(rate: float) -> None:
    scenario = Scenario(incidents=(ClockRate(rate=rate),))
    loop = Loop(CompanionConfig(), scenario)
    loop.run(100.0)
    assert loop.phase is Phase.STANDBY
    assert len(loop.setpoints_since(40.0)) == pytest.approx(1200, abs=5)
    assert not loop.said("not ready")


def test_setpoints_that_stop_on_the_ground_say_why_at_once() -> None:
    loop = Loop(CompanionConfig(), Scenario())
    loop.run(5.0)
    loop.is_link_up = False
    loop.run(0.7)
    stopped_s = loop.now_s
    assert loop.said("not ready: vehicle position is stale; setpoints stopped")
    loop.run(10.0)
    assert loop.setpoints_since(stopped_s) == []
    assert loop.said("not ready: autopilot link lost")
    loop.is_link_up = True
    loop.run(6.0)
    assert loop.said("ready again: switch to offboard mode")
    assert loop.setpoints_since(loop.now_s - 1.0)


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("step_s", [-2.0, -0.7, 1.0, 5.0])
def test_a_slip_costs_seconds_not_the_search(flavour: FlavourName, step_s: float) -> None:
    loop = flight(flavour, ClockSlip(start_s=18.0, step_s=step_s))
    check(loop)
    assert loop.said("link delay jumped")


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("still_s", [0.3, 1.2])
def test_an_autopilot_that_stood_still_is_guided_on(flavour: FlavourName, still_s: float) -> None:
    check(flight(flavour, AutopilotStall(start_s=18.0, duration_s=still_s)))


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_an_autopilot_that_stands_still_in_pieces_is_guided_on(flavour: FlavourName) -> None:
    pieces = ((18.0, 0.06), (18.3, 0.2), (18.7, 1.1))
    check(
        flight(flavour, *(AutopilotStall(start_s=at_s, duration_s=for_s) for at_s, for_s in pieces))
    )


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("seconds", [6.0, 20.0])
def test_a_busy_computer_of_the_autopilot_is_named_and_ends_nothing(
    flavour: FlavourName, seconds: float
) -> None:
    loop = flight(flavour, ClockRate(rate=0.9, start_s=18.0, duration_s=seconds))
    check(loop)
    assert loop.said("% slow: its computer is too busy")
    assert not loop.said("measurements rejected")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_an_autopilot_at_twice_real_time_is_named_and_flown_on_when_it_slows_down(
    flavour: FlavourName,
) -> None:
    loop = flight(flavour, ClockRate(rate=2.0, start_s=18.0, duration_s=6.0))
    assert loop.said(
        "autopilot's clock runs at 2 times real time: start the companion with --speed 2"
    )
    resumed_s = [
        time_s for time_s, text in loop.notes.texts if text.startswith("following the plan")
    ]
    assert resumed_s[-1] <= 18.0 + 6.0 + 3.0
    assert len(loop.notes.results) == 1
    assert loop.error_m <= 1.5


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_slow_clocks_slip_too(flavour: FlavourName) -> None:
    rng = random.Random(4)
    for seed, rate in enumerate((0.95, 0.988, 1.05)):
        times_s = [rng.uniform(12.0, 30.0) for _ in range(2)]
        slips = [ClockSlip(start_s=t, step_s=rng.choice((-2.0, -0.7, 1.0, 5.0))) for t in times_s]
        check(flight(flavour, ClockRate(rate=rate), *slips, seed=seed))
