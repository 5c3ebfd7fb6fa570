"""Results of flights in the field: a summary of each cell, its tables and its figure.

A cell is a radio with a configuration and a planner. Definitions:

    reported              share of flights with a report before the cut
    coverage, absolute_coverage
                          of those that reported: share with the truth inside R95; consistent: 0.95
    beyond_3_r95          of those: share whose error is more than three times R95, both relative
    error_m ... absolute_r95_m
                          medians over those
    r95_over_error_95     median R95 over the 95 % quantile of the errors; 1 is ideal
    time_s                median over all flights, those without a report after all others; none
                          where they are half of them
    cut_error_m           median of the last estimates of those that did not report

Relative is about the position in the vehicle's own frame, absolute about that on the Earth.
Intervals of shares are Wilson's of 95 % (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import median

import numpy as np
from scipy.stats import binomtest

from tools.study.reporting import plots
from tools.study.reporting.plots import Drawing, finished
from tools.study.reporting.study_tables import interval, number
from tools.study.study import FlightRow, ResultRow

CONFIG_COLOURS = {"configured": plots.LATCHED, "unconfigured": plots.PASSIVE}
SHOWN_PLANNER = "latched_crossing"


def wilson(count: int, of: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share; all of [0, 1] without trials."""
    if of == 0:
        return (0.0, 1.0)
    low, high = binomtest(count, of).proportion_ci(method="wilson")
    return float(low), float(high)


def by_cell(rows: Iterable[FlightRow]) -> dict[tuple[str, str, str], list[FlightRow]]:
    """Return the flights of every radio, planner and configuration, in order."""
    cells: dict[tuple[str, str, str], list[FlightRow]] = {}
    for row in rows:
        cells.setdefault((row.radio, row.planner, row.config), []).append(row)
    return cells


def summary_of(rows: Iterable[FlightRow]) -> list[ResultRow]:
    """Return the rows of results.csv."""
    return [
        ResultRow("field", "radio", radio, f"{planner}, {kind.replace('_', ' ')}", metric, "", *own)
        for (radio, planner, kind), flights in by_cell(rows).items()
        for metric, *own in _figures(flights)
    ]


def _figures(flights: Sequence[FlightRow]) -> list[tuple[str, str, str, str]]:
    """Return metric, value, interval and requirement."""
    found = [f for f in flights if f.is_reported]
    lost = [f.error_m for f in flights if not f.is_reported and f.error_m is not None]
    own = [(f.error_m or 0.0, f.r95_m or 0.0) for f in found]
    earth = [(f.absolute_error_m or 0.0, f.absolute_r95_m or 0.0) for f in found]
    error_m, r95_m = _middle(e for e, _ in own), _middle(r for _, r in own)
    worst_m = float(np.quantile([e for e, _ in own], 0.95)) if own else math.nan
    return [
        ("flights", str(len(flights)), "", ""),
        ("reported", *_share(len(found), len(flights)), ""),
        ("coverage", *_share(sum(e <= r for e, r in own), len(own)), "0.95"),
        ("absolute_coverage", *_share(sum(e <= r for e, r in earth), len(earth)), "0.95"),
        ("beyond_3_r95", *_share(sum(e > 3.0 * r for e, r in own), len(own)), ""),
        ("error_m", _text(error_m), "", ""),
        ("r95_m", _text(r95_m), "", ""),
        ("r95_over_error_95", _text(r95_m / worst_m if worst_m else math.nan), "", ""),
        ("absolute_error_m", _text(_middle(e for e, _ in earth)), "", ""),
        ("absolute_r95_m", _text(_middle(r for _, r in earth)), "", ""),
        (
            "time_s",
            _text(_middle(f.time_s if f.is_reported else math.inf for f in flights)),
            "",
            "",
        ),
        ("cut_error_m", _text(_middle(lost)), "", ""),
    ]


def _middle(values: Iterable[float]) -> float:
    kept = list(values)
    return median(kept) if kept else math.nan


