"""Measures the figures that the estimation must reach; exit code 1 if one is missed.

2: bad input, or a file that cannot be written. The figures:

    lawnmower   the canonical scenario with fixed lanes: final RMSE of AsymmetricHuberEKF, beside
                the symmetric filter in the same runs, and the range offset it converges to
    bound       the tracker with its window on tracks of FIM and latched crossing: RMSE beside the
                Cramer-Rao bound of those tracks
    walks       only if asked for: recorded walks in --walks FOLDER (rtt*, uwb*, plaza* and wsr*
                .csv): error of the final and of the better stated position, states and share that
                holds, at the end and at each tenth of the way, and the cost of a measurement
    honesty     NEES of the position and coverage of the R95 circle, with the noise that the filter
                assumes (no NLOS; offsets of the paper, or drawn from the priors), and coverage
                with the paper's NLOS, on lanes and on latched crossings

A share of runs is itself uncertain: with 200 runs a consistent 95 % circle contains the target in
92 to 98 % of them at one step, and among 480 steps it leaves 93 to 97 % at some. Beside the
extremes over steps stands therefore the mean over them, which separates a bias from chance; for the
extremes to mean something it takes some 2000 runs.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.io.files import check_writable, write_json_atomic
from sim_link.lab.pool import open_pool
from sim_link.world.environment import ChannelParams
from tools.console import OneLineParser, non_negative, positive
from tools.study.case import PAPER_BELIEF, Case, Offsets
from tools.study.metrics import (
    COVERAGE_BAND,
    SETTLED_STEP,
    diverged_count,
    nees_band,
    steps_to_settle,
)
from tools.study.reporting.study_tables import rmse_interval_m
from tools.study.systems import FilterName, PlannerName, System
from tools.study.trials import RunSeries, RunTally, joined_in_order, tally_of
from tools.study.walks.walk_choice import left_out_lines
from tools.study.walks.walk_figures import walk_lines

Part = Literal["lawnmower", "bound", "honesty", "walks"]
PARTS: tuple[Part, ...] = ("lawnmower", "bound", "honesty")
"""Parts that are measured by default."""

MAX_LAWNMOWER_RMSE_M = 0.35
OFFSET_BAND_M = (4.5, 6.5)
MAX_BOUND_RATIO = 1.3
RANGE_SIGMAS_M = (0.5, 1.5, 2.5)
HONESTY_CASES: tuple[tuple[float, Offsets], ...] = ((0.0, "fixed"), (0.0, "prior"), (0.9, "fixed"))
"""Share of NLOS measurements, and the source of the offsets."""
HONESTY_SYSTEMS: tuple[tuple[FilterName, PlannerName], ...] = (
    ("tracker", "passive"),
    ("tracker", "latched"),
    ("asymmetric_huber", "passive"),
    ("asymmetric_huber", "latched"),
)

WALKS = Path(__file__).resolve().parent.parent / "tests" / "data"
"""Path of one recorded walk."""

OnBlock = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Figure:
    """One number, and its requirement."""

    part: Part
    name: str
    value: float
    limit: str = ""
    """Requirement in words; empty: reported only."""
    is_met: bool | None = None
    """None: nothing is required of it."""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Plan:
    """A part's campaigns, and the figures of their tallies."""

    campaigns: list[RunSeries]
    figures: Callable[[Sequence[RunTally]], list[Figure]]


def verified(
    parts: Sequence[Part], runs: int, seed: int, jobs: int, on_block: OnBlock
) -> list[Figure]:
    """Measure some of the parts.

    Args:
        seed: Of the campaign; every system gets the same draws.
    """
    makers: dict[Part, Callable[[int, int], Plan]] = {
        "lawnmower": lawnmower_plan,
        "bound": bound_plan,
        "honesty": honesty_plan,
    }
    plans = [makers[part](runs, seed) for part in parts]
    tallies = tallies_of([c for plan in plans for c in plan.campaigns], jobs, on_block)
    figures: list[Figure] = []
    for plan in plans:
        mine, tallies = tallies[: len(plan.campaigns)], tallies[len(plan.campaigns) :]
        figures += plan.figures(mine)
    return figures


