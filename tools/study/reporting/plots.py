"""The look of figures, and figures of lines; their files are the same bytes every time.

A planner has its colour and a filter its line, everywhere. The colours are those of M. Okabe and
K. Ito, "Color Universal Design" (2008), the light ones darkened until they hold on white paper;
lines carry their names at their ends. On the page a figure is inline SVG whose colours are
variables of the page's light or dark theme; as a file it stands on white.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from scipy.optimize import isotonic_regression

from companion.estimation.filters.kalman import (
    asymmetric_huber_influence,
    asymmetric_huber_loss,
)
from companion.kernel import Matrix
from tools.study.metrics import SETTLED_M
from tools.study.reporting.figure_data import BEST, Curve, GradientWatch, Sensitivity
from tools.study.reporting.tables import typeset
from tools.study.systems import FilterName, PlannerName, System

STYLE: dict[Any, Any] = mpl.rc_params_from_file(
    Path(__file__).with_name("figures.mplstyle"), fail_on_error=True, use_default_template=False
)
INK, MUTED = STYLE["text.color"], STYLE["axes.edgecolor"]
GRID, PAGE = STYLE["grid.color"], STYLE["figure.facecolor"]
SHADE, SOLID = "#eceef2", "#c3c7d0"
PASSIVE, LATCHED, FIM, TRUTH = "#b96a00", "#0072b2", "#b8488f", "#00845f"
PRINTED_FIM = "#c8322b"
PLANNER_COLOURS: dict[PlannerName, str] = {
    "passive": PASSIVE,
    "reactive": INK,
    "latched": LATCHED,
    "fim": FIM,
    "fim_printed": PRINTED_FIM,
}
FILTER_DASHES: dict[FilterName, tuple[float, ...]] = {
    "asymmetric_huber": (),
    "map": (),
    "huber": (5.0, 1.6),
    "admm": (5.0, 1.6, 1.2, 1.6),
    "ekf": (2.4, 1.4),
}
DOTS = (1.0, 1.6)
THEMED = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAGE: "surface",
    SHADE: "shade",
    SOLID: "solid",
    PASSIVE: "passive",
    LATCHED: "latched",
    FIM: "fim",
    PRINTED_FIM: "printed-fim",
    TRUTH: "truth",
}
"""The page's variables for the colours of a figure."""
DPI = 180
LABEL_GAP_PT = 10.5
"""Gap between the baselines of two labels, points."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """Finished figure."""

    name: str
    """Name of its files, without an ending."""
    title: str
    caption: str
    svg: str
    png: bytes
    is_wide: bool = False
    """True if it needs the whole width of a page."""


@contextmanager
def look() -> Iterator[None]:
    """Apply the look of the figures to those made inside, whatever the user's own settings are."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        yield


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return a figure that belongs to no window and no global state."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def panels_of(
    count: int, columns: int, width_in: float, height_in: float, **shared: Any
) -> tuple[Figure, Any]:
    """Return a figure with a grid of this number of axes, by row and column."""
    rows = -(-count // columns)
    figure = new_figure(width_in * columns + 0.4, height_in * rows + 0.35)
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    return figure, grid


def finished(figure: Figure, name: str, title: str, caption: str, *, wide: bool = False) -> Drawing:
    """Return the figure as files, without dates and with names that follow from its own."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once for both files
    svg, png = StringIO(), BytesIO()
    canvas: Any = FigureCanvasSVG(figure)
    with mpl.rc_context({"svg.hashsalt": name}):
        canvas.print_svg(svg, metadata={"Date": None, "Creator": None})
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(png, metadata={"Software": None})
    return Drawing(name, title, caption, svg.getvalue(), png.getvalue(), wide)


def inline(drawing: Drawing) -> str:
    """Return the SVG as part of a page: its own ids, the page's colours, no fixed size."""
    text = drawing.svg[drawing.svg.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{drawing.name}-', text)
    text = text.replace("url(#", f"url(#{drawing.name}-")
    text = text.replace('href="#', f'href="#{drawing.name}-')
    text = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", text, count=1)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*"', r"<svg \1", text, count=1)
    for colour, variable in THEMED.items():
        text = text.replace(colour, f"var(--{variable})")
    return text.replace("<svg ", '<svg role="img" ', 1).strip()


def label_ends(figure: Figure, axes: Axes, labels: Sequence[tuple[float, str, str]]) -> None:
    """Write names at the right ends of lines, moved apart where they would collide.

    The axes have their limits and scales; a label is its y in data, its text, and its colour.
    """
    height_pt = axes.get_position().height * figure.get_figheight() * 72.0
    shares = axes.transAxes.inverted()
    ordered = sorted(
        (float(shares.transform(axes.transData.transform((1.0, y)))[1]), text, colour)
        for y, text, colour in labels
    )
    values = spread([position for position, _, _ in ordered], LABEL_GAP_PT / height_pt)
    line = {"arrowstyle": "-", "lw": 0.5, "shrinkA": 1.0, "shrinkB": 0.0, "relpos": (0.0, 0.5)}
    for (wanted, text, colour), position in zip(ordered, values, strict=True):
        axes.annotate(
            text,
            xy=(1.0, wanted),
            xytext=(1.035, position),
            xycoords="axes fraction",
            textcoords="axes fraction",
            color=colour,
            va="center",
            fontsize=8.0,
            annotation_clip=False,
            arrowprops={**line, "color": colour},
        )


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Return ascending positions at least `gap` apart and, in sum, as near as possible to `wanted`.

    Groups that collide are centred on the mean of their wanted positions.
    """
    steps = gap * np.arange(len(wanted))
    return (isotonic_regression(np.asarray(wanted) - steps).x + steps).tolist() if wanted else []


CURVES_IN = (5.2, 3.5)
"""Size of the figure, small enough to be read on a phone."""
STEP_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
METRE_TICKS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
BOUND = typeset("Cramer-Rao")
LOSSES: tuple[tuple[str, float, float, tuple[float, float], str, tuple[float, ...]], ...] = (
    ("one-sided Huber", 1.5, math.inf, (-4.1, -4.75), LATCHED, ()),
    ("quadratic", math.inf, math.inf, (1.6, 3.3), MUTED, (5.0, 1.6)),
    ("asymmetric Huber", 1.5, 3.0, (-2.7, -3.2), FIM, (2.4, 1.4)),
    ("Huber", 1.5, 1.5, (-4.9, -1.25), PASSIVE, (5.0, 1.6, 1.2, 1.6)),
)
"""Long and short threshold, left end of the name at the influence, colour and dashes of each."""


def losses() -> Figure:
    """Draw loss and influence of a whitened residual. Paper: the figure of loss functions."""
    figure = new_figure(5.6, 2.6)
    left, right = figure.subplots(1, 2)
    u = np.linspace(-5.0, 5.0, 401)
    for name, k_long, k_short, position, colour, dashes in LOSSES:
        width = 1.5 if dashes else 3.0  # the others stay visible where they lie upon it
        loss = [asymmetric_huber_loss(x, k_long, k_short) for x in u]
        influence = [asymmetric_huber_influence(x, k_long, k_short) for x in u]
        left.plot(u, loss, color=colour, dashes=dashes, lw=width)
        right.plot(u, influence, color=colour, dashes=dashes, lw=width)
        right.text(*position, name, color=colour, fontsize=8.0)
    left.set(title="Loss", ylim=(0.0, 8.0), xlim=(-5.0, 5.0), xlabel="residual, in sigma")
    right.set(title="Influence: its derivative", ylim=(-5.2, 5.2), xlim=(-5.0, 5.0))
    right.set_xlabel("residual, in sigma")
    for axes in (left, right):
        axes.axvline(0.0, color=MUTED, linewidth=0.6)
    return figure


def rmse(curves: Sequence[Curve], title: str, printed: dict[System, float]) -> Figure:
    """Draw RMSE and bounds, metres, after every step on log axes."""
    figure, axes, steps = _figure_of(curves, title, "RMSE of the position, m")
    lows = [float(np.nanmin(c.values[c.values > 0.0])) for c in curves if np.any(c.values > 0.0)]
    axes.set(yscale="log", ylim=(0.7 * min(lows), 60.0))
    _mark(axes, f"threshold {SETTLED_M} m", SETTLED_M, 1.08 * SETTLED_M)
    for system, value in printed.items():
        colour = PLANNER_COLOURS[system.planner]
        axes.plot([steps], [value], "D", color=colour, mfc="none", ms=5, clip_on=False, zorder=5)
    _set_ticks(axes.yaxis, METRE_TICKS)
    bounds = {curve.system.planner: curve for curve in reversed(curves) if curve.is_bound}
    named = [c for c in curves if not c.is_bound or bounds[c.system.planner] is c]
    _label_curves(figure, axes, named)
    return figure


def offsets(curves: Sequence[Curve], title: str, unit: str, marks: dict[str, float]) -> Figure:
    """Draw the mean estimate of an offset after every step; marks are named values with a line."""
    figure, axes, _ = _figure_of(curves, title, f"mean estimate, {unit}")
    everything = [*np.concatenate([curve.values for curve in curves]), *marks.values()]
    low, high = np.nanmin(everything), np.nanmax(everything)
    margin = 0.08 * (high - low)
    axes.set_ylim(low - margin, high + margin)
    for name, value in marks.items():
        _mark(axes, typeset(name), value, value)
    _label_curves(figure, axes, curves)
    return figure


def _figure_of(curves: Sequence[Curve], title: str, ylabel: str) -> tuple[Figure, Axes, int]:
    """Draw lines over steps on a log axis, coloured by planner and dashed by filter."""
    figure = new_figure(*CURVES_IN)
    axes = figure.subplots()
    steps = len(curves[0].values)
    for curve in curves:
        system = curve.system
        axes.plot(
            np.arange(1, len(curve.values) + 1),
            curve.values,
            color=PLANNER_COLOURS[system.planner],
            dashes=DOTS if curve.is_bound else FILTER_DASHES.get(system.filter, ()),
            linewidth=1.1 if curve.is_bound else 2.3 if system == BEST else 1.3,
            zorder=3 if system == BEST else 2,
        )
    axes.set(xscale="log", xlim=(1, steps), xlabel="step", ylabel=ylabel)
    axes.set_title(title)
    _set_ticks(axes.xaxis, [tick for tick in STEP_TICKS if tick <= steps])
    return figure, axes, steps


def _mark(axes: Axes, name: str, at: float, text_at: float) -> None:
    axes.axhline(at, color=MUTED, linewidth=0.8)
    axes.annotate(name, (1.12, text_at), color=MUTED, fontsize=7.5, va="bottom")


def _label_curves(figure: Figure, axes: Axes, curves: Sequence[Curve]) -> None:
    figure.draw_without_rendering()
    labels = []
    for curve in curves:
        planner, label = curve.system.planner, curve.system.label
        name = f"{BOUND} ({planner})" if curve.is_bound else label
        labels.append((float(curve.values[-1]), name, PLANNER_COLOURS[planner]))
    label_ends(figure, axes, labels)


def sensitivity(found: Sequence[Sensitivity], xlabel: str) -> Figure:
    """Draw the final RMSE of each system over a parameter: ours, the paper's, and the bound."""
    columns = min(3, len(found))
    figure, grid = panels_of(len(found), columns, 2.5, 2.15, sharex=True, sharey=True)
    for axes, one in zip(grid.flat, found, strict=False):
        _draw_sensitivity(axes, *one)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper right", ncols=3)
    for axes in grid[:, 0]:
        axes.set_ylabel("final RMSE, m")
    for column in range(columns):
        last = (len(found) - 1 - column) // columns
        grid[last, column].set_xlabel(xlabel)
        grid[last, column].tick_params(labelbottom=True)
    return figure


def _set_ticks(axis: Axis, values: Sequence[float]) -> None:
    """Set ticks at these values alone, as plain numbers."""
    axis.set_major_locator(FixedLocator(values))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_sensitivity(axes: Axes, system: System, figures: Matrix) -> None:
    values, ours_m, paper_m, bound_m, low_m, high_m = figures
    colour = PLANNER_COLOURS[system.planner]
    axes.fill_between(values, low_m, high_m, color=colour, alpha=0.18, linewidth=0)
    axes.plot(values, ours_m, "o-", color=colour, ms=4, lw=1.8, label="measured")
    axes.plot(values, paper_m, "D--", color=MUTED, mfc="none", ms=4, lw=0.9, label="paper")
    axes.plot(values, bound_m, color=MUTED, dashes=DOTS, lw=1.3, label=BOUND)
    axes.set_yscale("log")
    axes.set_title(system.label, fontsize=8.5)
    axes.set_xticks(values, [f"{value:g}" for value in values])
    _set_ticks(axes.yaxis, METRE_TICKS)


def gradients(watches: Sequence[GradientWatch]) -> Figure:
    """Plot the gradients of FIM's criterion along flights, with distance and shadow."""
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
