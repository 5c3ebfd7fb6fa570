"""Tables of the page, and names for people."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from tools.study.reporting.figure_data import interval, numbers
from tools.study.study import ResultRow

MU, SIGMA, ETA = "\N{GREEK SMALL LETTER MU}", "\N{GREEK SMALL LETTER SIGMA}", "\u03b7"
PARAMETERS = {
    "sigma_r_m": ("Range noise", SIGMA + "\u1d63", "m"),
    "p_nlos": ("Share of NLOS", "p", ""),
    "mean_bias_m": ("Mean NLOS bias", MU, "m"),
    "step_m": ("Step", ETA, "m"),
    "k_rtt": ("Threshold of ranges", "k", ""),
}
"""Parameters of the paper's tables: name, symbol and unit."""
METRICS = {
    "final_rmse_m": "Final RMSE, m",
    "steps_to_2.5m": "Steps until the RMSE settles below 2.5 m",
    "range_offset_m": "Final estimate of the range offset, m",
    "bound_ratio": "Final RMSE by the Cramer-Rao bound of its own tracks",
    "rmse_ratio": "Final RMSE by that of Proposed with the same planner, same seeds",
    "nees_final": "Mean NEES of the position after the last step",
    "nees_mean": "Mean NEES of the position over steps",
    "coverage_min": "Share of runs whose R95 circle holds the target: least over steps",
    "coverage_mean": "The same: mean over steps",
    "coverage_max": "The same: most over steps",
    "flights": "Flights",
    "reported": "Share of flights that reported before the cut",
    "coverage": "Share of reports with the truth inside of R95, relative",
    "absolute_coverage": "The same, absolute",
    "beyond_3_r95": "Share of reports whose error is more than three times R95",
    "error_m": "Median error, relative, m",
    "r95_m": "Median R95, relative, m",
    "r95_over_error_95": "Median R95 by the 95 % quantile of the errors",
    "absolute_error_m": "Median error, absolute, m",
    "absolute_r95_m": "Median R95, absolute, m",
    "time_s": "Median time from engaging to the report, s",
    "cut_error_m": "Median error at the cut of flights that did not report, m",
    "cost_ms_per_step": "Cost of a step, ms",
}
TYPESET = (
    (r"(?<=\d) to (?=[\d-])", "\u2009\N{EN DASH}\u2009"),
    (r" - ", " \N{EN DASH} "),
    (r"^-$", "\N{EN DASH}"),
    (r"(?<![\w.-])-(?=\d)", "\N{MINUS SIGN}"),
    (r" x (?=\S)", " \N{MULTIPLICATION SIGN} "),
    (r"<=", "\u2264"),
    (r">=", "\u2265"),
    (r"\.\.\.", "\N{HORIZONTAL ELLIPSIS}"),
    (r"(?<=[A-Za-z])'(?=[a-z])", "\N{RIGHT SINGLE QUOTATION MARK}"),
    (r"Cramer-Rao", "Cram\u00e9r\N{EN DASH}Rao"),
    (r"(?<=\d) (?=(m|ms|deg|cm|%|steps?|runs?)\b|%)", "\N{NO-BREAK SPACE}"),
)


def typeset(text: str) -> str:
    """Return plain text with the dashes, signs and spaces of print."""
    for pattern, sign in TYPESET:
        text = re.sub(pattern, sign, text)
    return text


def parameter_name(parameter: str) -> str:
    """Return a parameter with its symbol and unit, for an axis or a heading."""
    if parameter not in PARAMETERS:
        return parameter.replace("_", " ")
    name, symbol, unit = PARAMETERS[parameter]
    return f"{name} {symbol}, {unit}" if unit else f"{name} {symbol}"


def value_name(parameter: str, value: str) -> str:
    """Return a parameter at one of its values, for example p = 0.5."""
    if parameter not in PARAMETERS:
        return f"{parameter.replace('_', ' ')} {value}"
    _, symbol, unit = PARAMETERS[parameter]
    return f"{symbol} = {value} {unit}".strip()


def metric_name(metric: str) -> str:
    """Return the title of a metric's table."""
    match = re.fullmatch(r"rmse_after_(\d+)_steps_m", metric)
    if match:
        return f"RMSE after {match[1]} steps, as many as the paper needs to 2.5 m, m"
    return METRICS.get(metric, metric.replace("_", " "))


Verdict = Literal["ahead", "level", "behind", "diverged", "inside", "outside", ""]

