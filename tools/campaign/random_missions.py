"""Random missions with one to four faults each, and pilot overrides at random instants.

A random mission is site, vehicle, weather, link, companion, faults and people, all from one seed.
After an override nothing may be sent once the frame that shows it has arrived.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.config import schema
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.link.interface import VehicleParams
from companion.search.detection_model import DetectionModel
from companion.search.searched_flight import SearchAreaParams
from sim_link.autopilot.incidents import FaultRecord, PilotMode
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import LinkDelay, LinkJitter, LinkLoss, Schedule
from sim_link.world.environment import EmitterParams
from sim_link.world.point_mass import MulticopterParams, WindParams
from tools.campaign import flights
from tools.study.searched_area import box

Corners = tuple[tuple[float, float], ...]


def fields_of(fault: FaultRecord) -> dict[str, object]:
    """Return the mapping of a fault without default values."""
    usual = msgspec.to_builtins(type(fault)())
    fields: dict[str, object] = msgspec.to_builtins(fault)
    return {name: value for name, value in fields.items() if name == "kind" or value != usual[name]}


@dataclass(frozen=True, slots=True)
class Site:
    """A fence, its keep-outs, the start, and the area of the emitter."""

    name: str
    fence_enu_m: Corners
    keep_out_enu_m: tuple[Corners, ...]
    start_enu_m: tuple[float, float]
    emitter_box_m: tuple[float, float, float, float]
    """West, south, east and north bounds of the emitter, m; may extend beyond the fence."""


NOTCH: Corners = ((-20, -20), (100, -20), (100, 30), (45, 30), (45, 100), (-20, 100))
WEDGE: Corners = ((-25, -25), (120, -10), (40, 50), (-10, 120))
MASTS = (box(38, 20, 46, 34), ((60, 60), (75, 62), (66, 78)), box(20, 70, 24, 74))


SITES = (
    Site("field", box(-40, -40, 110, 110), (), (10, 10), (-45, -45, 115, 115)),
    Site("close", box(-15, -15, 60, 60), (), (10, 10), (-10, -10, 70, 70)),
    Site("notch", NOTCH, (), (10, 10), (-15, -15, 95, 95)),
    Site("masts", box(-30, -30, 110, 110), MASTS, (10, 10), (0, 0, 100, 100)),
    Site("wedge", WEDGE, (), (5, 5), (-20, -20, 110, 110)),
    Site("strip", box(-20, -20, 140, 25), (), (0, 0), (10, -25, 150, 30)),
)


def emitter_of(site: Site, rng: np.random.Generator) -> tuple[float, float]:
    """Return a position in its box, away from the vehicle."""
    west, south, east, north = site.emitter_box_m
    while True:
        e, n = float(rng.uniform(west, east)), float(rng.uniform(south, north))
        if math.dist((e, n), site.start_enu_m) > 8.0:
            return e, n


MAX_FAULTS = 4
LATENCY_S = 0.5
WIND_MPS = 12.0
SPEEDS_MPS = (3.0, 5.0, 8.0, 10.0)
PLANNERS: tuple[schema.CrossingKind | schema.PatternKind, ...] = (
    "latched_crossing",
    "latched_crossing",
    "fim",
    "lawnmower",
    "expanding_square",
    "sector",
)
SIGNED_SHARE = 0.3
OPERATED_SHARE = 0.4
REACH_M = 25.0
"""Reach of the radio in searches by probability: from most start positions the emitter is not
heard."""
ALTITUDE_M = 15.0
FLIGHT_S = 50.0
"""Flight time from the beginning of the schedule."""


@dataclass(frozen=True, slots=True)
class MissionCase:
    """All parameters of one random mission."""

    seed: int
    site: Site
    config: schema.CompanionConfig
    scenario: Scenario
    schedule: Schedule
    is_signed: bool
    is_operated: bool
    """True if an operator takes off and selects the mode, False if the companion launches."""
    regrant_s: float | None
    """Time from the start of the schedule to the next hand-over of control, s; None: never."""

    def __str__(self) -> str:
        flavour, wind = self.scenario.autopilot.flavour, self.scenario.wind
        speed = math.hypot(wind.east_mps, wind.north_mps)
        limits = self.config.limits
        return (
            f"{flavour}, {self.site.name}, {self.config.planner.flown}, {limits.speed_mps:g} m/s, "
            f"wind {speed:.0f} m/s, {self.config.vehicle.setpoint}"
            f"{', signed' if self.is_signed else ''}{', operated' if self.is_operated else ''}"
        )


def mission_case(seed: int) -> MissionCase:
    """Return the mission of a seed."""
    rng = np.random.default_rng((seed, 0xF11))
    dice = flights.Dice(rng)
    site = dice.one(SITES)
    flavour = dice.flavour()
    scenario = _scenario(dice, site, emitter_of(site, rng), flavour)
    is_operated = dice.happens(OPERATED_SHARE)
    config = _config(dice, site, is_operated=is_operated)
    if config.search.detection is not None:
        payload = msgspec.structs.replace(scenario.payload, max_range_m=REACH_M)
        scenario = msgspec.structs.replace(scenario, payload=payload)
    is_signed = dice.happens(SIGNED_SHARE)
    faults = [flights.random_fault(rng) for _ in range(1 + int(rng.integers(MAX_FAULTS)))]
    latency_s = dice.number(0.0, LATENCY_S)
    share = dice.number(0.0, 1.0)
    delays = (
        LinkDelay(delay_s=latency_s * share, direction="to_companion"),
        LinkDelay(delay_s=latency_s * (1.0 - share), direction="to_vehicle"),
    )
    schedule = Schedule(faults=(*delays, *faults))
    regrant_s = dice.number(15.0, 40.0) if dice.happens(0.5) else None
    return MissionCase(seed, site, config, scenario, schedule, is_signed, is_operated, regrant_s)


def _scenario(
    dice: flights.Dice, site: Site, emitter: tuple[float, float], flavour: FlavourName
) -> Scenario:
    heading = dice.number(-math.pi, math.pi)
    wind_mps = dice.one((0.0, dice.number(0.0, WIND_MPS), WIND_MPS))
    return Scenario(
        start_enu_m=site.start_enu_m,
        emitter=EmitterParams(position_enu_m=emitter),
        autopilot=AutopilotParams(flavour=flavour),
        vehicle=MulticopterParams(max_speed_mps=12.0),
        wind=WindParams(
            east_mps=wind_mps * math.cos(heading),
            north_mps=wind_mps * math.sin(heading),
            gust_sigma_mps=dice.one((0.0, 2.0)),
        ),
    )


def _config(dice: flights.Dice, site: Site, *, is_operated: bool) -> schema.CompanionConfig:
    limits = schema.LimitsConfig(
        fence_enu_m=site.fence_enu_m,
        keep_out_enu_m=site.keep_out_enu_m,
        speed_mps=dice.one(SPEEDS_MPS),
        altitude_max_m=40.0,
    )
    mission = SessionParams(
        engage="operator" if is_operated else "auto", altitude_m=ALTITUDE_M, stop_confirm_s=3.0
    )
    kind = dice.one(PLANNERS)
    match kind:
        case "latched_crossing" | "fim":
            planner = schema.PlannerConfig(kind=kind)
        case _:
            planner = schema.PlannerConfig(kind="survey", search=kind)
    vehicle = VehicleParams(setpoint=dice.one(("local_ned", "global_int")))
    search = SearchAreaParams()
    if planner.kind != "survey" and dice.happens(0.5):
        pattern = dice.one(("expanding_square", "probability"))
        planner = msgspec.structs.replace(planner, search=pattern)
        if pattern == "probability":
            search = SearchAreaParams(detection=DetectionModel(reach_m=REACH_M))
    return schema.CompanionConfig(
        mission=mission, limits=limits, planner=planner, vehicle=vehicle, search=search
    )


SAID = 400


def fly_mission(trial: flights.Trial) -> flights.TrialOutcome:
    """Fly one mission."""
    case = mission_case(trial.seed)
    around = fly(case)
    monitor = around.monitor
    closest_m = monitor.fence.closest_m
    lines = [str(case), *(f"fault {fields_of(fault)}" for fault in case.schedule.faults)]
    return flights.TrialOutcome(
        trial,
        tuple(around.findings),
        sums={
            "missions": 1.0,
            "fence_breaches": float(monitor.fence.breaches),
            "mission_hours": around.flight.now_s / 3600.0,
            "localised": float(bool(around.notes.results)),
            "engaged": float(math.isfinite(closest_m)),
        },
        most={"send_gap_s": monitor.stream.worst_gap_s},
        least={"closest_approach_m": closest_m} if math.isfinite(closest_m) else {},
        story=(*lines, *(line[:SAID] for line in around.story)),
    )


def fly(case: MissionCase) -> flights.Monitored:
    """Fly a mission to its end."""
    around = flights.monitored_flight(
        case.config, case.scenario, case.seed, is_signed=case.is_signed
    )
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


def _take_off(around: flights.Monitored) -> None:
    """Let the operator take off and hand over, in the order that the autopilot requires."""
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


def _give_again(around: flights.Monitored) -> None:
    """Let the operator hand over again, if the vehicle flies in another mode."""
    flight = around.flight
    if not flight.sim.vehicle.is_armed or flight.mode is FlightMode.OFFBOARD:
        return
    around.operator.grant()
    flight.at(flight.now_s + 3.0, lambda: around.operator.choose(FlightMode.OFFBOARD))


LOSSES = (0.0, 0.1, 0.3)
BEFORE_S, OVER_S, AFTER_S = 14.0, 12.0, 4.0
"""Boot and take-off; the time in which the pilot acts; the time for which silence is checked."""
AGAIN = 10
"""Take-overs in one flight: the operator hands control over again in between."""
GIVE_BACK_S = 3.0


def take_over(trial: flights.Trial) -> flights.TrialOutcome:
    """Fly ten take-overs in one flight."""
    around, dice = flights.launched_flight(trial.seed, 0x0E7)
    flight = around.flight
    share = dice.one(LOSSES)
    if share:
        around.injector.add(LinkLoss(share=share))
    if dice.happens(0.3):
        around.injector.add(LinkJitter(jitter_s=0.15))
    flight.run(BEFORE_S)
    taken = 0
    for _ in range(AGAIN):
        if not _give_back(around):
            continue
        flight.run(dice.number(0.0, OVER_S / AGAIN * 2.0))
        around.injector.add(PilotMode(mode=dice.one(flights.MODES)))
        flight.run(AFTER_S)
        taken += 1
    authority = around.monitor.authority
    return flights.TrialOutcome(
        trial,
        tuple(around.findings),
        sums={"overrides": float(taken), "override_late_frames": float(authority.late)},
        most={"override_worst_late_s": authority.worst_late_s},
        story=around.story,
    )


def _give_back(around: flights.Monitored) -> bool:
    """Return True if the companion is in control, perhaps after another hand-over."""
    flight = around.flight
    for _ in range(4):
        if flight.mode is FlightMode.OFFBOARD and around.monitor.scene.observed.is_ours:
            return True
        around.operator.grant()
        flight.run(GIVE_BACK_S)
        around.operator.choose(FlightMode.OFFBOARD)
        flight.run(0.5)
    return flight.mode is FlightMode.OFFBOARD


MISSIONS = flights.Part(
    "missions", "random missions with 1 to 4 faults", run=fly_mission, cost_s=0.8
)
OVERRIDES = flights.Part(
    "override",
    "pilot take-overs at random instants, 0, 10 and 30 % loss",
    run=take_over,
    cost_s=1.5,
    split=lambda takeovers: (-(-round(takeovers) // AGAIN), 1.0),
)
