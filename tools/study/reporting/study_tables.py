"""The rows of results.csv, and the files of studies that they come from.

Definitions of the metrics, and numbers as they are written:

    final_rmse_m         after the last step; bound: the Cramer-Rao RMSE bound of the same tracks
    median_final_m       median over runs of the error after the last step, next to every RMSE
    diverged_runs        runs that end farther off than the paper's 2.5 m, next to every RMSE
    steps_to_2.5m        one more than the last step with an RMSE of at least 2.5 m; bound: that of
                         the bound's own curve
    rmse_after_N_steps_m after N steps; bound: at the same step
    worst_final_m        the largest error of a run after its last step
    range_offset_m       mean of the estimates after the last step
    bound_ratio          final RMSE by its bound
    rmse_ratio           final RMSE by that of Proposed with the same planner and the same draws
    nees_final           mean NEES of the position after the last step; bound: the consistent band;
                         nees_mean: over all steps after the 20th
    coverage_min, _mean, _max
                         share of runs whose R95 circle contains the target, over steps after the
                         20th; bound: the required share

Intervals are 95 % bootstrap percentiles; resamples are the same for all systems, so that those of
a ratio are paired.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from companion.config.loader import load_yaml
from companion.errors import ConfigError
from companion.kernel import Matrix, Vector
from tools.study import metrics
from tools.study import study as studies
from tools.study.study import Cell, CellResult, Metric, ResultRow, Study, StudyResult

RESAMPLES = 2000
BOOTSTRAP_SEED = 0
DIGITS = 5
REFERENCE_FILTER = "asymmetric_huber"

Numbers = tuple[str, ...]
"""Metric, ours and perhaps its interval and its bound, as written."""


Measure = Callable[[StudyResult, CellResult], list[Numbers]]


def rows_of(result: StudyResult) -> list[ResultRow]:
    """Return the rows of a study, in the order of its tables; costs are not among them."""
    return [
        row
        for cell in result.cells
        for metric in metrics_of(result, cell)
        if metric != "cost_ms_per_step"
        for name, *numbers in MEASURED[metric](result, cell)
        for row in rows_about(cell, name, *numbers)
    ]


def metrics_of(result: StudyResult, cell: Cell) -> Sequence[Metric]:
    """Return the metrics shown for a cell."""
    return result.study.metrics if cell.sweep.metrics is None else cell.sweep.metrics


def rows_about(
    cell: Cell, metric: str, ours: str, ours_ci95: str = "", bound: str = ""
) -> list[ResultRow]:
    """Return the row about a cell, and another if the paper prints it under a second name."""
    rows: list[ResultRow] = []
    for name in studies.names_of(cell.system):
        numbers = {str(key): of for key, of in cell.sweep.paper.get(name, {}).items()}
        printed = numbers[metric][cell.index] if metric in numbers else None
        paper = "" if printed is None else str(printed)
        if name == cell.system.label or paper:
            row = (cell.table, cell.parameter, cell.value, name)
            rows.append(ResultRow(*row, metric, paper, ours, ours_ci95, bound))
    return rows


def number(value: float) -> str:
    """Return a number with its significant digits."""
    return f"{value:.{DIGITS}g}"


def bound_text(value: float) -> str:
    """Return a bound as text, empty if none is known."""
    return "" if math.isnan(value) else number(value)


def interval(ends: tuple[float, float] | None) -> str:
    """Return both ends as text, or nothing."""
    return "" if ends is None else f"{number(ends[0])}..{number(ends[1])}"


def rmse_interval_m(errors_m: Vector) -> tuple[float, float] | None:
    """Return the interval of the RMSE of (runs,) errors; None if one of them is not finite."""
    if not np.isfinite(errors_m).all():
        return None
    return _ends(np.sqrt(_resampled(errors_m) / errors_m.size))


def ratio_interval(errors_m: Vector, others_m: Vector) -> tuple[float, float] | None:
    """Return the interval of a ratio of RMSE, (runs,) errors of the same draws; None as above."""
    if not (np.isfinite(errors_m).all() and np.isfinite(others_m).all()):
        return None
    return _ends(np.sqrt(_resampled(errors_m) / _resampled(others_m)))


def _resampled(errors_m: Vector) -> Vector:
    """Return sums of squares in each resample, (RESAMPLES,)."""
    sums: Vector = np.einsum("ij,j->i", resamples(errors_m.size), np.square(errors_m))
    return sums


@lru_cache(maxsize=1)
def resamples(runs: int) -> Matrix:
    """Return the counts of each run in each bootstrap resample, (RESAMPLES, runs)."""
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    return rng.multinomial(runs, np.full(runs, 1.0 / runs), size=RESAMPLES).astype(np.float64)


def _ends(values: Vector) -> tuple[float, float]:
    low, high = np.quantile(values, (0.025, 0.975))
    return float(low), float(high)


def _final_rmse(_: StudyResult, cell: CellResult) -> list[Numbers]:
    tally = cell.tally
    ends, bound = interval(rmse_interval_m(tally.final_errors_m)), tally.rmse_bound_m[-1]
    return [
        ("final_rmse_m", number(tally.final_m), ends, bound_text(bound)),
        ("median_final_m", number(tally.median_m)),
        ("diverged_runs", str(tally.diverged())),
    ]


def _steps(_: StudyResult, cell: CellResult) -> list[Numbers]:
    ours, bound = cell.tally.rmse_m, cell.tally.rmse_bound_m
    return [("steps_to_2.5m", _steps_text(ours), "", _steps_text(bound))]


def _steps_text(rmse_by_step_m: Vector) -> str:
    if np.isnan(rmse_by_step_m).all():
        return ""
    steps = metrics.steps_to_settle(rmse_by_step_m)
    return f">{rmse_by_step_m.size}" if steps is None else str(steps)


def _after_steps(_: StudyResult, cell: CellResult) -> list[Numbers]:
    steps = cell.sweep.after_steps[cell.index]
    rmse_m, bound_m = cell.tally.rmse_m, cell.tally.rmse_bound_m
    at = min(steps, rmse_m.size) - 1
    return [(f"rmse_after_{steps}_steps_m", number(rmse_m[at]), "", bound_text(bound_m[at]))]


def _range_offset(_: StudyResult, cell: CellResult) -> list[Numbers]:
    return [("range_offset_m", number(cell.tally.range_offset_m[-1] / cell.tally.runs))]


def _bound_ratio(_: StudyResult, cell: CellResult) -> list[Numbers]:
    tally = cell.tally
    bound_m = float(tally.rmse_bound_m[-1])
    ends = rmse_interval_m(tally.final_errors_m)
    if not 0.0 < bound_m < math.inf:
        return []
    scaled = None if ends is None else (ends[0] / bound_m, ends[1] / bound_m)
    return [("bound_ratio", number(tally.final_m / bound_m), interval(scaled), "1")]


def _rmse_ratio(result: StudyResult, cell: CellResult) -> list[Numbers]:
    """Return the ratio to Proposed with the same planner in the same case, but of itself none."""
    for other in result.cells:
        is_same = other.case == cell.case and other.system.planner == cell.system.planner
        if is_same and other.system.filter == REFERENCE_FILTER != cell.system.filter:
            ours, theirs = cell.tally, other.tally
            ends = ratio_interval(ours.final_errors_m, theirs.final_errors_m)
            return [("rmse_ratio", number(ours.final_m / theirs.final_m), interval(ends))]
    return []


def _nees(_: StudyResult, cell: CellResult) -> list[Numbers]:
    means, band = cell.tally.mean_nees, interval(metrics.nees_band(cell.tally.runs))
    over_steps = float(np.mean(_settled(means)))
    return [("nees_final", number(means[-1]), "", band), ("nees_mean", number(over_steps))]


def _settled(by_step: Vector) -> Vector:
    """Return the values over the steps that count; of a short run the last one."""
    return by_step[min(metrics.SETTLED_STEP, by_step.size - 1) :]


def _coverage(_: StudyResult, cell: CellResult) -> list[Numbers]:
    shares, band = _settled(cell.tally.coverage), interval(metrics.COVERAGE_BAND)
    found = {"min": shares.min(), "mean": shares.mean(), "max": shares.max()}
    return [(f"coverage_{name}", number(float(share)), "", band) for name, share in found.items()]


MEASURED: dict[Metric, Measure] = {
    "final_rmse_m": _final_rmse,
    "steps_to_2.5m": _steps,
    "rmse_after_steps_m": _after_steps,
    "worst_final_m": lambda _, cell: [("worst_final_m", number(cell.tally.worst_m))],
    "range_offset_m": _range_offset,
    "bound_ratio": _bound_ratio,
    "rmse_ratio": _rmse_ratio,
    "nees": _nees,
    "coverage": _coverage,
}
"""Function that measures each metric; one may give several rows."""


SUFFIX = ".yaml"


def studies_of(name: str, folder: Path) -> list[Study]:
    """Return the studies of a name or file, itself or those it collects; raises a `ConfigError`."""
    path = study_path(name, folder)
    study = load_study(path)
    try:
        found = [load_study(study_path(each, folder)) for each in study.studies] or [study]
    except ConfigError as error:
        raise ConfigError(f"{path}: $.studies: {error}") from None
    if any(each.studies for each in found):
        raise ConfigError(f"{path}: $.studies: the collection contains itself, or another one")
    return found


def study_path(name: str, folder: Path) -> Path:
    """Return the file of a study; raise ConfigError if missing."""
    if name.endswith((SUFFIX, ".yml")) or os.sep in name:
        return Path(name)
    path = folder / f"{name}{SUFFIX}"
    if not path.is_file():
        known = sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))
        raise ConfigError(f"study {name}: there is none of this name; {studies.hint(name, known)}")
    return path


def load_study(path: Path) -> Study:
    """Return the study in a file, all of its cells checked; a ConfigError names the error."""
    try:
        study = load_yaml(path, Study)
    except ConfigError as error:
        raise ConfigError("; ".join(str(error).splitlines())) from None
    if bool(study.studies) + bool(study.sweeps) + (study.flights is not None) != 1:
        raise ConfigError(f"{path}: $: give `sweeps`, or `studies` of a collection, or `flights`")
    try:
        studies.cells_of(study)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return study
