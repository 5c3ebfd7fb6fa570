"""Measures the figures that the estimation must reach; exit code 1 if one is missed.

2: bad input, or a file that cannot be written. The figures:

    lawnmower   the canonical scenario with fixed lanes: final RMSE of AsymmetricHuberEKF, and of
                the symmetric filter in the same runs, and the range offset it converges to
    bound       the tracker with its window on tracks of FIM and latched crossing: RMSE against the
                Cramer-Rao bound of those tracks
    walks       only if asked for: recorded walks in --walks FOLDER (rtt*, uwb*, plaza* and wsr*
                .csv): error of the final and of the better stated position, states and share that
                holds, at the end and at each tenth of the way, and the cost of a measurement

Honesty of covariance and R95 is the study `consistency` of tools/run_study.py.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import msgspec

from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.io.files import check_writable, write_json_atomic
from sim_link.world.environment import ChannelParams
from tools.console import OneLineParser, done_by, non_negative, positive
from tools.study.case import PAPER_BELIEF, Case
from tools.study.metrics import steps_to_settle
from tools.study.reporting.study_tables import rmse_interval_m
from tools.study.systems import System
from tools.study.trials import RunSeries, RunTally, joined_in_order, tally_of
from tools.study.walks.walk_choice import left_out_lines
from tools.study.walks.walk_figures import walk_lines

Part = Literal["lawnmower", "bound", "walks"]
PARTS: tuple[Part, ...] = ("lawnmower", "bound")
"""Parts that are measured by default."""

MAX_LAWNMOWER_RMSE_M = 0.35
OFFSET_BAND_M = (4.5, 6.5)
MAX_BOUND_RATIO = 1.3
RANGE_SIGMAS_M = (0.5, 1.5, 2.5)

WALKS = Path(__file__).resolve().parent.parent / "tests" / "data"
"""Folder of the recorded walks."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One number, and its requirement."""

    part: Part
    name: str
    value: float
    limit: str = ""
    """Text of the requirement; empty: reported only."""
    is_met: bool | None = None
    """Verdict on the requirement; None if nothing is required of the figure."""
    note: str = ""


Measured = Sequence[tuple[RunSeries, RunTally]]
"""Runs of every system of a part, in order, with their tallies."""


def verified(parts: Sequence[Part], runs: int, seed: int, jobs: int) -> list[Figure]:
    """Run the selected parts; every system gets the same random draws."""
    series = {
        part: [RunSeries(case, system, seed, runs) for case, system in MEASURED[part][0]()]
        for part in parts
    }
    tallies = iter(tallies_of(list(itertools.chain(*series.values())), jobs))
    return [
        figure
        for part, own in series.items()
        for figure in MEASURED[part][1]([(each, next(tallies)) for each in own])
    ]


def tallies_of(campaigns: Sequence[RunSeries], jobs: int) -> list[RunTally]:
    """Do campaigns, all their blocks at once, by several processes."""
    parts = [campaign.blocks() for campaign in campaigns]
    done = iter(done_by(tally_of, list(itertools.chain(*parts)), jobs))
    return [joined_in_order(itertools.islice(done, len(own))) for own in parts]


def lawnmower_systems() -> list[tuple[Case, System]]:
    """Return every filter on fixed lanes, ours and Huber's first."""
    filters: Final = ("asymmetric_huber", "huber", "admm", "ekf", "map", "tracker")
    return [(Case(), System(name, "passive")) for name in filters]


def lawnmower_figures(measured: Measured) -> list[Figure]:
    """Return the RMSE of every filter; rank and range offset of the first, and Huber's."""
    (ours, tally), (_, huber) = measured[:2]
    ours_m, ratio = tally.final_m, tally.final_m / huber.final_m
    offset_m = float(tally.range_offset_m[-1] / tally.runs)
    low_m, high_m = OFFSET_BAND_M
    first, *others = (rmse_figure(*each) for each in measured)
    limit, is_met = f"<= {MAX_LAWNMOWER_RMSE_M} m", ours_m <= MAX_LAWNMOWER_RMSE_M
    rank = (f"{ours.system.label}: RMSE by Huber's", ratio, "<= 1", ratio <= 1.0)
    band = (f"{low_m} to {high_m} m", low_m <= offset_m <= high_m)
    return [
        replace(first, limit=limit, is_met=is_met),
        *others,
        Figure("lawnmower", *rank),
        Figure("lawnmower", f"{ours.system.label}: range offset, m", offset_m, *band),
    ]


