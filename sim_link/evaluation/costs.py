"""The rows of costs.csv: what a step takes on this machine, measured in this run.

Times are not the same bytes twice, so they are kept apart from the results.
"""

from __future__ import annotations

from collections.abc import Sequence

from sim_link.evaluation.planner_bench import SYSTEMS, StepCost, bench_planners
from sim_link.evaluation.results import ResultRow, StudyResult
from sim_link.evaluation.rows import metrics_of, number, rows_about
from sim_link.evaluation.study import Cell, cells_of

ROUNDS = 5
"""Enough for a median; `tools/bench.py planners` takes its time."""


def costs_of(results: Sequence[StudyResult], rounds: int = ROUNDS) -> list[ResultRow]:
    """Cost of the systems that studies ask it of, beside filterpy's update.

    Args:
        results: Of the studies.
        rounds: Medians are over so many.
    """
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
