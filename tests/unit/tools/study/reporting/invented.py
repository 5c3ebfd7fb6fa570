"""Study results with invented numbers."""

from __future__ import annotations

import numpy as np

from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import Case
from tools.study.study import (
    CellResult,
    FigureName,
    ResultRow,
    Study,
    StudyResult,
    Sweep,
)
from tools.study.systems import System, system_named
from tools.study.trials import RunTally

STEPS = 40
RUNS = 200


def tally(
    final_m: float, settled: int = 10, worst_m: float | None = None, bound_m: float = 0.01
) -> RunTally:
    """Errors of 20 m until they settle, and of `final_m` from then on; one run may be worse."""
    rmse_m = np.where(np.arange(STEPS) < settled - 1, 20.0, final_m)
    finals = np.full(RUNS, final_m)
    finals[-1] = final_m if worst_m is None else worst_m
    return RunTally(
        runs=RUNS,
        squared_m2=RUNS * rmse_m**2,
        bound_m2=np.full(STEPS, RUNS * bound_m**2),
        nees=np.full(STEPS, 2.0 * RUNS),
        inside=np.full(STEPS, 0.95 * RUNS),
        range_offset_m=np.full(STEPS, 5.3 * RUNS),
        bearing_offset_rad=np.full(STEPS, -0.05 * RUNS),
        final_errors_m=finals,
    )


def cell(
    name: str,
    done: RunTally,
    table: str = "grand_summary",
    value: str = "1.5",
    parameter: str = "sigma_r_m",
    case: Case | None = None,
) -> CellResult:
    chosen = canonical_case() if case is None else case
    system = system_named(name)
    return CellResult(Sweep(parameter), 0, table, parameter, value, chosen, system, done)


def study(
    *cells: CellResult, title: str = "A study", figures: tuple[FigureName, ...] = ()
) -> StudyResult:
    settings = Study(table=cells[0].table, title=title, note="Why & how.", figures=figures)
    return StudyResult(settings, RUNS, 1, cells)


def row(
    system: System,
    ours: str,
    paper: str = "",
    metric: str = "final_rmse_m",
    ci95: str = "",
    bound: str = "",
    value: str = "1.5",
    table: str = "grand_summary",
    parameter: str = "sigma_r_m",
) -> ResultRow:
    return ResultRow(table, parameter, value, system.label, metric, paper, ours, ci95, bound)