def tallies_of(
    campaigns: Sequence[RunSeries], jobs: int, on_block: Callable[[int, int], None]
) -> list[RunTally]:
    """Do campaigns, all their blocks at once.

    Args:
        jobs: Processes; 1: this one.
        on_block: Called with the blocks done so far and their total.
    """
    blocks = [(index, block) for index, c in enumerate(campaigns) for block in c.blocks()]
    done: dict[int, RunTally] = {}
    with open_pool(jobs=min(jobs, len(blocks))) as pool:
        for position, tally in pool.results(tally_of, [block for _, block in blocks]):
            done[position] = tally
            on_block(len(done), len(blocks))
    return [
        joined_in_order(done[p] for p, (owner, _) in enumerate(blocks) if owner == index)
        for index in range(len(campaigns))
    ]


def lawnmower_plan(runs: int, seed: int) -> Plan:
    """Plan every filter on fixed lanes."""
    filters: tuple[FilterName, ...] = (
        "asymmetric_huber",
        "huber",
        "admm",
        "ekf",
        "map",
        "tracker",
    )
    campaigns = [RunSeries(Case(), System(name, "passive"), seed, runs) for name in filters]

    def figures(tallies: Sequence[RunTally]) -> list[Figure]:
        """Return the figures of the tallies."""
        ours_m, huber_m = (float(tally.rmse_m[-1]) for tally in tallies[:2])
        offset_m = float(tallies[0].range_offset_m[-1] / runs)
        found = [rmse_figure(c, tally) for c, tally in zip(campaigns, tallies, strict=True)]
        label, low_m, high_m = campaigns[0].system.label, *OFFSET_BAND_M
        found[0] = replace(
            found[0], limit=f"<= {MAX_LAWNMOWER_RMSE_M} m", is_met=ours_m <= MAX_LAWNMOWER_RMSE_M
        )
        return [
            *found,
            Figure(
                "lawnmower",
                f"{label}: RMSE by Huber's",
                ours_m / huber_m,
                "<= 1",
                ours_m <= huber_m,
            ),
            Figure(
                "lawnmower",
                f"{label}: range offset, m",
                offset_m,
                f"{low_m} to {high_m} m",
                low_m <= offset_m <= high_m,
            ),
        ]

    return Plan(campaigns, figures)


def rmse_figure(campaign: RunSeries, tally: RunTally) -> Figure:
    """Return the final RMSE of a system, with its remarks."""
    errors_m = tally.final_errors_m
    low_m, high_m = rmse_interval_m(errors_m) or (math.nan, math.nan)
    steps = steps_to_settle(tally.rmse_m)
    note = (
        f"95 % interval {low_m:.3f} to {high_m:.3f}, worst {errors_m.max():.2f} m, "
        f"{diverged_count(errors_m, 1.0)} beyond 1 m, "
        f"{'never' if steps is None else f'{steps} steps'} to 2.5 m, "
        f"bound {tally.rmse_bound_m[-1]:.3f} m"
    )
    name = f"{campaign.system.label}: final RMSE, m"
    return Figure("lawnmower", name, float(tally.rmse_m[-1]), note=note)


def noise_case(range_sigma_m: float) -> Case:
    """Return the canonical scenario with other noise of the ranges, which the filter knows."""
    belief = msgspec.structs.replace(PAPER_BELIEF, range_sigma_m=range_sigma_m)
    return Case(channel=ChannelParams(range_sigma_m=range_sigma_m), belief=belief)


def bound_plan(runs: int, seed: int) -> Plan:
    """Plan the tracker beside the Cramer-Rao bound, in the three noise regimes of the paper."""
    planners: tuple[PlannerName, ...] = ("fim", "latched")
    campaigns = [
        RunSeries(noise_case(sigma_m), System("tracker", planner), seed, runs)
        for sigma_m in RANGE_SIGMAS_M
        for planner in planners
    ]

    def figures(tallies: Sequence[RunTally]) -> list[Figure]:
        """Return the figures of the tallies."""
        return [bound_figure(c, tally) for c, tally in zip(campaigns, tallies, strict=True)]

    return Plan(campaigns, figures)


