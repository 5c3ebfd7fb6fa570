"""Cost of a step of filter and planner, compared with the cost that the paper prints.

Each system flies a case once. That run, its positions and its measurements, is then retraced
repeatedly: the filter processes each measurement and the planner decides, while the track stays the
recorded one, so that nothing is timed but the two of them. Systems alternate; a figure is the
median over the rounds, per step. On a busy machine a turn of the scheduler is as long as a few
hundred steps; they are therefore timed by processor time, which equals wall time on an idle
machine. `tools/bench.py filters` has filterpy's update next to the companion's.

The system that solves the whole run at intervals (`map`) has no cost per step of its own: its run
is timed as the studies do it, the simulation included.

The paper prints one average cost per step without its contents. It is assumed to be filter and
planner together, which is the stricter reading. Times differ from run to run, so costs.csv is kept
apart from the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time

from tools.benches.filter_bench import SEED, Contender, Walk, step_seconds, timed
from tools.study.admm_ekf import RECURSIVE
from tools.study.case import Case
from tools.study.reporting.study_tables import metrics_of, number, rows_about
from tools.study.study import ResultRow, StudyResult, cells_of
from tools.study.systems import System
from tools.study.trials import run_trial

ROUNDS = 5
"""Number of rounds, enough for a median."""
ONE_SIDED = tuple(
    System("asymmetric_huber", planner)
    for planner in ("passive", "reactive", "latched", "fim", "fim_printed")
)
SYSTEMS = (*ONE_SIDED, System("map", "latched"), System("huber", "fim"), System("admm", "passive"))
"""Ours, and the two others whose cost the paper prints."""
STEP = "cost_ms_per_step"


def contender(walk: Walk) -> Contender:
    """Return a function that times a step of a run."""

    def whole_run() -> dict[str, float]:
        """Time a whole run, per step."""
        begun = process_time()
        run_trial(walk.case, walk.system, SEED)
        return {STEP: (process_time() - begun) / walk.case.steps}

    if walk.system.filter not in RECURSIVE:
        return whole_run
    return lambda: {STEP: step_seconds(walk, process_time)}


def costs_ms(case: Case, systems: Sequence[System], rounds: int) -> list[float]:
    """Return the median cost of a step of each system in a case, ms."""
    costs_us = timed({system: [contender(Walk.of(case, system))] for system in systems}, rounds)
    return [1e-3 * costs_us[system][STEP] for system in systems]


def costs_of(results: Sequence[StudyResult], rounds: int = ROUNDS) -> list[ResultRow]:
    """Return the costs of the systems that studies ask for."""
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
            for cell, cost_ms in zip(cells, costs, strict=True):
                rows += rows_about(cell, STEP, number(cost_ms))
    return rows
