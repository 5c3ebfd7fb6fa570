"""Cost of a step of filter and planner, beside filterpy's update on the same measurements.

Each system flies the canonical scenario once. That run, its positions and its measurements, is then
retraced repeatedly: the filter processes each measurement and the planner decides, while the track
stays the recorded one, so that nothing is timed but the two of them. A decision is also timed
alone, on the estimates of the run. filterpy's filter processes measurements of the same run from
the same positions. All of them alternate; a figure is the median over the rounds, per step.

On a busy machine a turn of the scheduler is as long as a few hundred steps. The companion's steps
are therefore timed by processor time, which equals wall time on an idle machine, and filterpy's
updates, which are timed one by one, in turns too short to be interrupted often.

The system that solves the whole run at intervals (`map`) has no cost per step of its own: its run
is timed as the studies do it, the simulation included.

The paper prints one average cost per step without its contents. It is assumed to be filter and
planner together, which is the stricter reading of the limits.

The rows of costs.csv are the cost of a step on this machine, measured in this run. Times differ
from run to run, so they are kept apart from the results.
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import NamedTuple

import numpy as np

from companion.kernel import IS_COMPILED, Matrix, Vector, kernel
from companion.planning.crossing import LatchedCrossingParams
from companion.planning.crossing_kernels import NO_LATCH, LatchRule
from companion.planning.views import Antenna, best_reach_m, leg_over, rate
from tools.benches.filter_bench import (
    FILTERPY_UPDATE,
    SEED,
    Contender,
    Walk,
    filterpy_seconds,
    timed,
)
from tools.study.admm_ekf import RECURSIVE
from tools.study.case import PLANNER, Case, channel_draws, measured, stream
from tools.study.reporting.study_tables import metrics_of, number, rows_about
from tools.study.study import Cell, ResultRow, StudyResult, cells_of
from tools.study.systems import System, belief_of, steering_of
from tools.study.trials import run_trial
from tools.study.walk import (
    FIXED,
    WalkFilter,
    WalkSteering,
    first_fix,
    latched_step,
    next_place,
    updated,
)


class Beliefs(NamedTuple):
    """State of a recursive filter after every measurement of a run."""

    means: Matrix
    """(steps, n)"""
    covariances: Matrix
    """(steps, n, n)"""


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Run of a system for retracing."""

    system: System
    walk: Walk
    steering: WalkSteering
    beliefs: Beliefs
    picks: Vector
    """(steps,) draws of the planner."""


def recorded_run(case: Case, system: System) -> RecordedRun:
    """Return one run of a system in a case, with all data for retracing it.

    Raises:
        ValueError: There are no kernels for the system's filter.
    """
    belief, steering = belief_of(case, system), steering_of(case, system)
    trial = run_trial(case, system, SEED)
    draws = channel_draws(case, SEED)
    z = np.full((case.steps, 3), np.nan)
    for step, (east_m, north_m) in enumerate(trial.track_enu_m.tolist()):
        z[step, :2] = measured(draws[step], east_m, north_m, trial.truth)
    walk = Walk(case, np.ascontiguousarray(trial.track_enu_m), z, belief)
    beliefs, picks = (
        filter_states(walk.track_enu_m, z, belief),
        stream(SEED, PLANNER).random(case.steps),
    )
    return RecordedRun(system, walk, steering, beliefs, picks)


@kernel
def filter_states(track_enu_m: Matrix, z: Matrix, belief: WalkFilter) -> Beliefs:
    """Return the state of the recursive filter after every measurement.

    Args:
        track_enu_m: (steps, 2).
        z: (steps, 3).
    """
    mean, covariance = first_fix(track_enu_m[0, 0], track_enu_m[0, 1], z[0, 0], z[0, 1], belief)
    steps, n = z.shape[0], mean.size
    means, covariances = np.empty((steps, n)), np.empty((steps, n, n))
    sensor = np.zeros(3)
    means[0], covariances[0] = mean, covariance
    for step in range(1, steps):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
        means[step], covariances[step] = mean, covariance
    return Beliefs(means, covariances)


