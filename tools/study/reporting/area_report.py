"""Reliability diagram and table of stated probabilities of detection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

from companion.io.files import write_bytes_atomic, write_text_atomic
from tools.study.reporting import plots
from tools.study.searched_area import KINDS, Bin, Kind, Trial, csv_of, reliability, success

MAX_ERROR = 0.03
"""Largest permitted difference between heard and stated shares in each tenth."""
COLOURS: dict[Kind, str] = {"open": plots.LATCHED, "rubble": plots.PASSIVE, "walls": plots.FIM}


def table_of_area(flown: Sequence[Sequence[Trial]]) -> tuple[str, bool]:
    """Return the table of tenths of the stated probability as text, and True within the limits."""
    trials = list(chain.from_iterable(flown))
    overall = reliability(trials)
    lines = ["stated POD   heard   error  +-, 95 %    cells"]
    for each in overall:
        figures = f"{each.stated:10.3f}{each.heard:8.3f}{each.error:+8.3f}{1.96 * each.sigma:9.3f}"
        lines.append(f"{figures}{each.trials:10d}")
    stated, heard, flights = success(trials)
    lines.append(
        f"POS stated {stated:.3f}, emitters heard {heard:.3f}, of {flights} flights with one"
    )
    errors = [heard - stated, *(each.error for each in overall)]
    return "\n".join(lines) + "\n", all(abs(error) <= MAX_ERROR for error in errors)


def write_reliability(out: Path, flown: Sequence[Sequence[Trial]]) -> None:
    """Write reliability.csv and .png."""
    trials = list(chain.from_iterable(flown))
    overall, by_kind = reliability(trials), {kind: reliability(trials, kind) for kind in KINDS}
    write_text_atomic(out / "reliability.csv", csv_of(chain(overall, *by_kind.values())))
    write_bytes_atomic(out / "reliability.png", drawn(overall, by_kind))


def drawn(overall: Sequence[Bin], by_kind: Mapping[Kind, list[Bin]]) -> bytes:
    """Return the diagram as PNG: observed over stated detections."""
    with plots.look():
        figure = plots.new_figure(4.6, 4.4)
        axes = figure.subplots()
        axes.plot((0.0, 1.0), (0.0, 1.0), color=plots.MUTED, linewidth=0.8)
        for kind, found in by_kind.items():
            points = [each.stated for each in found], [each.heard for each in found]
            axes.plot(*points, color=COLOURS[kind], linewidth=1.0, label=kind)
        points = [each.stated for each in overall], [each.heard for each in overall]
        band = [1.96 * each.sigma for each in overall]
        axes.errorbar(*points, band, fmt="o-", color=plots.INK, markersize=3.5, label="all")
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal")
        axes.set(xlabel="stated probability of detection", ylabel="share heard")
        axes.legend()
        return plots.finished(figure, "reliability", "", "").png