def _share(count: int, of: int) -> tuple[str, str]:
    return (number(count / of), interval(wilson(count, of))) if of else ("", "")


def _text(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""


COLUMNS = (
    ("flights", "flights"),
    ("reported", "reported"),
    ("time, s", "time_s"),
    ("error, m", "error_m"),
    ("R95, m", "r95_m"),
    ("inside R95", "coverage"),
    ("beyond 3 R95", "beyond_3_r95"),
    ("R95 over 95 % error", "r95_over_error_95"),
    ("absolute error, m", "absolute_error_m"),
    ("absolute R95, m", "absolute_r95_m"),
    ("inside absolute R95", "absolute_coverage"),
    ("error at the cut, m", "cut_error_m"),
)
"""Columns of the tables in Markdown: heading and metric."""
SHARES, WITH_INTERVAL = {"reported", "beyond_3_r95"}, {"coverage", "absolute_coverage"}


def markdown_of(rows: Iterable[ResultRow]) -> str:
    """Return a table for each radio, as pages have them."""
    cells: dict[str, dict[str, dict[str, str]]] = {}
    for row in rows:
        text = row.ours
        if row.metric in SHARES | WITH_INTERVAL:
            text = _percent(text, row.ours_ci95 if row.metric in WITH_INTERVAL else "")
        cells.setdefault(row.value, {}).setdefault(row.system, {})[row.metric] = text
    lines: list[str] = []
    for radio, systems in cells.items():
        lines += [f"### {radio}", "", f"| | {' | '.join(name for name, _ in COLUMNS)} |"]
        lines += ["|---" * (1 + len(COLUMNS)) + "|"]
        for system, texts in systems.items():
            lines.append(f"| {system} | {' | '.join(texts[metric] for _, metric in COLUMNS)} |")
        lines.append("")
    return "\n".join(lines)


def _percent(share: str, ends: str = "") -> str:
    if not share:
        return ""
    low, _, high = ends.partition("..")
    span = f" ({100.0 * float(low):.0f} to {100.0 * float(high):.0f})" if ends else ""
    percent = 100.0 * float(share)
    return f"{percent:.{1 if 0.0 < percent < 1.0 else 0}f} %{span}"


def drawing_of(rows: Sequence[FlightRow]) -> Drawing:
    """Return the error over R95 of every report, both relative, a panel for each radio."""
    radios = list(dict.fromkeys(row.radio for row in rows))
    with plots.look():
        figure, grid = plots.panels_of(len(radios), min(3, len(radios)), 2.5, 2.4)
        for axes, radio in zip(grid.flat, radios, strict=False):
            for kind, colour in CONFIG_COLOURS.items():
                own = [r for r in rows if (r.radio, r.config) == (radio, kind) and r.is_reported]
                shown = [r for r in own if r.planner == SHOWN_PLANNER] or own
                pairs = [(r.r95_m or math.nan, max(r.error_m or 0.0, 0.01)) for r in shown]
                label = kind.replace("_", " ")
                points = tuple(zip(*pairs, strict=True)) or ((), ())
                axes.plot(*points, "o", color=colour, ms=3, alpha=0.6, label=label)
            axes.set(xscale="log", yscale="log", title=radio.replace("_", " "))
            for factor, dashes in ((1.0, ()), (3.0, plots.DOTS)):
                ends = [0.1, 100.0]
                axes.plot(ends, [factor * end for end in ends], color=plots.MUTED, dashes=dashes)
            axes.set(xlabel="R95, m", ylabel="error, m", xlim=(0.1, 100.0), ylim=(0.01, 300.0))
        handles, names = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(names))
        caption = (
            "A dot is a report. Below the line it was inside of R95; above the dots its error was "
            f"more than three times R95. Planner {SHOWN_PLANNER} where it was flown."
        )
        return finished(figure, "field", "Error over R95, relative", caption, wide=True)