@kernel
def retraced(
    track_enu_m: Matrix, z: Matrix, picks: Vector, belief: WalkFilter, steering: WalkSteering
) -> Matrix:
    """Return the decisions after every measurement but the first, (steps - 1, 2).

    Args:
        track_enu_m: (steps, 2) positions of the run.
        z: (steps, 3) its measurements.
        picks: (steps,) draws of its planner.
    """
    places = track_enu_m[1:].copy()
    sensor, latch = np.zeros(3), NO_LATCH
    sensor[:2] = track_enu_m[0]
    mean, covariance = first_fix(sensor[0], sensor[1], z[0, 0], z[0, 1], belief)
    if steering.planner != FIXED:
        _, _, latch = next_place(sensor, mean, covariance, picks[0], latch, belief, steering)
    for step in range(1, z.shape[0]):
        sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
        mean, covariance = updated(mean, covariance, sensor, z[step], belief)
        if steering.planner != FIXED:
            places[step - 1, 0], places[step - 1, 1], latch = next_place(
                sensor, mean, covariance, picks[step], latch, belief, steering
            )
    return places


@kernel
def decided(
    track_enu_m: Matrix,
    beliefs: Beliefs,
    picks: Vector,
    belief: WalkFilter,
    steering: WalkSteering,
    passes: int,
) -> Matrix:
    """Return the planner's decisions on every estimate of a run but the last, (steps - 1, 2).

    Args:
        track_enu_m: (steps, 2) positions of the run.
        picks: (steps,) draws of its planner.
        steering: Of a planner that follows the estimate.
        passes: How often to go through the run.
    """
    places = np.empty((track_enu_m.shape[0] - 1, 2))
    sensor = np.zeros(3)
    for _ in range(passes):
        latch = NO_LATCH
        for step in range(places.shape[0]):
            sensor[0], sensor[1] = track_enu_m[step, 0], track_enu_m[step, 1]
            places[step, 0], places[step, 1], latch = next_place(
                sensor,
                beliefs.means[step],
                beliefs.covariances[step],
                picks[step],
                latch,
                belief,
                steering,
            )
    return places


SIGHTED_LIMIT_US = 5.0
"""Longest time of a compiled decision by the antenna, in us."""
TWO_AXIS = Antenna((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), 2, False, math.pi / 3.0)


@kernel
def sighted(decisions: int, antenna: Antenna, rule: LatchRule) -> float:
    """Return the overshoots of the next legs by the antenna's geometry, height included."""
    total_m = 0.0
    for index in range(decisions):
        high = leg_over(20.0, 10.0, (0.5, 0.05, math.inf), antenna, 0.1 * index)
        over_m = best_reach_m(high, rule.overshoot_min_m, rule.overshoot_max_m)
        low = leg_over(6.0, 10.0, (0.5, 0.05, math.inf), antenna, 0.1 * index)
        if rate(over_m, low) > rate(over_m, high):
            over_m = best_reach_m(low, rule.overshoot_min_m, rule.overshoot_max_m)
        latch = latched_step(NO_LATCH, (-30.0, 0.0), (0.0, 0.0), over_m, True, rule)
        total_m += latch.overshoot_m
    return total_m


def sighted_seconds(decisions: int = 50) -> dict[str, float]:
    """Time a decision by the antenna's geometry."""
    rule = LatchedCrossingParams().rule()
    begun = process_time()
    sighted(decisions, TWO_AXIS, rule)
    return {SIGHTED: (process_time() - begun) / decisions}


SIGHTED = "latched crossing by the antenna: decision"
ROUNDS = 75
DECISION_PASSES = 4 if IS_COMPILED else 1
"""Over a run, timed together: what the call of a compiled kernel takes is spread over them."""
FILTERPY_UPDATES = 40
"""Updates of a run that are timed together."""

