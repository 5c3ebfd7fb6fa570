"""Figures of lines: losses, errors and offsets after every step, and sensitivity to a parameter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from companion.estimation.filters.losses import (
    RobustLoss,
    asymmetric_huber,
    one_sided_huber,
    quadratic,
    symmetric_huber,
)
from sim_link.evaluation.metrics import SETTLED_M
from sim_link.evaluation.reporting.figure_data import Curve, Sensitivity
from sim_link.evaluation.reporting.gradients import Watch
from sim_link.evaluation.reporting.names import typeset
from sim_link.evaluation.reporting.style import (
    DOTS,
    FILTER_DASHES,
    FIM,
    LATCHED,
    MUTED,
    PASSIVE,
    PLANNER_COLOURS,
    label_ends,
    new_figure,
)
from sim_link.evaluation.systems import System

CURVES_IN = (5.2, 3.5)
"""Small enough to be read on a phone."""
STEP_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
METRE_TICKS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
BOUND = typeset("Cramer-Rao")
OURS = System("map", "latched")

LOSSES: tuple[tuple[RobustLoss, str, tuple[float, ...]], ...] = (
    (one_sided_huber(1.5), LATCHED, ()),
    (quadratic(), MUTED, (5.0, 1.6)),
    (asymmetric_huber(1.5, 3.0), FIM, (2.4, 1.4)),
    (symmetric_huber(1.5), PASSIVE, (5.0, 1.6, 1.2, 1.6)),
)
LOSS_NAMES: tuple[tuple[str, float, float, str], ...] = (
    ("one-sided Huber", -4.1, -4.75, LATCHED),
    ("asymmetric Huber", -2.7, -3.2, FIM),
    ("Huber", -4.9, -1.25, PASSIVE),
    ("quadratic", 1.6, 3.3, MUTED),
)
"""Where the names stand in the panel of the influence, left ends."""


def losses() -> Figure:
    """Loss and influence of a whitened residual. Paper: the figure of loss functions."""
    figure = new_figure(5.6, 2.6)
    left, right = figure.subplots(1, 2)
    u = np.linspace(-5.0, 5.0, 401)
    for loss, colour, dashes in LOSSES:
        width = 1.5 if dashes else 3.0  # the others stay visible where they lie upon it
        left.plot(u, [loss.loss(x) for x in u], color=colour, dashes=dashes, lw=width)
        right.plot(u, [loss.influence(x) for x in u], color=colour, dashes=dashes, lw=width)
    left.set(title="Loss", ylim=(0.0, 8.0), xlim=(-5.0, 5.0), xlabel="residual, in sigma")
    right.set(title="Influence: its derivative", ylim=(-5.2, 5.2), xlim=(-5.0, 5.0))
    right.set_xlabel("residual, in sigma")
    for axes in (left, right):
        axes.axvline(0.0, color=MUTED, linewidth=0.6)
    for name, x, y, colour in LOSS_NAMES:
        right.text(x, y, name, color=colour, fontsize=8.0)
    return figure


def rmse(curves: Sequence[Curve], title: str, printed: dict[System, float]) -> Figure:
    """RMSE after every step on log axes, with the bounds.

    Args:
        curves: RMSE and bounds, metres.
        title: Of the figure.
        printed: Final values of the paper.
    """
    figure = new_figure(*CURVES_IN)
    axes = figure.subplots()
    steps = len(curves[0].values)
    for curve in curves:
        draw_curve(axes, curve)
    lows = [float(np.nanmin(c.values[c.values > 0.0])) for c in curves if np.any(c.values > 0.0)]
    axes.set(xscale="log", yscale="log", xlim=(1, steps), ylim=(0.7 * min(lows), 60.0))
    axes.axhline(SETTLED_M, color=MUTED, linewidth=0.8)
    axes.annotate(
        f"threshold {SETTLED_M} m", (1.12, 1.08 * SETTLED_M), color=MUTED, fontsize=7.5, va="bottom"
    )
    for system, value in printed.items():
        colour = PLANNER_COLOURS[system.planner]
        axes.plot([steps], [value], "D", color=colour, mfc="none", ms=5, clip_on=False, zorder=5)
    step_axis(axes, steps)
    metre_axis(axes)
    axes.set(xlabel="step", ylabel="RMSE of the position, m")
    axes.set_title(title)
    figure.draw_without_rendering()
    label_ends(
        figure, axes, [end_label(curve) for curve in curves if not has_double(curve, curves)]
    )
    return figure


def offsets(curves: Sequence[Curve], title: str, unit: str, marks: dict[str, float]) -> Figure:
    """Mean estimate of an offset after every step.

    Args:
        curves: In the unit.
        title: Of the figure.
        unit: For example m.
        marks: Values worth a line, with their names.
    """
    figure = new_figure(*CURVES_IN)
    axes = figure.subplots()
    steps = len(curves[0].values)
    for curve in curves:
        draw_curve(axes, curve)
    everything = [*np.concatenate([curve.values for curve in curves]), *marks.values()]
    low, high = np.nanmin(everything), np.nanmax(everything)
    margin = 0.08 * (high - low)
    axes.set(xscale="log", xlim=(1, steps), ylim=(low - margin, high + margin))
    for name, value in marks.items():
        axes.axhline(value, color=MUTED, linewidth=0.8)
        axes.annotate(typeset(name), (1.12, value), color=MUTED, fontsize=7.5, va="bottom")
    step_axis(axes, steps)
    axes.set(xlabel="step", ylabel=f"mean estimate, {unit}")
    axes.set_title(title)
    figure.draw_without_rendering()
    label_ends(figure, axes, [end_label(curve) for curve in curves])
    return figure


def sensitivity(found: Sequence[Sensitivity], xlabel: str) -> Figure:
    """Final RMSE of each system over a parameter: ours, the paper's, and the bound."""
    columns = min(3, len(found))
    rows = math.ceil(len(found) / columns)
    figure = new_figure(2.5 * columns + 0.4, 2.15 * rows + 0.35)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for index, (axes, one) in enumerate(zip(grid.flat, found, strict=False)):
        _draw_sensitivity(axes, one)
        if index == 0:
            handles, names = axes.get_legend_handles_labels()
            figure.legend(handles, names, loc="outside upper right", ncols=3)
    for axes in grid.flat[len(found) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("final RMSE, m")
    for column in range(columns):
        last = max(row for row in range(rows) if row * columns + column < len(found))
        grid[last, column].set_xlabel(xlabel)
        grid[last, column].tick_params(labelbottom=True)
    return figure


def draw_curve(axes: Axes, curve: Curve) -> None:
    """A line over steps in the colour of its planner and the dashes of its filter."""
    system = curve.system
    axes.plot(
        np.arange(1, len(curve.values) + 1),
        curve.values,
        color=PLANNER_COLOURS[system.planner],
        dashes=DOTS if curve.is_bound else FILTER_DASHES.get(system.filter, ()),
        linewidth=1.1 if curve.is_bound else 2.3 if system == OURS else 1.3,
        zorder=3 if system == OURS else 2,
    )


def end_label(curve: Curve) -> tuple[float, str, str]:
    """Where a line ends, its name and its colour."""
    name = f"{BOUND} ({curve.system.planner})" if curve.is_bound else curve.system.label
    return float(curve.values[-1]), name, PLANNER_COLOURS[curve.system.planner]


def has_double(curve: Curve, curves: Sequence[Curve]) -> bool:
    """Whether the name of a bound is already at another line of the same planner."""
    bounds = [c for c in curves if c.is_bound and c.system.planner == curve.system.planner]
    return curve.is_bound and bounds[0] is not curve


def step_axis(axes: Axes, steps: int) -> None:
    """Ticks at round steps."""
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in STEP_TICKS if tick <= steps]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def metre_axis(axes: Axes) -> None:
    """Ticks at 1 and 3 of every decade, as plain numbers."""
    axes.yaxis.set_major_locator(FixedLocator(METRE_TICKS))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_sensitivity(axes: Axes, one: Sensitivity) -> None:
    colour = PLANNER_COLOURS[one.system.planner]
    axes.fill_between(one.values, one.low_m, one.high_m, color=colour, alpha=0.18, linewidth=0)
    axes.plot(one.values, one.ours_m, "o-", color=colour, ms=4, lw=1.8, label="measured")
    axes.plot(one.values, one.paper_m, "D--", color=MUTED, mfc="none", ms=4, lw=0.9, label="paper")
    axes.plot(one.values, one.bound_m, color=MUTED, dashes=DOTS, lw=1.3, label=BOUND)
    axes.set_yscale("log")
    axes.set_title(one.system.label, fontsize=8.5)
    axes.set_xticks(one.values, [f"{value:g}" for value in one.values])
    metre_axis(axes)