def rmse_figure(campaign: RunSeries, tally: RunTally) -> Figure:
    """Return the final RMSE of a system, with its remarks."""
    low_m, high_m = rmse_interval_m(tally.final_errors_m) or (math.nan, math.nan)
    steps = steps_to_settle(tally.rmse_m)
    note = (
        f"95 % interval {low_m:.3f} to {high_m:.3f}, worst {tally.worst_m:.2f} m, "
        f"{tally.diverged(1.0)} beyond 1 m, "
        f"{'never' if steps is None else f'{steps} steps'} to 2.5 m, "
        f"bound {tally.rmse_bound_m[-1]:.3f} m"
    )
    name = f"{campaign.system.label}: final RMSE, m"
    return Figure("lawnmower", name, tally.final_m, note=note)


def bound_systems() -> list[tuple[Case, System]]:
    """Return the tracker in the three noise regimes of the paper, which it knows."""
    found = []
    for sigma_m in RANGE_SIGMAS_M:
        belief = msgspec.structs.replace(PAPER_BELIEF, range_sigma_m=sigma_m)
        case = Case(channel=ChannelParams(range_sigma_m=sigma_m), belief=belief)
        found += [(case, System("tracker", "fim")), (case, System("tracker", "latched"))]
    return found


def bound_figure(campaign: RunSeries, tally: RunTally) -> Figure:
    """Return the final RMSE of a system by the bound on its own tracks."""
    rmse_m, bound_m = tally.final_m, float(tally.rmse_bound_m[-1])
    ratio = rmse_m / bound_m
    sigma_m = campaign.case.channel.range_sigma_m
    return Figure(
        "bound",
        f"{campaign.system.label}, sigma_r {sigma_m:g} m: RMSE by bound",
        ratio,
        f"<= {MAX_BOUND_RATIO}",
        ratio <= MAX_BOUND_RATIO,
        f"{rmse_m:.4f} m by {bound_m:.4f} m, worst {tally.worst_m:.2f} m",
    )


MEASURED: dict[
    Part, tuple[Callable[[], list[tuple[Case, System]]], Callable[..., list[Figure]]]
] = {
    "lawnmower": (lawnmower_systems, lawnmower_figures),
    "bound": (bound_systems, lambda measured: [bound_figure(*each) for each in measured]),
}


def main() -> int:
    """Take all figures, print and write them; return the exit code."""
    arguments = parsed()
    try:
        if arguments.json is not None:
            check_writable(arguments.json)
        parts = [part for part in PARTS if part in (arguments.only or PARTS)]
        if "walks" in (arguments.only or ()):
            lines = walk_lines(arguments.walks)
            if arguments.leave_one_out:
                lines += left_out_lines(arguments.walks, arguments.jobs)
            print("\n".join(lines))
        figures: list[Figure] = []
        if parts:
            figures = verified(parts, arguments.runs, arguments.seed, arguments.jobs)
        print("\n".join(line(figure) for figure in figures))
        if arguments.json is not None:
            choices = {"runs": arguments.runs, "seed": arguments.seed}
            write_json_atomic(arguments.json, {**choices, "figures": figures})
    except CompanionError as error:
        print(f"verify_estimation: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nverify_estimation: interrupted", file=sys.stderr)
        return 1
    return 1 if any(figure.is_met is False for figure in figures) else 0


def parsed() -> argparse.Namespace:
    """Return the parsed command line."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parts = (*PARTS, "walks")
    parser.add_argument("--only", choices=parts, action="append", help="may be given twice")
    parser.add_argument("--walks", type=Path, default=WALKS, metavar="DIR", help="recorded walks")
    text = (
        "choose Wi-Fi presets with each file left out in turn, too; half an hour of processor time"
    )
    parser.add_argument("--leave-one-out", action="store_true", help=text)
    parser.add_argument("--runs", type=positive, default=200, help="runs of every system")
    parser.add_argument("--seed", type=non_negative, default=1)
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    return parser.parse_args()


def line(figure: Figure) -> str:
    """Return a figure and its requirement."""
    verdict = {True: "met", False: "MISSED", None: ""}[figure.is_met]
    limit = f"  (must be {figure.limit}: {verdict})" if figure.limit else ""
    note = f"  [{figure.note}]" if figure.note else ""
    return f"{figure.name:52s} {figure.value:8.4f}{limit}{note}"


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