def bound_figure(campaign: RunSeries, tally: RunTally) -> Figure:
    """Return the final RMSE of a system by the bound on its own tracks."""
    rmse_m, bound_m = float(tally.rmse_m[-1]), float(tally.rmse_bound_m[-1])
    ratio = rmse_m / bound_m
    worst_m = float(tally.final_errors_m.max())
    sigma_m = campaign.case.channel.range_sigma_m
    return Figure(
        "bound",
        f"{campaign.system.label}, sigma_r {sigma_m:g} m: RMSE by bound",
        ratio,
        f"<= {MAX_BOUND_RATIO}",
        ratio <= MAX_BOUND_RATIO,
        f"{rmse_m:.4f} m by {bound_m:.4f} m, worst {worst_m:.2f} m",
    )


def honesty_plan(runs: int, seed: int) -> Plan:
    """Plan filter and tracker on lanes and on crossings, in known noise and in the paper's."""
    campaigns = [
        RunSeries(honesty_case(p_nlos, offsets), System(name, planner), seed, runs)
        for p_nlos, offsets in HONESTY_CASES
        for name, planner in HONESTY_SYSTEMS
    ]

    def figures(tallies: Sequence[RunTally]) -> list[Figure]:
        """Return the figures of the tallies."""
        found: list[Figure] = []
        for campaign, tally in zip(campaigns, tallies, strict=True):
            found += honesty_figures(campaign, tally)
        return found

    return Plan(campaigns, figures)


def honesty_case(p_nlos: float, offsets: Offsets) -> Case:
    """Return the canonical scenario with another share of NLOS, or with drawn offsets."""
    return Case(channel=ChannelParams(p_nlos=p_nlos), offsets=offsets)


def honesty_figures(campaign: RunSeries, tally: RunTally) -> list[Figure]:
    """Return NEES if the noise is as assumed, and coverage; only the tracker must be consistent."""
    case, label = campaign.case, campaign.system.label
    is_as_assumed = case.channel.p_nlos == 0.0
    must = campaign.system.filter == "tracker"
    offsets = "" if case.offsets == "fixed" else ", offsets drawn"
    name = f"{label}, {'LOS' if is_as_assumed else 'NLOS'}{offsets}"
    inside, (low, high) = tally.coverage[SETTLED_STEP:], COVERAGE_BAND
    least, most = float(inside.min()), float(inside.max())
    is_covered = low <= least and (most <= high or not is_as_assumed)
    limit = f"{low:g} to {high:g}" if is_as_assumed else f">= {low:g}"
    share_out = np.mean((inside < low) | ((inside > high) & is_as_assumed))
    coverage = Figure(
        "honesty",
        f"{name}: coverage of R95, mean over steps",
        float(inside.mean()),
        f"each step {limit}" if must else "",
        is_covered if must else None,
        f"{least:.3f} to {most:.3f}, {share_out:.0%} of steps outside",
    )
    if not is_as_assumed:
        return [coverage]
    return [nees_figure(name, tally, must=must), coverage]


def nees_figure(name: str, tally: RunTally, *, must: bool) -> Figure:
    """Return the mean NEES after the last step."""
    low, high = nees_band(tally.runs)
    means = tally.mean_nees[SETTLED_STEP:]
    last = float(means[-1])
    share = np.mean((means >= low) & (means <= high))
    return Figure(
        "honesty",
        f"{name}: mean NEES",
        last,
        f"{low:.2f} to {high:.2f}" if must else "",
        low <= last <= high if must else None,
        f"over steps {means.mean():.2f}, {share:.0%} of them inside",
    )


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
                lines += left_out_lines(arguments.walks, arguments.jobs, show_progress)
            print("\n".join(lines))
        figures: list[Figure] = []
        if parts:
            figures = verified(parts, arguments.runs, arguments.seed, arguments.jobs, show_progress)
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
    parser.add_argument("--runs", type=positive, default=200, help="of every system")
    parser.add_argument("--seed", type=non_negative, default=1)
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    return parser.parse_args()


def show_progress(done: int, total: int) -> None:
    """Show progress on a terminal."""
    if sys.stderr.isatty():
        end = "\n" if done == total else ""
        print(f"\r{done} of {total} pieces of work", end=end, file=sys.stderr, flush=True)


def line(figure: Figure) -> str:
    """Return a figure and its requirement."""
    verdict = {True: "met", False: "MISSED", None: ""}[figure.is_met]
    limit = f"  (must be {figure.limit}: {verdict})" if figure.limit else ""
    note = f"  [{figure.note}]" if figure.note else ""
    return f"{figure.name:52s} {figure.value:8.4f}{limit}{note}"


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
