"""A random mission: place, vehicle, weather, link, companion, faults and people, from one seed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.config.schema import (
    CompanionConfig,
    CrossingKind,
    LimitsConfig,
    PatternKind,
    PlannerConfig,
)
from companion.guidance.session_params import SessionParams
from companion.link.binding import VehicleParams as CompanionVehicle
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.draws import Dice, random_fault
from sim_link.campaign.places import PLACES, Place, emitter_of
from sim_link.faults.kinds import Fault
from sim_link.faults.link_kinds import LinkDelay
from sim_link.faults.schedule import Schedule
from sim_link.world.environment import EmitterParams
from sim_link.world.point_mass import VehicleParams, WindParams

MOST_FAULTS = 4
LATENCY_S = 0.5
"""Of both directions together."""
WIND_MPS = 12.0
SPEEDS_MPS = (3.0, 5.0, 8.0, 10.0)
PLANNERS: tuple[CrossingKind | PatternKind, ...] = (
    "latched_crossing",
    "latched_crossing",
    "reactive_crossing",
    "fim",
    "lawnmower",
    "expanding_square",
    "sector",
)
SIGNED_SHARE = 0.3
OPERATED_SHARE = 0.4
ALTITUDE_M = 15.0
FLIGHT_S = 50.0
"""From the moment at which the schedule begins."""


@dataclass(frozen=True, slots=True)
class MissionCase:
    """Everything that one random mission is made of."""

    seed: int
    place: Place
    config: CompanionConfig
    scenario: Scenario
    schedule: Schedule
    is_signed: bool
    is_operated: bool
    """An operator takes off and gives the mode; otherwise the companion launches by itself."""
    regrant_s: float | None
    """So long after the schedule began the operator gives control again; None: never."""

    def __str__(self) -> str:
        flavour, wind = self.scenario.autopilot.flavour, self.scenario.wind
        speed = math.hypot(wind.east_mps, wind.north_mps)
        limits = self.config.limits
        return (
            f"{flavour}, {self.place.name}, {self.config.planner.kind}, {limits.speed_mps:g} m/s, "
            f"wind {speed:.0f} m/s, {self.config.vehicle.setpoint}"
            f"{', signed' if self.is_signed else ''}{', operated' if self.is_operated else ''}"
        )


def mission_case(seed: int) -> MissionCase:
    """The mission of a seed."""
    rng = np.random.default_rng((seed, 0xF11))
    dice = Dice(rng)
    place = dice.one(PLACES)
    flavour: FlavourName = "px4" if dice.happens(0.5) else "ardupilot"
    scenario = _scenario(dice, place, emitter_of(place, rng), flavour)
    is_operated = dice.happens(OPERATED_SHARE)
    config = _config(dice, place, is_operated=is_operated)
    is_signed = dice.happens(SIGNED_SHARE)
    faults: list[Fault] = [random_fault(rng) for _ in range(1 + int(rng.integers(MOST_FAULTS)))]
    latency_s = dice.number(0.0, LATENCY_S)
    share = dice.number(0.0, 1.0)
    delays: list[Fault] = [
        LinkDelay(delay_s=latency_s * share, direction="to_companion"),
        LinkDelay(delay_s=latency_s * (1.0 - share), direction="to_vehicle"),
    ]
    return MissionCase(
        seed=seed,
        place=place,
        config=config,
        scenario=scenario,
        schedule=Schedule(faults=tuple(delays + faults)),
        is_signed=is_signed,
        is_operated=is_operated,
        regrant_s=dice.number(15.0, 40.0) if dice.happens(0.5) else None,
    )


def _scenario(
    dice: Dice, place: Place, emitter: tuple[float, float], flavour: FlavourName
) -> Scenario:
    heading = dice.number(-math.pi, math.pi)
    wind_mps = dice.one((0.0, dice.number(0.0, WIND_MPS), WIND_MPS))
    return Scenario(
        start_enu_m=place.start_enu_m,
        emitter=EmitterParams(position_enu_m=emitter),
        autopilot=AutopilotParams(flavour=flavour),
        vehicle=VehicleParams(max_speed_mps=12.0),
        wind=WindParams(
            east_mps=wind_mps * math.cos(heading),
            north_mps=wind_mps * math.sin(heading),
            gust_sigma_mps=dice.one((0.0, 2.0)),
        ),
    )


def _config(dice: Dice, place: Place, *, is_operated: bool) -> CompanionConfig:
    limits = LimitsConfig(
        fence_enu_m=place.fence_enu_m,
        keep_out_enu_m=place.keep_out_enu_m,
        speed_mps=dice.one(SPEEDS_MPS),
        altitude_max_m=40.0,
    )
    mission = SessionParams(
        engage="operator" if is_operated else "auto", altitude_m=ALTITUDE_M, stop_confirm_s=3.0
    )
    kind = dice.one(PLANNERS)
    config = CompanionConfig(
        mission=mission,
        limits=limits,
        planner=PlannerConfig(kind=kind),
        vehicle=CompanionVehicle(setpoint=dice.one(("local_ned", "global_int"))),
    )
    if kind not in ("lawnmower", "expanding_square", "sector") and dice.happens(0.3):
        planner = msgspec.structs.replace(config.planner, search="expanding_square")
        config = msgspec.structs.replace(config, planner=planner)
    return config
