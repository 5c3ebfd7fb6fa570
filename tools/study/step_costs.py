"""Cost of a step of filter and planner, beside filterpy's update on the same measurements.

Each system flies a case once. That run, its positions and its measurements, is then retraced
repeatedly: the filter processes each measurement and the planner decides, while the track stays the
recorded one, so that nothing is timed but the two of them. filterpy's filter processes measurements
of the same run from the same positions. Both alternate; a figure is the median over the rounds, per
step.

On a busy machine a turn of the scheduler is as long as a few hundred steps. The companion's steps
are therefore timed by processor time, which equals wall time on an idle machine, and filterpy's
updates, which are timed one by one, in turns too short to be interrupted often.

The system that solves the whole run at intervals (`map`) has no cost per step of its own: its run
is timed as the studies do it, the simulation included.

The paper prints one average cost per step without its contents. It is assumed to be filter and
planner together, which is the stricter reading. Times differ from run to run, so costs.csv is kept
apart from the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from companion.kernel import Matrix, Vector, kernel
from companion.planning.views import NO_LATCH
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
from tools.study.study import ResultRow, StudyResult, cells_of
from tools.study.systems import System, belief_of, steering_of
from tools.study.trials import run_trial
from tools.study.walk import (
    FIXED,
    WalkFilter,
    WalkSteering,
    first_fix,
    next_place,
    updated,
)

FILTERPY_UPDATES = 40
"""Updates of a run that are timed together."""
ROUNDS = 5
"""Enough for a median."""
ONE_SIDED = tuple(
    System("asymmetric_huber", planner)
    for planner in ("passive", "reactive", "latched", "fim", "fim_printed")
)
SYSTEMS = (*ONE_SIDED, System("map", "latched"), System("huber", "fim"), System("admm", "passive"))
"""Ours, and the two others whose cost the paper prints."""
STEP, UPDATE = "cost_ms_per_step", "filterpy_update_ms"


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Run of a system for retracing."""

    system: System
    walk: Walk
    steering: WalkSteering
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
    return RecordedRun(system, walk, steering, stream(SEED, PLANNER).random(case.steps))


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


def contenders(run: RecordedRun) -> list[Contender]:
    """Return the timed functions of one run: a step, and filterpy's update."""
    walk, steering, steps = run.walk, run.steering, len(run.walk.z) - 1
    part = slice(FILTERPY_UPDATES + 1)
    beginning = replace(walk, track_enu_m=walk.track_enu_m[part], z=walk.z[part])

    def run_seconds() -> dict[str, float]:
        """Time a whole run, per step."""
        begun = process_time()
        run_trial(walk.case, run.system, SEED)
        return {STEP: (process_time() - begun) / walk.case.steps}

    def step_seconds() -> dict[str, float]:
        """Time the steps alone, per step."""
        begun = process_time()
        retraced(walk.track_enu_m, walk.z, run.picks, walk.belief, steering)
        return {STEP: (process_time() - begun) / steps}

    def update_seconds() -> dict[str, float]:
        """Time filterpy's update."""
        return {UPDATE: filterpy_seconds(beginning)[FILTERPY_UPDATE]}

    return [step_seconds if run.system.filter in RECURSIVE else run_seconds, update_seconds]


def costs_ms(case: Case, systems: Sequence[System], rounds: int) -> list[dict[str, float]]:
    """Return the medians of each system in a case, by metric, ms."""
    timers = {system: contenders(recorded_run(case, system)) for system in systems}
    costs_us = timed(timers, rounds)
    return [{metric: 1e-3 * us for metric, us in costs_us[system].items()} for system in systems]


def costs_of(results: Sequence[StudyResult], rounds: int = ROUNDS) -> list[ResultRow]:
    """Return the costs of the systems that studies ask for, beside filterpy's update."""
    rows: list[ResultRow] = []
    for result in results:
        asked = [
            cell
            for cell in cells_of(result.study)
            if STEP in metrics_of(result, cell) and cell.system in SYSTEMS
        ]
        for case in dict.fromkeys(cell.case for cell in asked):
            cells = [cell for cell in asked if cell.case == case]
            costs = costs_ms(case, [cell.system for cell in cells], rounds)
            for cell, cost in zip(cells, costs, strict=True):
                for metric, value in cost.items():
                    rows += rows_about(cell, metric, number(value))
    return rows