SMALLER_IS_BETTER = frozenset({"final_rmse_m", "steps_to_2.5m", "cost_ms_per_step"})
WITHIN = frozenset({"nees_final", "coverage_min", "coverage_mean", "coverage_max"})
"""Metrics whose bound is a band that a consistent estimator stays within."""
BY_RMSE = frozenset({"final_rmse_m", "steps_to_2.5m"})
"""Metrics that one diverged run decides."""
FOLDED = frozenset({"worst_final_m", "median_final_m", "diverged_runs"})
"""Metrics shown next to the final RMSE instead of in a separate table."""
OPEN = WITHIN | {"final_rmse_m", "steps_to_2.5m", "cost_ms_per_step", "reported", "coverage"}
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
class TableView:
    """One metric over one parameter."""

    table: str
    metric: str
    title: str
    parameter: str
    values: tuple[str, ...]
    groups: dict[str, dict[str, tuple[TableCell, ...]]]
    """Cells by planner and system, one for each value."""
    has_paper: bool
    has_bound: bool
    is_open: bool


def tables_of(rows: Iterable[ResultRow]) -> list[TableView]:
    """Return a table for each table, parameter and metric of the rows, in order."""
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


def verdict_of(row: ResultRow, diverged: int = 0) -> Verdict:
    """Return the verdict: paper or companion ahead, or the companion within the requested band.

    The verdict is level if the paper's number equals ours or lies in our 95 % interval. If runs
    `diverged`, an RMSE follows one run, and its interval holds almost any number: no side is ahead.
    """
    ours = _number(row.ours)
    if row.metric in WITHIN and row.bound:
        low, high = interval(row.bound)
        return "inside" if low <= ours <= high else "outside"
    paper = _number(row.paper)
    if row.metric not in SMALLER_IS_BETTER or math.isnan(paper) or math.isnan(ours):
        return ""
    if diverged and row.metric in BY_RMSE:
        return "diverged"
    low, high = interval(row.ours_ci95)
    if ours == paper or low <= paper <= high:
        return "level"
    return "ahead" if ours < paper else "behind"


def short(text: str) -> str:
    """Return a number in as many digits as can be compared: two below 0.1, otherwise three."""
    value = numbers(text)
    if not math.isfinite(value) or "." not in text:
        return text
    if value == 0.0:
        return "0"
    digits = 2 if abs(value) < 0.1 else 3
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}"


def count_verdicts(tables: Iterable[TableView]) -> dict[str, int]:
    """Return the numbers of cells ahead, level and behind, and of those with diverged runs."""
    groups = (group for table in tables for group in table.groups.values())
    found = Counter(c.verdict for group in groups for cells in group.values() for c in cells)
    return {verdict: found[verdict] for verdict in ("ahead", "level", "behind", "diverged")}


def _table(table: str, parameter: str, metric: str, own: dict[Key, ResultRow]) -> TableView:
    keys = [key for key in own if key[2] == metric]
    values = tuple(dict.fromkeys(value for value, _, _ in keys))
    systems = list(dict.fromkeys(system for _, system, _ in keys))
    groups: dict[str, dict[str, tuple[TableCell, ...]]] = {}
    for system in systems:
        cells = tuple(_cell(own, value, system, metric) for value in values)
        planner = system.rpartition("(")[2].rstrip(")") if system.endswith(")") else ""
        groups.setdefault(planner, {})[system] = cells
    rows = [own[key] for key in keys]
    return TableView(
        table=table,
        metric=metric,
        title=metric_name(metric),
        parameter=parameter_name(parameter),
        values=values,
        groups=groups,
        has_paper=any(row.paper for row in rows),
        has_bound=any(row.bound for row in rows),
        is_open=metric in OPEN,
    )


def _cell(own: dict[Key, ResultRow], value: str, system: str, metric: str) -> TableCell:
    row = own.get((value, system, metric))
    if row is None:
        return TableCell("", "", "", "")
    notes: list[str] = []
    beside = {name: own[value, system, name] for name in FOLDED if (value, system, name) in own}
    diverged = int(beside["diverged_runs"].ours) if "diverged_runs" in beside else 0
    if row.ours_ci95:
        low, _, high = row.ours_ci95.partition("..")
        notes.append(f"{short(low)} to {short(high)}")
    if metric == "final_rmse_m":
        worst, median = beside.get("worst_final_m"), beside.get("median_final_m")
        notes += [f"worst {short(worst.ours)}"] if worst else []
        if diverged:
            notes += [f"{diverged} diverged"]
            notes += [f"median {short(median.ours)}"] if median else []
    low, dots, high = row.bound.partition("..")
    bound = f"{short(low)} to {short(high)}" if dots else short(row.bound)
    return TableCell(row.paper, short(row.ours), bound, verdict_of(row, diverged), tuple(notes))


def _number(text: str) -> float:
    return math.inf if text.startswith(">") else numbers(text)
