"""Canonical searches with an autopilot whose clock is slow or fast, and slips at random times.

Each flight draws a rate, and one to three slips from its first climb to its end. A flight is good
if it reports within 1.5 m, stays inside the fence, holds on a stale position for at most 6 s, and
mistakes no slip for a restart or for another source of setpoints. Exit code 1 if a flight was not
good, each with the command that flies it again; 130 after Ctrl-C, with the flights until then.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import sys
from collections.abc import Sequence
from dataclasses import dataclass

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # as on a vehicle, without a minute of compiling

from companion.config.schema import CompanionConfig
from companion.domain import PositionEnu
from companion.entry import ignore_broken_pipe
from companion.guidance.session_params import SessionParams
from sim_link.autopilot.incidents import ClockRate, ClockSlip, Incident
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.lockstep import Flight, MemoryJournal
from sim_link.lab.observer import Observer
from sim_link.lab.pool import open_pool
from tools.console import OneLineParser, positive, shown

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
RATES = (0.95, 0.988, 1.0, 1.05)
SLIPS_S = (-2.0, -0.7, 1.0, 5.0)
FIRST_SLIP_S, LAST_SLIP_S = 5.0, 40.0
"""A clock that goes back to its first second looks like that of a restarted autopilot."""
MOST_SLIPS = 3
FLIGHT_S, FENCE_M = 180.0, 150.0
LONGEST_HOLD_S, WORST_ERROR_M = 6.0, 1.5
FALSE_ALARMS = ("autopilot restarted", "control yielded", "second source", "control lost")
INTERRUPTED = 130
REPLAY = "python tools/campaign/clock_campaign.py --replay"


@dataclass(frozen=True, slots=True)
class ClockFlight:
    """Result of one flight."""

    flavour: FlavourName
    seed: int
    rate: float
    slips: tuple[tuple[float, float], ...]
    """Time and size of each slip, in s."""
    error_m: float | None
    """Error of the report; None: nothing was reported."""
    longest_hold_s: float
    farthest_m: float
    """East or north of home."""
    alarms: tuple[str, ...]

    @property
    def faults(self) -> list[str]:
        """Return the violated conditions, in words."""
        found = [f"{alarm!r}" for alarm in self.alarms]
        if self.error_m is None:
            found.append("nothing reported")
        elif self.error_m > WORST_ERROR_M:
            found.append(f"{self.error_m:.2f} m off")
        if self.longest_hold_s > LONGEST_HOLD_S:
            found.append(f"held for {self.longest_hold_s:.1f} s")
        if self.farthest_m > FENCE_M:
            found.append(f"{self.farthest_m:.1f} m away")
        return found


class Reach(Observer):
    """Largest true distance of the vehicle, east or north."""

    def __init__(self) -> None:
        self.farthest_m = 0.0

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:  # noqa: ARG002  the protocol
        """Update it with the vehicle's position."""
        place: PositionEnu = vehicle.body.position_enu_m
        self.farthest_m = max(self.farthest_m, abs(place[0]), abs(place[1]))


def holds_s(texts: Sequence[tuple[float, str]], ended_s: float) -> list[float]:
    """Return the duration of each hold on a stale position, from the operator's texts."""
    begun_s, lengths_s = None, []
    for time_s, text in texts:
        if text == "hold: vehicle position is stale":
            begun_s = time_s
        elif begun_s is not None and text.startswith(("flying the plan", "localised")):
            lengths_s.append(time_s - begun_s)
            begun_s = None
    return lengths_s if begun_s is None else [*lengths_s, ended_s - begun_s]


def incidents_of(name: str) -> list[Incident]:
    """Return the clock's incidents in the flight of a name."""
    dice = random.Random(name)
    rate = dice.choice(RATES)
    slips = [
        ClockSlip(start_s=dice.uniform(FIRST_SLIP_S, LAST_SLIP_S), step_s=dice.choice(SLIPS_S))
        for _ in range(dice.randint(1, MOST_SLIPS))
    ]
    return [ClockRate(rate=rate), *sorted(slips, key=lambda slip: slip.start_s)]


