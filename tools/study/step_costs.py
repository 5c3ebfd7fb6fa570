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
from dataclasses import replace
from time import process_time

from tools.benches.filter_bench import (
    FILTERPY_UPDATE,
    SEED,
    Contender,
    Walk,
    filterpy_seconds,
    step_seconds,
    timed,
)
from tools.study.admm_ekf import RECURSIVE
from tools.study.case import Case
from tools.study.reporting.study_tables import metrics_of, number, rows_about
from tools.study.study import ResultRow, StudyResult, cells_of
from tools.study.systems import System
from tools.study.trials import run_trial

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


def contenders(walk: Walk) -> list[Contender]:
    """Return the timed functions of one run: a step, and filterpy's update."""
    part = slice(FILTERPY_UPDATES + 1)
    beginning = replace(walk, track_enu_m=walk.track_enu_m[part], z=walk.z[part])

    def run_seconds() -> float:
        """Time a whole run, per step."""
        begun = process_time()
        run_trial(walk.case, walk.system, SEED)
        return (process_time() - begun) / walk.case.steps

    def steps_alone() -> float:
        """Time the steps alone, per step."""
        return step_seconds(walk, process_time)

    per_step = steps_alone if walk.system.filter in RECURSIVE else run_seconds
    return [
        lambda: {STEP: per_step()},
        lambda: {UPDATE: filterpy_seconds(beginning)[FILTERPY_UPDATE]},
    ]


def costs_ms(case: Case, systems: Sequence[System], rounds: int) -> list[dict[str, float]]:
    """Return the medians of each system in a case, by metric, ms."""
    timers = {system: contenders(Walk.of(case, system)) for system in systems}
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