def gradients(watches: Sequence[Watch]) -> Figure:
    """What FIM's candidates differ by along flights, and where these are meanwhile."""
    figure = new_figure(7.2, 5.0)
    (filtered, printed), (distance, shadow) = figure.subplots(2, 2, sharex=True)
    for watch in watches:
        colour = PLANNER_COLOURS[watch.system.planner]
        steps = np.arange(1, watch.distance_m.shape[1] + 1)
        for axes, shares in ((filtered, watch.gradient), (printed, watch.printed_gradient)):
            low, median, high = np.quantile(100.0 * shares, (0.25, 0.5, 0.75), axis=0)
            axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
            axes.plot(steps, median, color=colour, label=watch.system.label)
        distance.plot(steps, np.median(watch.distance_m, axis=0), color=colour)
        shadow.plot(steps, 100.0 * watch.is_shadowed.mean(axis=0), color=colour)
    filtered.set(title="Gradient of FIM's criterion, %", ylim=(-2.0, 102.0))
    printed.set(title="Gradient of the printed criterion, %", ylim=(-2.0, 102.0))
    distance.set(title="Distance to the target, m", ylim=(0.0, None), xlabel="step")
    shadow.set(title="Runs in the shadow, %", ylim=(-2.0, 102.0), xlabel="step")
    distance.set_xlim(1, watches[0].distance_m.shape[1])
    handles, names = filtered.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    return figure