FILTER_ALONE = System("asymmetric_huber", "passive")
REACTIVE = System("asymmetric_huber", "reactive")
LATCHED = System("asymmetric_huber", "latched")
FIM = System("asymmetric_huber", "fim")
PRINTED_FIM = System("asymmetric_huber", "fim_printed")
HUBER_FIM = System("huber", "fim")
ADMM_ALONE = System("admm", "passive")
MAP_LATCHED = System("map", "latched")
SYSTEMS = (
    FILTER_ALONE,
    REACTIVE,
    LATCHED,
    FIM,
    PRINTED_FIM,
    MAP_LATCHED,
    HUBER_FIM,
    ADMM_ALONE,
)
"""Ours, and the two others whose cost the paper prints."""

LIMITS_MS = {REACTIVE: 0.003, LATCHED: 0.003, FIM: 0.015}
"""Longest time of filter and decision together, compiled, in ms."""
PAPER_MS = {REACTIVE: 0.012, FIM: 0.281, HUBER_FIM: 0.281, ADMM_ALONE: 0.002}
"""Paper: table "Comprehensive Performance and Complexity", medium noise."""
PAPER_FIM_OVER_REACTIVE = 23.0
"""Paper: section VI-C, "over 23 times more efficient"."""


@dataclass(frozen=True, slots=True)
class StepCost:
    """Cost of one step of a system, milliseconds."""

    system: str
    step_ms: float
    """Filter and decision; of `map` the simulation, too."""
    decision_ms: float | None
    """The planner alone; None: it decides nothing."""
    filterpy_update_ms: float
    """Time of filterpy's filter on measurements of the same run, its prediction not counted."""
    ratio: float
    """Ratio of the step to filterpy's update."""
    paper_ms: float | None
    """None: not printed."""
    limit_ms: float | None
    """None: none is set, or nothing is compiled."""
    is_met: bool | None


@dataclass(frozen=True, slots=True)
class CostRatio:
    """Cost of FIM relative to reactive crossing."""

    steps: float
    """Filter and planner."""
    decisions: float
    """Planners alone."""
    paper: float


@dataclass(frozen=True, slots=True)
class PlannerBench:
    """Medians of one run."""

    python: str
    numpy: str
    numba: str | None
    """None: nothing was compiled, and no limit is judged."""
    steps: int
    rounds: int
    costs: list[StepCost]
    fim_over_reactive: CostRatio
    sighted_us: float
    """A decision of latched crossing that knows the antenna: a new leg and its height."""


def bench_planners(
    rounds: int = ROUNDS, case: Case | None = None, systems: Sequence[System] = SYSTEMS
) -> PlannerBench:
    """Time filters with their planners, compiled where numba is installed.

    Args:
        case: What is flown, without its obstacles; None: the canonical scenario.
        systems: What is reported, all of them compiled.

    Raises:
        ValueError: There are no kernels for a system's filter.
    """
    case = case or Case()
    runs = [recorded_run(case, system) for system in {REACTIVE: 0, FIM: 0} | dict.fromkeys(systems)]
    timers = [timer for run in runs for timer in contenders(run)]
    costs_us = timed([*timers, sighted_seconds], rounds)
    return PlannerBench(
        python=platform.python_version(),
        numpy=np.__version__,
        numba=importlib.metadata.version("numba") if IS_COMPILED else None,
        steps=case.steps,
        rounds=rounds,
        costs=[step_cost(system, costs_us, is_compiled=IS_COMPILED) for system in systems],
        fim_over_reactive=cost_ratio(costs_us),
        sighted_us=costs_us[SIGHTED],
    )


