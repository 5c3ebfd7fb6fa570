"""Random missions with one to four faults each, every invariant watched."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.domain import FlightMode
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.mission_case import FLIGHT_S, MissionCase, mission_case
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.faults.schedule import fields_of

SAID = 400
"""Characters of the story's texts."""


class Missions:
    """The part of the campaign that flies missions."""

    name = "missions"
    title = "random missions with 1 to 4 faults"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many missions."""
        return [Trial(self.name, trial_seed(seed, index)) for index in range(round(amount))]

    def cost(self, trial: Trial) -> float:  # noqa: ARG002
        """Seconds of one core."""
        return 0.8

    def run(self, trial: Trial) -> Outcome:
        """Fly one."""
        case = mission_case(trial.seed)
        flown = fly(case)
        return outcome_of(trial, case, flown)


def fly(case: MissionCase) -> Monitored:
    """Fly a mission to its end."""
    around = monitored(case.config, case.scenario, case.seed, is_signed=case.is_signed)
    flight = around.flight
    if case.is_operated:
        _take_off(around)
    else:
        flight.run(5.0)
    around.injector.inject(case.schedule)
    if case.regrant_s is not None:
        flight.at(flight.now_s + case.regrant_s, lambda: _give_again(around))
    flight.run(FLIGHT_S)
    return around


def _take_off(around: Monitored) -> None:
    """The operator takes off and gives the mode, in the order that the autopilot wants."""
    flight, operator = around.flight, around.operator
    flight.run(3.0)
    is_px4 = flight.scenario.autopilot.flavour == "px4"
    if not is_px4:
        operator.choose(FlightMode.OFFBOARD)
    operator.arm()
    height_m = flight.config.mission.altitude_m
    up_m = flight.scenario.origin.altitude_m + height_m if is_px4 else height_m
    operator.command(22, *[math.nan if is_px4 else 0.0] * 6, up_m)
    flight.run(12.0)
    if is_px4:
        operator.choose(FlightMode.OFFBOARD)


def _give_again(around: Monitored) -> None:
    """The operator gives control again, if the vehicle flies and somebody else has it."""
    flight = around.flight
    if not flight.sim.vehicle.is_armed or flight.mode is FlightMode.OFFBOARD:
        return
    around.operator.grant()
    flight.at(flight.now_s + 3.0, lambda: around.operator.choose(FlightMode.OFFBOARD))


def outcome_of(trial: Trial, case: MissionCase, flown: Monitored) -> Outcome:
    """What a mission found."""
    monitor, flight = flown.monitor, flown.flight
    closest = monitor.fence.closest_m
    return Outcome(
        trial,
        findings_of(monitor.violations),
        sums={
            "missions": 1.0,
            "fence_breaches": float(monitor.fence.breaches),
            "mission_hours": flight.now_s / 3600.0,
            "localised": float(bool(flown.notes.results)),
            "engaged": float(math.isfinite(closest)),
        },
        most={"send_gap_s": monitor.stream.worst_gap_s},
        least={"closest_approach_m": closest} if math.isfinite(closest) else {},
        story=_story(case, flown),
    )


def _story(case: MissionCase, flown: Monitored) -> tuple[str, ...]:
    lines = [str(case)]
    lines += [f"fault {fields_of(fault)}" for fault in case.schedule.faults]
    lines += [f"{time_s:8.2f} s  {text}"[:SAID] for time_s, text in flown.notes.texts]
    return tuple(lines)
