"""The figures of a study, by the names that it asks for them (`FIGURES`).

A figure whose systems a study does not fly is left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tools.study.case import Case
from tools.study.reporting import figure_data, plots
from tools.study.reporting.figure_data import Flight, GradientWatch
from tools.study.reporting.plots import Drawing, finished
from tools.study.reporting.tables import parameter_name, value_name
from tools.study.study import ResultRow, StudyResult

MARGIN_M = 4.0
NEAR_M = 4.0
"""Half the side of the enlarged surroundings of the target."""
NEAR_SHARE = 0.36
"""Share of the map's side that they take."""
NEAR_STEPS = 60
"""Last steps, the ones drawn there."""


def tracks(flights: Sequence[Flight], case: Case) -> Figure:
    """Return tracks with the estimates along them, one panel for each system."""
    columns = min(len(flights), 3 if len(flights) > 4 else 2)
    side_in = 3.5 if columns < 3 else 2.9
    shared = {"sharex": True, "sharey": True}
    figure, grid = plots.panels_of(len(flights), columns, side_in, side_in, **shared)
    for axes, flight in zip(grid.flat, flights, strict=False):
        _draw_map(axes, flight, case)
    for axes in grid[:, 0]:
        axes.set_ylabel("north, m")
    for axes in grid[-1]:
        axes.set_xlabel("east, m")
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), handlelength=1.4)
    return figure


def _draw_map(axes: Axes, flight: Flight, case: Case) -> None:
    system, trial = flight
    width_m, depth_m = case.area_m
    axes.grid(visible=False)
    _draw_flight(axes, flight, case, slice(None))
    axes.set(xlim=(-MARGIN_M, width_m + MARGIN_M), ylim=(-MARGIN_M, depth_m + MARGIN_M))
    axes.set_aspect("equal")
    axes.set_title(f"{system.label}\n", fontsize=9.0)
    off_m = float(trial.errors_m[-1])
    off = f"ends {100.0 * off_m:.1f} cm off" if off_m < 0.1 else f"ends {off_m:.2f} m off"
    axes.text(0.0, 1.025, off, transform=axes.transAxes, color=plots.MUTED, fontsize=8.0)
    if system.planner != "passive":
        _draw_near(axes, flight, case)


def _draw_flight(axes: Axes, flight: Flight, case: Case, part: slice) -> None:
    """Draw a flight, its obstacles, and where they block the path to the target."""
    system, trial = flight
    colour = plots.PLANNER_COLOURS[system.planner]
    for obstacle in case.obstacles:
        for quad in figure_data.shadow_quads(obstacle.corners_enu_m, case.target_enu_m):
            axes.fill(*zip(*quad, strict=True), facecolor=plots.SHADE, linewidth=0, zorder=0.2)
    for obstacle in case.obstacles:
        corners = zip(*obstacle.corners_enu_m, strict=True)
        axes.fill(*corners, facecolor=plots.SOLID, edgecolor=plots.MUTED, linewidth=0.6, zorder=0.4)
    estimates, track = trial.estimates_enu_m[part].T, trial.track_enu_m[part].T
    axes.plot(*estimates, color=plots.TRUTH, lw=0.7, alpha=0.75, label="estimate", zorder=2)
    axes.plot(*track, color=colour, lw=1.0, label="vehicle", zorder=3)
    axes.plot(
        *case.start_enu_m, "o", color=colour, mec=plots.PAGE, ms=6, label="start", zorder=4, lw=0
    )
    cross: dict[str, Any] = {"color": plots.INK, "ms": 7, "mew": 1.6, "label": "target", "lw": 0}
    halo = [effects.withStroke(linewidth=3.0, foreground=plots.PAGE)]
    axes.plot(*case.target_enu_m, "x", **cross, zorder=5, path_effects=halo)


