"""Tables of the page: paper, ours and bound side by side, and who is ahead."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from sim_link.evaluation.reporting.figure_data import interval, numbers
from sim_link.evaluation.reporting.names import metric_name, parameter_name
from sim_link.evaluation.results import ResultRow

Verdict = Literal["ahead", "level", "behind", "inside", "outside", ""]

SMALLER_IS_BETTER = frozenset({"final_rmse_m", "steps_to_2.5m", "cost_ms_per_step"})
WITHIN = frozenset({"nees_final", "coverage_min", "coverage_mean", "coverage_max"})
"""Metrics whose bound is a band that an honest estimator stays within."""
FOLDED = frozenset({"worst_final_m", "diverged_runs"})
"""Metrics that stand beside the final RMSE instead of in a table of their own."""
OPEN = frozenset({"final_rmse_m", "steps_to_2.5m", "cost_ms_per_step"}) | WITHIN
"""Metrics whose tables are unfolded at first."""

Key = tuple[str, str, str]
"""Value, system, metric."""


@dataclass(frozen=True, slots=True)
class TableCell:
    """One system at one value."""

    paper: str
    ours: str
    bound: str
    verdict: Verdict
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TableRow:
    """One system over all values."""

    system: str
    cells: tuple[TableCell, ...]


@dataclass(frozen=True, slots=True)
class RowGroup:
    """The systems of one planner."""

    planner: str
    rows: tuple[TableRow, ...]


@dataclass(frozen=True, slots=True)
class TableView:
    """One metric over one parameter."""

    table: str
    metric: str
    title: str
    parameter: str
    values: tuple[str, ...]
    groups: tuple[RowGroup, ...]
    has_paper: bool
    has_bound: bool
    is_open: bool


def tables_of(rows: Iterable[ResultRow]) -> list[TableView]:
    """A table for each table, parameter and metric of the rows, in their order."""
    grouped: dict[tuple[str, str], dict[Key, ResultRow]] = {}
    for row in rows:
        own = grouped.setdefault((row.table, row.parameter), {})
        own.setdefault((row.value, row.system, row.metric), row)
    return [
        _table(table, parameter, metric, own)
        for (table, parameter), own in grouped.items()
        for metric in dict.fromkeys(metric for _, _, metric in own)
        if metric not in FOLDED
    ]


def verdict_of(row: ResultRow) -> Verdict:
    """Who is ahead, paper or ours; or whether ours is within the band that is asked for.

    Level is a paper's number inside of our 95 % interval, or the same number.
    """
    ours = _number(row.ours)
    if row.metric in WITHIN and row.bound:
        low, high = interval(row.bound)
        return "inside" if low <= ours <= high else "outside"
    paper = _number(row.paper)
    if row.metric not in SMALLER_IS_BETTER or math.isnan(paper) or math.isnan(ours):
        return ""
    low, high = interval(row.ours_ci95)
    if ours == paper or low <= paper <= high:
        return "level"
    return "ahead" if ours < paper else "behind"


def short(text: str) -> str:
    """A number in as many digits as can be compared: two below 0.1, otherwise three."""
    value = numbers(text)
    if not math.isfinite(value) or "." not in text:
        return text
    if value == 0.0:
        return "0"
    digits = 2 if abs(value) < 0.1 else 3
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}"


def count_verdicts(tables: Iterable[TableView]) -> dict[str, int]:
    """How many cells are ahead, level and behind."""
    found = {"ahead": 0, "level": 0, "behind": 0}
    for table in tables:
        for cell in (c for group in table.groups for row in group.rows for c in row.cells):
            if cell.verdict in found:
                found[cell.verdict] += 1
    return found


def _table(table: str, parameter: str, metric: str, own: dict[Key, ResultRow]) -> TableView:
    keys = [key for key in own if key[2] == metric]
    values = tuple(dict.fromkeys(value for value, _, _ in keys))
    systems = list(dict.fromkeys(system for _, system, _ in keys))
    planners: dict[str, list[TableRow]] = {}
    for system in systems:
        cells = tuple(_cell(own, value, system, metric) for value in values)
        planners.setdefault(_planner(system), []).append(TableRow(system, cells))
    rows = [own[key] for key in keys]
    return TableView(
        table=table,
        metric=metric,
        title=metric_name(metric),
        parameter=parameter_name(parameter),
        values=values,
        groups=tuple(RowGroup(name, tuple(found)) for name, found in planners.items()),
        has_paper=any(row.paper for row in rows),
        has_bound=any(row.bound for row in rows),
        is_open=metric in OPEN,
    )


def _cell(own: dict[Key, ResultRow], value: str, system: str, metric: str) -> TableCell:
    row = own.get((value, system, metric))
    if row is None:
        return TableCell("", "", "", "")
    notes: list[str] = []
    if row.ours_ci95:
        low, _, high = row.ours_ci95.partition("..")
        notes.append(f"{short(low)} to {short(high)}")
    if metric == "final_rmse_m":
        notes += _beside(own, value, system)
    low, dots, high = row.bound.partition("..")
    bound = f"{short(low)} to {short(high)}" if dots else short(row.bound)
    return TableCell(row.paper, short(row.ours), bound, verdict_of(row), tuple(notes))


def _beside(own: dict[Key, ResultRow], value: str, system: str) -> list[str]:
    """The worst run and how many diverged."""
    worst = own.get((value, system, "worst_final_m"))
    diverged = own.get((value, system, "diverged_runs"))
    found = [f"worst {short(worst.ours)}"] if worst else []
    if diverged and diverged.ours != "0":
        found.append(f"{diverged.ours} diverged")
    return found


def _planner(system: str) -> str:
    """The planner in a system's label."""
    return system.rpartition("(")[2].rstrip(")") if system.endswith(")") else ""


def _number(text: str) -> float:
    return math.inf if text.startswith(">") else numbers(text)


def rows_of(
    rows: Sequence[ResultRow], metric: str, table: str | None = None, system: str | None = None
) -> list[ResultRow]:
    """The rows of a metric, perhaps of one table or one system."""
    return [
        row
        for row in rows
        if row.metric == metric and table in (None, row.table) and system in (None, row.system)
    ]
