"""Search planners side by side in one world: time until the emitter is heard.

The vehicle is a point that flies straight to the planner's waypoints at constant speed; emitters
are drawn from the POA. The world is that of `searched_area`, unknown to the planners. Stone-Soup's
sensor manager (sensormanager.BruteForceSensorManager over NStepDirectionalGridMovable: straight
moves by whole lane spacings) maximises the success per second by the same map and forecast.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal, get_args

import numpy as np

from companion.geometry.polygons import Point
from companion.planning.planner import Planner, PlanRequest
from companion.planning.search import LawnmowerParams, SearchPlanner
from companion.planning.search_probability import ProbabilityPlanner
from companion.search.detection_model import DetectionModel
from companion.search.outlook import LegTable, Outlook, outlook_of
from companion.search.search_grid import SearchGrid
from companion.search.searched_area import SearchedArea
from tools.study.searched_area import Array, are_heard, box, draw_world, even_poa, uneven_poa

Poa = Literal["even", "uneven"]
POAS: tuple[Poa, ...] = get_args(Poa)
Name = Literal["lawnmower", "probability", "stonesoup"]
NAMES: tuple[Name, ...] = get_args(Name)
SIDE_M = 600.0
HOME: Point = (5.0, 5.0)
FENCE = box(0.0, 0.0, SIDE_M, SIDE_M)
MARGIN_M = 3.0
HEIGHT_M, SPEED_MPS, STEP_S = 25.0, 5.0, 1.0
PLANS_A_STEP = 5
"""Requests per second, as in flight."""
MAP_EVERY_S = 2.0
"""Age of the map at which it is renewed, as in flight."""
SWEEPS = 1.0
"""Length of a flight, in sweeps of the lawnmower."""
EMITTERS = 40


class Planned:
    """The companion's planner, called as often as in flight."""

    def __init__(self, planner: Planner[Any], *, uses_map: bool) -> None:
        self._planner = planner
        self._uses_map = uses_map
        self._memory: Any = None
        self._outlook: Outlook | None = None
        self._age_s = math.inf

    def goal(self, at: Point, area: SearchedArea) -> Point:
        """Return the waypoint."""
        self._age_s += STEP_S
        if self._uses_map and self._age_s >= MAP_EVERY_S:
            area.renew()
            self._outlook, self._age_s = outlook_of(area), 0.0
        request = PlanRequest(at, None, FENCE, MARGIN_M, home_enu_m=HOME, outlook=self._outlook)
        for _ in range(PLANS_A_STEP):
            plan = self._planner.plan(request, self._memory)
            self._memory = plan.memory
        return plan.waypoint.position_enu_m


class StoneSoup:
    """Stone-Soup's sensor manager; it chooses where a move ends."""

    def __init__(self, spacing_m: float, table: LegTable) -> None:
        # an extra, which takes most of a second to import
        from stonesoup.movable.grid import NStepDirectionalGridMovable
        from stonesoup.platform import FixedPlatform
        from stonesoup.sensormanager import BruteForceSensorManager
        from stonesoup.types.state import State, StateVector

        count = max(1, round(SIDE_M / spacing_m))
        state = State(StateVector([[0.5 * SIDE_M / count]] * 2), datetime(2026, 1, 1))  # noqa: DTZ001
        space = np.array([[MARGIN_M, SIDE_M - MARGIN_M]] * 2)
        self._movable = NStepDirectionalGridMovable(
            states=[state],
            position_mapping=(0, 1),
            action_space=space,
            resolution=SIDE_M / count,
            n_steps=count - 1,
            step_size=1,
        )
        platform = FixedPlatform(movement_controller=self._movable)
        self._manager = BruteForceSensorManager(
            sensors=set(), platforms={platform}, reward_function=self._reward
        )
        self._table = table

    def goal(self, at: Point, area: SearchedArea) -> Point:
        """Return the end of the current move, or of the next one."""
        goal = self._point(self._movable.position)
        if math.dist(at, goal) > 1e-6:
            return goal
        area.renew()
        self._outlook = outlook_of(area)
        time = self._movable.state.timestamp + timedelta(seconds=1.0)
        ((chosen),) = [self._manager.choose_actions(set(), time)]
        for actions in chosen[0].values():
            self._movable.add_actions(actions)
        self._movable.move(time)
        return self._point(self._movable.position)

    def _reward(self, config: Mapping[Any, Sequence[Any]], *_: object) -> float:
        start = self._point(self._movable.position)
        ((action,),) = config.values()
        end = self._point(action.target_value)
        length_m = math.dist(start, end)
        if length_m == 0.0:
            return 0.0
        return (self._outlook.left - self._outlook.after(start, end, self._table).left) / length_m

    @staticmethod
    def _point(vector: Any) -> Point:
        return float(vector[0, 0]), float(vector[1, 0])