def _draw_near(axes: Axes, flight: Flight, case: Case) -> None:
    """Draw the end of a flight about the target, enlarged, in the corner with the least track."""
    east, north = case.target_enu_m
    near = axes.inset_axes((0.985 - NEAR_SHARE, 0.015, NEAR_SHARE, NEAR_SHARE))
    near.set_facecolor(plots.PAGE)
    near.grid(visible=False)
    _draw_flight(near, flight, case, slice(-NEAR_STEPS, None))
    near.set(xlim=(east - NEAR_M, east + NEAR_M), ylim=(north - NEAR_M, north + NEAR_M))
    near.set(xticks=[], yticks=[], aspect="equal")
    for spine in near.spines.values():
        spine.set(visible=True, color=plots.MUTED, linewidth=0.7)
    size = f"{2 * NEAR_M:g} m"
    near.text(0.5, 1.03, size, transform=near.transAxes, ha="center", color=plots.MUTED, fontsize=7)


PAPER_OFFSET_M = 5.5
"""Effective range offset that the paper's filter converges to, section "Bias Learning"."""

EARLY_STEPS = 20
"""Steps in which a planner either leaves the shadow or stalls in it."""

Maker = Callable[[StudyResult, Sequence[ResultRow]], list[Drawing]]


def drawings_of(result: StudyResult, rows: Sequence[ResultRow]) -> list[Drawing]:
    """Return every figure that a study asks for, in its order; unknown names are left out."""
    with plots.look():
        names = [name for name in result.study.figures if name in FIGURES]
        return [drawing for name in names for drawing in FIGURES[name](result, rows)]


def _losses(result: StudyResult, _: Sequence[ResultRow]) -> list[Drawing]:
    caption = (
        "What a whitened residual costs, and how hard it pulls. A range can only be too long: the "
        "one-sided loss of the paper is linear above k = 1.5 sigma and quadratic below. Huber's is "
        "linear on both sides; ours can be linear below -3 sigma as well, for sensors with bursts "
        "that are too short."
    )
    return [finished(plots.losses(), f"{result.study.table}_losses", "Loss functions", caption)]


def _rmse(result: StudyResult, rows: Sequence[ResultRow]) -> list[Drawing]:
    found: list[Drawing] = []
    for parameter, value in figure_data.values_of(result):
        cells = figure_data.cells_at(result, parameter, value)
        lines = figure_data.rmse_curves(cells)
        if not lines:
            continue
        table = next(iter(cells.values())).table
        key = (table, parameter, value, "final_rmse_m")
        shown = {line.system.label: line.system for line in lines}
        printed = {
            shown[row.system]: figure_data.numbers(row.paper)
            for row in rows
            if (row.table, row.parameter, row.value, row.metric) == key
            and row.system in shown
            and row.paper
        }
        title = f"Error after every step{_where(result, parameter, value)}"
        diamonds = " Diamonds: final values that the paper prints." if printed else ""
        caption = (
            f"RMSE of {result.runs} runs on log axes. Dotted: what no estimator can beat on the "
            f"tracks of that planner (early on it counts no prior).{diamonds}"
        )
        figure = plots.rmse(lines, title, printed)
        found.append(finished(figure, _file(table, "rmse", parameter, value), title, caption))
    return found


def _offsets(result: StudyResult, _: Sequence[ResultRow]) -> list[Drawing]:
    parameter, value = _middle(result)
    cells = figure_data.cells_at(result, parameter, value)
    lines = figure_data.offset_curves(cells, bearing=False)
    if not lines:
        return []
    channel = cells[lines[0].system].case.channel
    where = _where(result, parameter, value)
    range_marks = {
        f"radio alone {channel.range_offset_m:g} m": channel.range_offset_m,
        f"paper, about {PAPER_OFFSET_M:g} m": PAPER_OFFSET_M,
    }
    bearing_marks = {f"true {channel.bearing_offset_deg:g} deg": channel.bearing_offset_deg}
    bearings = figure_data.offset_curves(cells, bearing=True)
    table = result.study.table
    return [
        finished(
            plots.offsets(lines, f"Range offset{where}", "m", range_marks),
            f"{table}_range_offset",
            "Range offset after every step",
            "Mean of the estimates. Nine of ten ranges are too long, so what a robust filter takes "
            "for the offset is the radio's plus the NLOS bias that is always there.",
        ),
        finished(
            plots.offsets(bearings, f"Bearing offset{where}", "deg", bearing_marks),
            f"{table}_bearing_offset",
            "Bearing offset after every step",
            "Mean of the estimates. Reflections bend to either side, so all converge to the truth.",
        ),
    ]


