"""Flights of the whole companion among true radios: its reports, and their errors.

Companion and vehicle are joined in memory. A flight ends with the report, or at the time limit.
Seeds vary not only the noise, so that nothing is fitted to one site: the emitter lies anywhere in a
ring around home, evenly by area, and the unknown constants are drawn for each flight. Offsets,
compass and mount are uniform, with the scenario's figure as root mean square (of the range, which
is never too short: between 0 and twice the figure); the wind turns. All planners and configurations
of a seed have the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from companion.config.schema import CompanionConfig, PatternKind, PlannerConfig, load_config
from companion.domain import FlightMode
from companion.errors import ConfigError
from companion.geometry.polygons import Point
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet import load_scenario
from sim_link.lab.lockstep import Flight, MemoryJournal
from sim_link.lab.pool import sources_digest
from tools.console import without_logs
from tools.study.searched_area import box
from tools.study.study import ConfigKind, FlightGrid, FlightRow, hint
from tools.study.study_run import key_of

ENGAGED_BY_S = 120.0
"""Latest start of the search: boot and take-off take a third of that time."""
LANES_M = 30.0
"""Distance between the lanes of a lawnmower: the whole ring within the cut of most radios."""
change = msgspec.structs.replace


@dataclass(frozen=True, slots=True)
class FieldFlight:
    """One flight, determined by these values only."""

    radio: str
    config_kind: ConfigKind
    config: CompanionConfig
    scenario: Scenario
    seed: int
    cut_s: float

    @property
    def key(self) -> str:
        """Return the key of the flight in the store."""
        parts = (self.radio, self.config_kind, self.seed, self.cut_s)
        return key_of(self.config, self.scenario, *parts, sources_digest())


def flights_of(
    grid: FlightGrid, folder: Path, runs: int, seed: int, only: Sequence[str] = ()
) -> list[FieldFlight]:
    """Return the flights of a grid, or of the named part of it, the seeds of all cells alternating.

    Args:
        folder: Folder with `scenarios/field` and `companion/field`.
        only: Radios, configurations and planners; if none of a kind is named, all of it.
    """
    names: tuple[tuple[str, ...], ...] = (tuple(grid.cut_s), grid.configs, grid.planners)
    known = [name for kind in names for name in kind]
    for word in only:
        if word not in known:
            raise ConfigError(f"--only {word}: there is no such thing here; {hint(word, known)}")
    radios, configs, planners = (
        [name for name in kind if name in only] or list(kind) for kind in names
    )
    cells: list[tuple[str, ConfigKind, CompanionConfig, Scenario]] = []
    for radio in radios:
        scenario = load_scenario(folder / "scenarios" / "field" / f"{radio}.yaml")
        preset = load_config(folder / "companion" / "field" / f"{radio}.yaml")
        for kind in grid.configs:
            # the planner is not a property of the radio, so both kinds have the preset's
            unconfigured = change(CompanionConfig(), planner=preset.planner)
            base = preset if kind == "configured" else unconfigured
            for planner in grid.planners:
                if kind in configs and planner in planners:
                    config = _flown_with(base, planner, scenario.start_enu_m, grid.ring_m[1])
                    cells.append((radio, kind, config, scenario))
    return [
        FieldFlight(radio, kind, config, _drawn(scenario, grid, number), number, grid.cut_s[radio])
        for number in range(seed * 1_000_000, seed * 1_000_000 + runs)
        for radio, kind, config, scenario in cells
    ]


def _flown_with(config: CompanionConfig, kind: Any, home: Point, reach_m: float) -> CompanionConfig:
    """Return the configuration with a planner, engaging by itself.

    Lanes cover the square around home.
    """
    (east, north), planner = home, config.planner
    area = box(east - reach_m, north - reach_m, east + reach_m, north + reach_m)
    made: PlannerConfig
    if kind in get_args(PatternKind):
        lanes = change(planner.pattern, area_enu_m=area, spacing_m=LANES_M)
        layout = lanes if kind == "lawnmower" else planner.pattern
        made = change(planner, kind="survey", search=kind, pattern=layout)
    else:
        made = change(planner, kind=kind)
    return change(config, mission=change(config.mission, engage="auto"), planner=made)


def _drawn(scenario: Scenario, grid: FlightGrid, seed: int) -> Scenario:
    """Return the scenario with the drawn values of a seed."""
    rng = np.random.default_rng((seed, 0xF1E1D))
    least_m, most_m = grid.ring_m
    way_m = math.sqrt(rng.uniform(least_m**2, most_m**2))
    course, turn = rng.uniform(0.0, 2.0 * math.pi, 2).tolist()
    high, compass, mount = rng.uniform(-1.0, 1.0, 3).tolist()
    emitter, channel, wind = scenario.emitter, scenario.channel, scenario.wind
    (east, north), root3 = scenario.start_enu_m, math.sqrt(3.0)
    drawn = (east + way_m * math.cos(course), north + way_m * math.sin(course))
    cos, sin = math.cos(turn), math.sin(turn)
    navigation = scenario.navigation
    return change(
        scenario,
        emitter=change(
            emitter, position_enu_m=drawn, height_m=emitter.height_m + high * grid.height_spread_m
        ),
        channel=change(
            channel,
            range_offset_m=channel.range_offset_m * rng.uniform(0.0, 2.0),
            bearing_offset_deg=root3 * mount * channel.bearing_offset_deg,
        ),
        navigation=change(
            navigation, compass_error_deg=root3 * compass * navigation.compass_error_deg
        ),
        wind=change(
            wind,
            east_mps=cos * wind.east_mps - sin * wind.north_mps,
            north_mps=sin * wind.east_mps + cos * wind.north_mps,
        ),
        autopilot=change(scenario.autopilot, streams="asked"),  # the others only take time
    )


@without_logs()
def fly(task: FieldFlight) -> bytes:
    """Fly it; return the row as JSON."""
    return msgspec.json.encode(_flown(task))


def _flown(task: FieldFlight) -> FlightRow:
    notes = MemoryJournal()
    flight = Flight(task.config, task.scenario, task.seed, notes)
    while flight.mode is not FlightMode.OFFBOARD and flight.now_s < ENGAGED_BY_S:
        flight.step()
    engaged_s = flight.now_s
    while not notes.results and flight.now_s < engaged_s + task.cut_s:
        flight.step()
    estimate = notes.results[0][1].estimate if notes.results else flight.companion.session.estimate
    vehicle, truth = flight.sim.vehicle, task.scenario.emitter.position_enu_m
    east, north, _ = vehicle.estimator.bias_enu_m
    shown = (truth[0] + east, truth[1] + north)
    position = None if estimate is None else estimate.position_enu_m
    return FlightRow(
        radio=task.radio,
        config=task.config_kind,
        planner=str(task.config.planner.flown),
        seed=task.seed,
        is_reported=bool(notes.results),
        time_s=flight.now_s - engaged_s,
        state=None if estimate is None else estimate.state.value,
        error_m=None if position is None else math.dist(position, shown),
        absolute_error_m=None if position is None else math.dist(position, truth),
        r95_m=None if estimate is None else estimate.r95_m,
        absolute_r95_m=None if estimate is None else estimate.absolute_r95_m,
        east_m=truth[0],
        north_m=truth[1],
        flown_m=vehicle.aircraft.distance_m,
    )
