"""Figures of places: what is flown, what is believed, and what stands in the way."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.patheffects as effects
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sim_link.evaluation.case import Case
from sim_link.evaluation.reporting.figure_data import Flight, shadow_quads
from sim_link.evaluation.reporting.style import (
    INK,
    MUTED,
    PAGE,
    PLANNER_COLOURS,
    SHADE,
    SOLID,
    TRUTH,
    new_figure,
)

MARGIN_M = 4.0
NEAR_M = 4.0
"""Half the side of the enlarged surroundings of the target."""
NEAR_SHARE = 0.36
"""How much of the map's side they take."""
NEAR_STEPS = 60
"""The last steps, which are what is drawn there."""


def tracks(flights: Sequence[Flight], case: Case) -> Figure:
    """Tracks with the estimates along them, one panel for each system.

    Args:
        flights: Of one seed.
        case: Area, target and obstacles.
    """
    columns = min(len(flights), 3 if len(flights) > 4 else 2)
    rows = -(-len(flights) // columns)
    side_in = 3.6 if columns < 3 else 3.0
    figure = new_figure(side_in * columns, (side_in + 0.15) * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, flight in zip(grid.flat, flights, strict=False):
        _draw_map(axes, flight, case)
    for axes in grid.flat[len(flights) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("north, m")
    for axes in grid[-1]:
        axes.set_xlabel("east, m")
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), handlelength=1.4)
    return figure


def draw_obstacles(axes: Axes, case: Case) -> None:
    """The obstacles, and where they block the path to the target."""
    for obstacle in case.obstacles:
        for quad in shadow_quads(obstacle.corners_enu_m, case.target_enu_m):
            axes.fill(*zip(*quad, strict=True), facecolor=SHADE, linewidth=0, zorder=0.2)
    for obstacle in case.obstacles:
        corners = zip(*obstacle.corners_enu_m, strict=True)
        axes.fill(*corners, facecolor=SOLID, edgecolor=MUTED, linewidth=0.6, zorder=0.4)


def _draw_map(axes: Axes, flight: Flight, case: Case) -> None:
    width_m, depth_m = case.area_m
    axes.grid(visible=False)
    _draw_flight(axes, flight, case, slice(None))
    axes.set(xlim=(-MARGIN_M, width_m + MARGIN_M), ylim=(-MARGIN_M, depth_m + MARGIN_M))
    axes.set_aspect("equal")
    axes.set_title(f"{flight.system.label}\n", fontsize=9.0)
    axes.text(
        0.0,
        1.025,
        f"ends {_short(flight.final_error_m)} off",
        transform=axes.transAxes,
        color=MUTED,
        fontsize=8.0,
    )
    if flight.system.planner != "passive":
        _draw_near(axes, flight, case)


def _draw_flight(axes: Axes, flight: Flight, case: Case, part: slice) -> None:
    colour = PLANNER_COLOURS[flight.system.planner]
    draw_obstacles(axes, case)
    estimates, track = flight.estimates_enu_m[part].T, flight.track_enu_m[part].T
    axes.plot(*estimates, color=TRUTH, lw=0.7, alpha=0.75, label="estimate", zorder=2)
    axes.plot(*track, color=colour, lw=1.0, label="vehicle", zorder=3)
    axes.plot(*case.start_enu_m, "o", color=colour, mec=PAGE, ms=6, label="start", zorder=4, lw=0)
    halo = [effects.withStroke(linewidth=3.0, foreground=PAGE)]
    axes.plot(
        *case.target_enu_m,
        "x",
        color=INK,
        ms=7,
        mew=1.6,
        label="target",
        zorder=5,
        lw=0,
        path_effects=halo,
    )


def _draw_near(axes: Axes, flight: Flight, case: Case) -> None:
    """The end of a flight about the target, enlarged, in the corner where least is flown."""
    east, north = case.target_enu_m
    near = axes.inset_axes((0.985 - NEAR_SHARE, 0.015, NEAR_SHARE, NEAR_SHARE))
    near.set_facecolor(PAGE)
    near.grid(visible=False)
    _draw_flight(near, flight, case, slice(-NEAR_STEPS, None))
    near.set(xlim=(east - NEAR_M, east + NEAR_M), ylim=(north - NEAR_M, north + NEAR_M))
    near.set(xticks=[], yticks=[], aspect="equal")
    for spine in near.spines.values():
        spine.set(visible=True, color=MUTED, linewidth=0.7)
    near.text(
        0.5,
        1.03,
        f"{2 * NEAR_M:g} m",
        transform=near.transAxes,
        ha="center",
        color=MUTED,
        fontsize=7,
    )


def _short(metres: float) -> str:
    return f"{100.0 * metres:.1f} cm" if metres < 0.1 else f"{metres:.2f} m"
