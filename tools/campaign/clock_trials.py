"""Trials of clocks: canonical searches with an autopilot whose clock is slow or fast, and slips.

Each flight draws a rate, and one to three slips from its first climb to its end. A flight is good
if it reports within 1.5 m, stays inside the fence, holds on a stale position for at most 6 s, and
mistakes no slip for a restart or for another source of setpoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.config.schema import CompanionConfig
from companion.guidance.commands import SessionParams
from sim_link.autopilot.incidents import ClockRate, ClockSlip
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.lockstep import Flight, MemoryJournal
from tools.campaign.flights import Dice, Part, Trial, TrialOutcome, flavour_of, story_lines

RATES = (0.95, 0.988, 1.0, 1.05)
SLIPS_S = (-2.0, -0.7, 1.0, 5.0)
FIRST_SLIP_S, LAST_SLIP_S = 5.0, 40.0
"""Times of slips; a clock that goes back to its first second looks like that of a restarted
autopilot."""
MAX_SLIPS = 3
FLIGHT_S, FENCE_M = 180.0, 150.0
LONGEST_HOLD_S, WORST_ERROR_M = 6.0, 1.5
FALSE_ALARMS = ("autopilot restarted", "control yielded", "second source", "control lost")


def holds_s(texts: Sequence[tuple[float, str]], ended_s: float) -> list[float]:
    """Return the duration of each hold on a stale position, from the operator's texts."""
    begun_s, lengths_s = None, []
    for time_s, text in texts:
        if text == "hold: vehicle position is stale":
            begun_s = time_s
        elif begun_s is not None and text.startswith(("following the plan", "localised")):
            lengths_s.append(time_s - begun_s)
            begun_s = None
    return lengths_s if begun_s is None else [*lengths_s, ended_s - begun_s]


def incidents_of(seed: int) -> tuple[ClockRate | ClockSlip, ...]:
    """Return the clock's incidents in the flight of a seed: a rate, and slips."""
    dice = Dice(np.random.default_rng((seed, 0xC10C)))
    rate = ClockRate(rate=dice.one(RATES))
    slips = [
        ClockSlip(start_s=dice.number(FIRST_SLIP_S, LAST_SLIP_S), step_s=dice.one(SLIPS_S))
        for _ in range(dice.one(range(1, MAX_SLIPS + 1)))
    ]
    return rate, *sorted(slips, key=lambda slip: slip.start_s)


def fly(trial: Trial) -> TrialOutcome:
    """Fly the canonical search of a trial, and judge it."""
    incidents, notes, farthest_m = incidents_of(trial.seed), MemoryJournal(), 0.0
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour_of(trial.seed)), incidents=incidents
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    flight = Flight(config, scenario, trial.seed, notes)
    while not notes.results and flight.now_s < FLIGHT_S:
        flight.step()
        east_m, north_m, _ = flight.sim.vehicle.body.position_enu_m
        farthest_m = max(farthest_m, abs(east_m), abs(north_m))
    error_m = math.inf
    if notes.results:
        position_m = notes.results[0][1].estimate.position_enu_m
        error_m = math.dist(position_m, scenario.emitter.position_enu_m)
    hold_s = max(holds_s(notes.texts, flight.now_s), default=0.0)
    most = {"clock_hold_s": hold_s, "clock_farthest_m": farthest_m}
    return TrialOutcome(
        trial,
        tuple(faults_of(error_m, hold_s, farthest_m, [text for _, text in notes.texts])),
        sums={"clock_flights": 1.0},
        most=most | ({"clock_error_m": error_m} if math.isfinite(error_m) else {}),
        story=(str(incidents), *story_lines(notes.texts)),
    )


def faults_of(error_m: float, hold_s: float, farthest_m: float, texts: Sequence[str]) -> list[str]:
    """Return the texts of a flight's violated conditions; an infinite error: no report."""
    found = [f"{alarm!r}" for alarm in FALSE_ALARMS if any(alarm in text for text in texts)]
    if error_m > WORST_ERROR_M:
        found.append(f"{error_m:.2f} m off" if math.isfinite(error_m) else "nothing reported")
    if hold_s > LONGEST_HOLD_S:
        found.append(f"held for {hold_s:.1f} s")
    if farthest_m > FENCE_M:
        found.append(f"{farthest_m:.1f} m away")
    return found


CLOCKS = Part("clocks", "searches with slow, fast and slipping clocks", run=fly, cost_s=4.0)