def fly(name: str, notes: MemoryJournal | None = None) -> ClockFlight:
    """Fly the canonical search of a name, such as px4:17."""
    logging.disable(logging.CRITICAL)
    notes = notes or MemoryJournal()
    flavour, seed = parse(name)
    rate, *slips = incidents_of(name)
    assert isinstance(rate, ClockRate)
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour), incidents=tuple(incidents_of(name))
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    flight, reach = Flight(config, scenario, seed, notes), Reach()
    flight.observers.append(reach)
    while not notes.results and flight.now_s < FLIGHT_S:
        flight.step()
    error_m = None
    if notes.results:
        east_m, north_m = notes.results[0][1].estimate.position_enu_m
        true = scenario.emitter.position_enu_m
        error_m = ((east_m - true[0]) ** 2 + (north_m - true[1]) ** 2) ** 0.5
    return ClockFlight(
        flavour,
        seed,
        rate.rate,
        tuple((slip.start_s, slip.step_s) for slip in slips if isinstance(slip, ClockSlip)),
        error_m,
        max(holds_s(notes.texts, flight.now_s), default=0.0),
        reach.farthest_m,
        tuple(alarm for alarm in FALSE_ALARMS if any(alarm in text for _, text in notes.texts)),
    )


def parse(name: str) -> tuple[FlavourName, int]:
    """Return flavour and seed of a flight's name; a ValueError if it is invalid."""
    flavour, _, seed = name.partition(":")
    if flavour not in FLAVOURS or not seed.isdecimal():
        raise argparse.ArgumentTypeError(f"{name!r} is no flight such as px4:17")
    return next(each for each in FLAVOURS if each == flavour), int(seed)


def row(title: str, flights: Sequence[ClockFlight]) -> str:
    """Return a line of the table."""
    errors_m = [each.error_m for each in flights if each.error_m is not None]
    hold_s = max((each.longest_hold_s for each in flights), default=0.0)
    outside = sum(each.farthest_m > FENCE_M for each in flights)
    alarms = sum(bool(each.alarms) for each in flights)
    worst = f"{max(errors_m):8.2f}" if errors_m else f"{'-':>8}"
    return f"{title:20}{len(flights):8}{len(errors_m):10}{worst}{hold_s:8.2f}{outside:9}{alarms:14}"


def report(flights: Sequence[ClockFlight]) -> int:
    """Print the table, and the commands that repeat flights with faults; return the exit code."""
    print(f"{'':20}{'flights':>8}{'reported':>10}{'worst m':>8}{'hold s':>8}", end="")
    print(f"{'outside':>9}{'false alarms':>14}")
    for flavour in FLAVOURS:
        for rate in RATES:
            chosen = [f for f in flights if (f.flavour, f.rate) == (flavour, rate)]
            print(row(f"{flavour} at {rate:g}", chosen))
    print(row("all", flights))
    bad = [flight for flight in flights if flight.faults]
    for flight in bad:
        name = f"{flight.flavour}:{flight.seed}"
        print(f"FOUND {', '.join(flight.faults)}\n      {REPLAY} {name}", file=sys.stderr)
    return int(bool(bad))


def main(argv: Sequence[str] | None = None) -> int:
    """Fly them all, or one again; return the exit code."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flights", type=positive, default=200, metavar="N", help="each flavour")
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--replay", metavar="FLAVOUR:SEED", help="one flight, with its texts")
    arguments = parser.parse_args(argv)
    if arguments.replay is not None:
        try:
            parse(arguments.replay)
        except argparse.ArgumentTypeError as error:
            parser.error(str(error))
        notes = MemoryJournal()
        flight = fly(arguments.replay, notes)
        print(*(f"{time_s:8.2f} {text}" for time_s, text in notes.texts), sep="\n")
        print(flight)
        return int(bool(flight.faults))
    names = [f"{flavour}:{seed}" for seed in range(arguments.flights) for flavour in FLAVOURS]
    flights: dict[int, ClockFlight] = {}
    try:
        with shown(len(names), sys.stderr) as done, open_pool(jobs=arguments.jobs) as pool:
            for number, flight in pool.results(fly, names):
                flights[number] = flight
                done(1.0)
    except KeyboardInterrupt:
        report([flights[number] for number in sorted(flights)])
        return INTERRUPTED
    return report([flights[number] for number in sorted(flights)])


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