Mover = Planned | StoneSoup
"""Choice of where the point flies, with its memory."""


def mover_of(name: Name, spacing_m: float, model: DetectionModel) -> Mover:
    """Return a fresh planner with its memory."""
    pattern, table = LawnmowerParams(spacing_m=spacing_m), LegTable(model, HEIGHT_M, SPEED_MPS)
    match name:
        case "lawnmower":
            return Planned(SearchPlanner(pattern), uses_map=False)
        case "probability":
            return Planned(ProbabilityPlanner(pattern, table), uses_map=True)
        case "stonesoup":
            return StoneSoup(spacing_m, table)


def flown(mover: Mover, grid: SearchGrid, model: DetectionModel, length_s: float) -> Array:
    """Return (points, 3) positions, one a step."""
    area = SearchedArea(grid, model)
    at, track = HOME, []
    for _ in range(round(length_s / STEP_S)):
        goal = mover.goal(at, area)
        apart_m = math.dist(at, goal)
        share = min(1.0, SPEED_MPS * STEP_S / apart_m) if apart_m > 0.0 else 0.0
        at = at[0] + share * (goal[0] - at[0]), at[1] + share * (goal[1] - at[1])
        track.append((*at, HEIGHT_M))
        area.listen(track[-1], STEP_S)
        while area.advance():
            pass
    return np.array(track)


@dataclass(frozen=True, slots=True)
class SearchTimes:
    """Times of one planner in one world."""

    poa: Poa
    planner: Name
    times_s: tuple[float, ...]
    """Time until each emitter was heard; infinite where it was not."""


def fly_planners(number: int, seed: int) -> list[SearchTimes]:
    """Fly all planners in one world, over an even and over an uneven POA."""
    found = []
    for index, poa in enumerate(POAS):
        rng = np.random.default_rng([seed, number, index])
        world, model = draw_world(rng)
        grid = even_poa(SIDE_M)
        if poa == "uneven":
            grid = uneven_poa(SIDE_M, rng, is_turned=bool(rng.random() < 0.5))
        spacing_m = model.reach_m * float(rng.uniform(0.5, 1.5))
        cells = rng.choice(len(grid.poa), EMITTERS, p=grid.poa)
        emitters = grid.centres_enu_m[cells] + rng.uniform(-0.5, 0.5, (EMITTERS, 2)) * grid.cell_m
        length_s = SWEEPS * SIDE_M * (SIDE_M / spacing_m + 1.0) / SPEED_MPS
        for name in NAMES:
            track = flown(mover_of(name, spacing_m, model), grid, model, length_s)
            luck = np.random.default_rng([seed, number, index, 1])
            heard = are_heard(world, emitters, track, luck)
            times = np.where(heard.any(axis=1), STEP_S * heard.argmax(axis=1), math.inf)
            found.append(SearchTimes(poa, name, tuple(times.tolist())))
    return found


MAX_RATIO: Mapping[Poa, float] = {"even": 1.02, "uneven": 0.7}
"""Median time of `probability` over the lawnmower's."""


def table_of(flown: Sequence[Sequence[SearchTimes]]) -> tuple[str, bool]:
    """Return the table of medians over all flights as text, and True within the limits."""
    times = [each for found in flown for each in found]
    lines = ["POA      planner       median s  of lawnmower  heard"]
    is_met = True
    for poa in POAS:
        base_s = math.nan
        for name in NAMES:
            chosen = [each.times_s for each in times if each.poa == poa and each.planner == name]
            every_s = np.concatenate(chosen)
            median_s, heard = float(np.median(every_s)), float(np.isfinite(every_s).mean())
            base_s = median_s if name == NAMES[0] else base_s
            ratio = median_s / base_s
            lines.append(f"{poa:9}{name:14}{median_s:8.0f}{ratio:14.2f}{heard:7.2f}")
            is_met &= name != "probability" or ratio <= MAX_RATIO[poa]
    return "\n".join(lines) + "\n", is_met