def contenders(run: RecordedRun) -> list[Contender]:
    """Return everything that is timed of one run, each under the label of its system."""
    walk, steering, label = run.walk, run.steering, run.system.label
    track_enu_m, steps = walk.track_enu_m, len(walk.z) - 1
    beginning = replace(
        walk, track_enu_m=track_enu_m[: FILTERPY_UPDATES + 1], z=walk.z[: FILTERPY_UPDATES + 1]
    )

    def run_seconds() -> dict[str, float]:
        """Time a whole run, per step."""
        begun = process_time()
        run_trial(walk.case, run.system, SEED)
        return {step_of(label): (process_time() - begun) / walk.case.steps}

    def step_seconds() -> dict[str, float]:
        """Time the steps alone, per step."""
        begun = process_time()
        retraced(track_enu_m, walk.z, run.picks, walk.belief, steering)
        return {step_of(label): (process_time() - begun) / steps}

    def decision_seconds() -> dict[str, float]:
        """Time the decisions alone, each."""
        begun = process_time()
        decided(track_enu_m, run.beliefs, run.picks, walk.belief, steering, DECISION_PASSES)
        return {decision_of(label): (process_time() - begun) / (DECISION_PASSES * steps)}

    def update_seconds() -> dict[str, float]:
        """Time filterpy's update."""
        return {filterpy_of(label): filterpy_seconds(beginning)[FILTERPY_UPDATE]}

    if run.system.filter not in RECURSIVE:
        return [run_seconds, update_seconds]
    decisions = [] if steering.planner == FIXED else [decision_seconds]
    return [step_seconds, update_seconds, *decisions]


def step_cost(system: System, costs_us: dict[str, float], *, is_compiled: bool) -> StepCost:
    """Return the costs of one system, judged if it is compiled."""
    label = system.label
    step_ms, filterpy_ms = 1e-3 * costs_us[step_of(label)], 1e-3 * costs_us[filterpy_of(label)]
    decision_us = costs_us.get(decision_of(label))
    limit_ms = LIMITS_MS.get(system) if is_compiled else None
    return StepCost(
        system=label,
        step_ms=step_ms,
        decision_ms=None if decision_us is None else 1e-3 * decision_us,
        filterpy_update_ms=filterpy_ms,
        ratio=step_ms / filterpy_ms,
        paper_ms=PAPER_MS.get(system),
        limit_ms=limit_ms,
        is_met=None if limit_ms is None else step_ms <= limit_ms,
    )


def cost_ratio(costs_us: dict[str, float]) -> CostRatio:
    """Return the cost of FIM by that of reactive crossing, from medians by label."""
    fim, reactive = FIM.label, REACTIVE.label
    return CostRatio(
        steps=costs_us[step_of(fim)] / costs_us[step_of(reactive)],
        decisions=costs_us[decision_of(fim)] / costs_us[decision_of(reactive)],
        paper=PAPER_FIM_OVER_REACTIVE,
    )


def step_of(label: str) -> str:
    """Return the label of a system's step."""
    return f"{label}: step"


def decision_of(label: str) -> str:
    """Return the label of a system's decision."""
    return f"{label}: decision"


def filterpy_of(label: str) -> str:
    """Return the label of filterpy's update on the measurements of a system."""
    return f"{label}: filterpy update"


COST_ROUNDS = 5
"""Enough for a median; `tools/bench.py planners` takes its time."""


def costs_of(results: Sequence[StudyResult], rounds: int = COST_ROUNDS) -> list[ResultRow]:
    """Return the costs of the systems that studies ask for, beside filterpy's update."""
    rows: list[ResultRow] = []
    for result in results:
        asked = [
            cell
            for cell in cells_of(result.study)
            if "cost_ms_per_step" in metrics_of(result, cell) and cell.system in SYSTEMS
        ]
        for case in dict.fromkeys(cell.case for cell in asked):
            cells = [cell for cell in asked if cell.case == case]
            costs = bench_planners(rounds, case, [cell.system for cell in cells]).costs
            for cell, cost in zip(cells, costs, strict=True):
                rows += _rows(cell, cost)
    return rows


def _rows(cell: Cell, cost: StepCost) -> list[ResultRow]:
    rows = rows_about(cell, "cost_ms_per_step", number(cost.step_ms))
    if cost.decision_ms is not None:
        rows += rows_about(cell, "decision_ms", number(cost.decision_ms))
    return rows + rows_about(cell, "filterpy_update_ms", number(cost.filterpy_update_ms))
