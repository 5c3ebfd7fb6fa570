"""`track.png`: the flight and the estimate, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # a file, never a window: the demonstration runs over SSH too

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from companion.domain import TargetEstimate
from companion.geometry.polygons import deepest_point, ellipse_95

VEHICLE, ESTIMATE, TRUTH, CROSSING = "#1f4e79", "#d1495b", "#2a9d3f", "#edae49"
OBSTACLE = "0.8"


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A solid obstacle on the ground."""

    name: str
    corners_enu_m: Sequence[tuple[float, float]]
    height_m: float | None
    """Height in m; None: higher than any flight."""

    @property
    def label(self) -> str:
        """Label of the obstacle: its name, and its height if it can be flown over."""
        return self.name if self.height_m is None else f"{self.name}, {self.height_m:g} m"


@dataclass(frozen=True, slots=True)
class PlottedFlight:
    """Contents of the picture; all positions local east and north, metres."""

    track_enu_m: Sequence[tuple[float, float]]
    estimates: Sequence[tuple[float, float, float, float]]
    crossings_enu_m: Sequence[tuple[float, float]]
    fence_enu_m: Sequence[tuple[float, float]]
    obstacles: Sequence[Obstacle]
    truth_enu_m: tuple[float, float]
    final: TargetEstimate
    title: str


def draw(path: Path, flight: PlottedFlight) -> None:
    """Draw the flight into a PNG file: the whole, the target's surroundings, the error."""
    figure = plt.figure(figsize=(13.0, 6.6), dpi=110, layout="constrained")
    axes = figure.subplot_mosaic([["whole", "near"], ["whole", "error"]], width_ratios=(1.15, 1))
    _draw_map(axes["whole"], flight)
    axes["whole"].set_title("Flight")
    axes["whole"].legend(loc="lower right", fontsize=8)
    _draw_map(axes["near"], flight)
    _zoom(axes["near"], flight)
    _draw_error(axes["error"], flight)
    figure.suptitle(flight.title)
    figure.savefig(path)
    plt.close(figure)


def _draw_map(axes: Axes, flight: PlottedFlight) -> None:
    fence = np.array([*flight.fence_enu_m, flight.fence_enu_m[0]])
    track = np.array(flight.track_enu_m)
    estimates = np.array(flight.estimates)[:, 1:3]
    for obstacle in flight.obstacles:
        corners = np.array(obstacle.corners_enu_m)
        axes.fill(corners[:, 0], corners[:, 1], facecolor=OBSTACLE, edgecolor="0.5", zorder=0.5)
        middle = deepest_point(obstacle.corners_enu_m)
        axes.annotate(obstacle.label, middle, ha="center", va="center", fontsize=7, clip_on=True)
    axes.plot(fence[:, 0], fence[:, 1], color="0.6", linestyle="--", linewidth=1, label="fence")
    axes.plot(track[:, 0], track[:, 1], color=VEHICLE, linewidth=1.6, label="vehicle (true)")
    axes.plot(track[0, 0], track[0, 1], "o", color=VEHICLE, markersize=6, label="start")
    axes.plot(*estimates.T, color=ESTIMATE, linewidth=0.8, alpha=0.7, label="estimate over time")
    if flight.crossings_enu_m:
        positions = np.array(flight.crossings_enu_m)
        (dots,) = axes.plot(
            *positions.T, "D", color=CROSSING, markersize=5, label="crossing points"
        )
        dots.set(markeredgecolor="0.3", markeredgewidth=0.5)
    ellipse = ellipse_95(flight.final.position_enu_m, flight.final.covariance_m2)
    east, north = np.array(ellipse.corners_enu_m(120)).T
    axes.fill(east, north, color=ESTIMATE, alpha=0.25, label="95 % ellipse")
    axes.plot(*flight.final.position_enu_m, "+", color=ESTIMATE, markersize=11, label="estimate")
    axes.plot(*flight.truth_enu_m, "x", color=TRUTH, markersize=9, label="emitter (true)")
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.grid(alpha=0.25)


def _zoom(axes: Axes, flight: PlottedFlight) -> None:
    half_m = max(4.0 * flight.final.r95_m, 3.5)
    east, north = flight.truth_enu_m
    axes.set_xlim(east - 1.6 * half_m, east + 1.6 * half_m)
    axes.set_ylim(north - half_m, north + half_m)
    axes.set_title(f"Around the emitter, relative R95 {flight.final.r95_m:.2f} m")


def _draw_error(axes: Axes, flight: PlottedFlight) -> None:
    time_s, east, north, r95 = np.array(flight.estimates).T
    errors = np.hypot(east - flight.truth_enu_m[0], north - flight.truth_enu_m[1])
    axes.semilogy(time_s, r95, color=ESTIMATE, linewidth=1.2, label="relative R95 (claimed)")
    axes.semilogy(time_s, errors, color=VEHICLE, linewidth=1.2, label="error (true)")
    axes.set_xlabel("time, s")
    axes.set_ylabel("m")
    axes.set_title("Claimed radius and true error")
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=8)