def _tracks(result: StudyResult, _: Sequence[ResultRow]) -> list[Drawing]:
    parameter, value = _middle(result)
    case = _case_at(result, parameter, value)
    figure = tracks(figure_data.flights_of(case, result.seed), case)
    shadow = " Grey: the obstacle and its shadow." if case.obstacles else ""
    caption = (
        f"The first run of seed {result.seed}, {case.steps} steps, the same noise for all."
        f"{shadow} Inset: the last {NEAR_STEPS} steps, {2 * NEAR_M:g} m wide."
    )
    title = f"Tracks{_where(result, parameter, value)}"
    return [finished(figure, f"{result.study.table}_tracks", title, caption, wide=True)]


def _gradients(result: StudyResult, _: Sequence[ResultRow]) -> list[Drawing]:
    case = _case_at(result, *_middle(result))
    watches = figure_data.watched(case, result.seed)
    flat_m = case.belief.range_sigma_m / math.radians(case.belief.bearing_sigma_deg)
    caption = (
        "How far the best of FIM's candidates is ahead of the worst, as a share of the best: "
        f"median and quartiles of {len(watches[0].gradient)} runs. Left with the filter's "
        "covariance as prior and the offsets as nuisance, right as the paper prints it: flat "
        f"nearer than {flat_m:.0f} m, where all candidates are alike and one is picked by chance. "
        f"Median over the first {EARLY_STEPS} steps (printed criterion in brackets), and steps in "
        f"the shadow: {'; '.join(_in_shadow(watch) for watch in watches)}."
    )
    title = "Why FIM stalls: the gradient over its candidates"
    figure = plots.gradients(watches)
    return [finished(figure, f"{result.study.table}_gradients", title, caption, wide=True)]


def _in_shadow(watch: GradientWatch) -> str:
    early = slice(0, EARLY_STEPS)
    own = 100.0 * float(np.median(watch.gradient[:, early]))
    printed = 100.0 * float(np.median(watch.printed_gradient[:, early]))
    steps = float(np.median(watch.is_shadowed.sum(axis=1)))
    return f"{watch.system.label} {own:.0f} % ({printed:.0f} %), {steps:g} steps"


def _sensitivity(result: StudyResult, rows: Sequence[ResultRow]) -> list[Drawing]:
    found: list[Drawing] = []
    tables = {cell.parameter: cell.table for cell in reversed(result.cells)}
    for parameter in dict.fromkeys(cell.parameter for cell in result.cells):
        lines = figure_data.sensitivities(result, rows, parameter)
        if not lines or np.isnan(lines[0][1][0]).any() or len(lines[0][1][0]) < 2:
            continue
        name = parameter_name(parameter)
        found.append(
            finished(
                plots.sensitivity(lines, name),
                _file(tables[parameter], "sensitivity", parameter),
                f"Sensitivity: {name.partition(',')[0]}",
                "Final RMSE measured (with its 95 % interval), as the paper prints it, and the "
                "least that any estimator could reach on the same tracks.",
                wide=True,
            )
        )
    return found


FIGURES: dict[str, Maker] = {
    "losses": _losses,
    "rmse": _rmse,
    "offsets": _offsets,
    "tracks": _tracks,
    "gradients": _gradients,
    "sensitivity": _sensitivity,
}


def _middle(result: StudyResult) -> tuple[str, str]:
    """Return the case in the middle of a study: the canonical one of the paper's sweeps."""
    values = figure_data.values_of(result)
    return values[(len(values) - 1) // 2]


def _case_at(result: StudyResult, parameter: str, value: str) -> Case:
    return next(iter(figure_data.cells_at(result, parameter, value).values())).case


def _where(result: StudyResult, parameter: str, value: str) -> str:
    is_one_of_many = len(figure_data.values_of(result)) > 1
    return f", {value_name(parameter, value)}" if is_one_of_many else ""


def _file(*parts: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", "_".join(parts))
