"""Claims of the evaluation, and their verdicts measured in this run.

A claim whose cells were not flown is left out; one that was measured only in part is marked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from tools.study import metrics
from tools.study.metrics import COVERAGE_BAND, SETTLED_STEP, steps_to_settle
from tools.study.reporting.figure_data import (
    BEST,
    FIM,
    FIM_PRINTED,
    PASSIVE,
    REACTIVE,
    numbers,
)
from tools.study.study import CellResult, ResultRow, StudyResult
from tools.study.systems import PLANNER_LABELS, System

SYMMETRIC = System("huber", "passive")
REGIMES = "grand_summary"
SENSITIVITY = ("p_nlos", "mu_nlos", "step_size", "k_rtt")
FIXED_TRACKS = ("p_nlos", "mu_nlos", "k_rtt")
OBSTACLE, ROBUSTNESS, CONSISTENCY = "obstacle", "robustness", "consistency"

MAX_REGIME_RMSE_M, MAX_REGIME_WORST_M = 0.03, 0.15
MAX_STEPS = {"0.5": 20, "1.5": 13, "2.5": 13}
"""Largest number of steps to 2.5 m, by range noise."""
MAX_ANYWHERE_RMSE_M, MAX_ANYWHERE_WORST_M = 0.05, 0.5
NONE_DIVERGED = "no run diverged"
MAX_OFF_M = 1.0
"""Largest final error of any of ten thousand runs, in m."""
MAX_BOUND_RATIO = 1.3
FAR_M = 100.0
"""Limit of a bound: with unknown offsets a straight track has very little information."""
INFORMED = (PLANNER_LABELS["latched"], PLANNER_LABELS["fim"])
"""Planners whose tracks leave one hypothesis: there the bound can be reached."""
MAX_COST_MS = {"Proposed (Reactive)": 0.003, "Proposed (FIM)": 0.015}
PAPER_COST_RATIO = 23
"""Section "Bias Learning and the Performance-Complexity Trade-off"."""
PAPER_STEPS = 5
"""The paper's least steps to 2.5 m, whose bound is given."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One line of the verdict."""

    text: str
    paper: str
    limit: str
    measured: str
    is_met: bool


class NotFlownError(Exception):
    """Raised if the cells of a claim were not flown."""


class Findings:
    """Everything measured in a run, by table and system."""

    def __init__(
        self,
        results: Iterable[StudyResult],
        rows: Iterable[ResultRow],
        costs: Iterable[ResultRow],
    ) -> None:
        self.cells = [cell for result in results for cell in result.cells]
        self.costs = list(costs)
        self._paper = {
            (row.table, row.parameter, row.value, row.system): numbers(row.paper)
            for row in rows
            if row.metric == "final_rmse_m" and row.paper
        }

    def find(self, system: System, *tables: str) -> list[CellResult]:
        """Return a system's cells in tables, in order."""
        return [cell for cell in self.cells if cell.system == system and cell.table in tables]

    def of(self, system: System, *tables: str) -> list[CellResult]:
        """Return the same, or raise a NotFlownError if there are none."""
        return _flown(self.find(system, *tables))

    def peer(self, cell: CellResult, system: System) -> CellResult | None:
        """Return another system in the same row of the same table, or None."""
        cell_key = (cell.table, cell.parameter, cell.value)
        for other in self.cells:
            if (other.table, other.parameter, other.value) == cell_key and other.system == system:
                return other
        return None

    def paper_m(self, cell: CellResult) -> float | None:
        """Return the final RMSE that the paper prints, m, or None."""
        return self._paper.get((cell.table, cell.parameter, cell.value, cell.system.label))


Judge = Callable[[Findings], Claim]


def claims_of(findings: Findings) -> list[Claim]:
    """Return the claims that this run can judge."""
    claims: list[Claim] = []
    for judge in JUDGES:
        with suppress(NotFlownError):
            claims.append(judge(findings))
    return claims


def _flown(cells: list[CellResult]) -> list[CellResult]:
    if not cells:
        raise NotFlownError
    return cells


def _one_sided(findings: Findings) -> Claim:
    by_paper: list[float] = []
    by_huber: list[float] = []
    judged: list[CellResult] = []
    for cell in findings.of(PASSIVE, *FIXED_TRACKS):
        paper_m, huber = findings.paper_m(cell), findings.peer(cell, SYMMETRIC)
        if paper_m is not None and huber is not None:
            by_paper.append(cell.tally.final_m / paper_m)
            by_huber.append(cell.tally.final_m / huber.tally.final_m)
            judged += [cell, huber]
    if not by_paper:
        raise NotFlownError
    return Claim(
        "One-sided filter on the lawnmower, every cell of the p, mu and k tables",
        "0.217 to 0.473 m",
        "<= the paper's cell, and <= Huber in the same runs",
        f"{len(by_paper)} cells: at most {max(by_paper):.2f} x the paper's, "
        f"{max(by_huber):.2f} x Huber's; {_diverged_text(judged)}",
        max(by_paper) <= 1.0 and max(by_huber) <= 1.0 and _diverged_text(judged) == NONE_DIVERGED,
    )


def _reactive(findings: Findings) -> Claim:
    cells = _flown([c for c in findings.of(REACTIVE, REGIMES) if findings.paper_m(c) is not None])
    finals, papers = [c.tally.final_m for c in cells], [findings.paper_m(c) or 0.0 for c in cells]
    is_within = all(ours <= paper for ours, paper in zip(finals, papers, strict=True))
    return Claim(
        "Reactive crossing as printed, range noise low / medium / high",
        _list(papers, "g") + " m",
        "RMSE <= the paper's cell, no run diverged",
        f"{_list(finals)} m, median {_list([c.tally.median_m for c in cells])} m, "
        f"{_diverged_text(cells)}",
        is_within and _diverged_text(cells) == NONE_DIVERGED,
    )


def _regimes(findings: Findings) -> Claim:
    cells = findings.of(BEST, REGIMES)
    finals, worst = [c.tally.final_m for c in cells], max(c.tally.worst_m for c in cells)
    return Claim(
        f"Our best O(1) planner ({BEST.label}) in the noise regimes, final RMSE",
        "0.21 / 0.41 / 0.70 m",
        f"<= {MAX_REGIME_RMSE_M} m each, worst run <= {MAX_REGIME_WORST_M} m",
        f"{_list(finals)} m, worst run {worst:.3f} m",
        max(finals) <= MAX_REGIME_RMSE_M and worst <= MAX_REGIME_WORST_M,
    )


def _settling(findings: Findings) -> Claim:
    cells = _flown([cell for cell in findings.of(BEST, REGIMES) if cell.value in MAX_STEPS])
    steps = [steps_to_settle(cell.tally.rmse_m) for cell in cells]
    limits = [MAX_STEPS[cell.value] for cell in cells]
    bound_m = float(cells[0].tally.rmse_bound_m[min(PAPER_STEPS, cells[0].case.steps) - 1])
    text = f"{bound_m:.1f} m" if bound_m < FAR_M else f"over {FAR_M:g} m"
    return Claim(
        f"The same, steps to 2.5 m, range noise {' / '.join(cell.value for cell in cells)} m",
        "5 / 20 / 24",
        "<= " + " / ".join(str(limit) for limit in limits),
        " / ".join("never" if s is None else str(s) for s in steps)
        + f"; the bound after {PAPER_STEPS} steps at {cells[0].value} m is {text}",
        all(s is not None and s <= limit for s, limit in zip(steps, limits, strict=True)),
    )


def _anywhere(findings: Findings) -> Claim:
    cells = findings.of(BEST, *SENSITIVITY, OBSTACLE)
    farthest, worst = (
        max(cells, key=lambda cell: cell.tally.final_m),
        max(cell.tally.worst_m for cell in cells),
    )
    tables = ", ".join(dict.fromkeys(cell.table for cell in cells))
    return Claim(
        "The same, every cell of the sensitivity tables and behind the obstacle",
        "0.119 to 2.394 m",
        f"<= {MAX_ANYWHERE_RMSE_M} m, worst run <= {MAX_ANYWHERE_WORST_M} m",
        f"{len(cells)} cells ({tables}): at most {farthest.tally.final_m:.3f} m "
        f"({farthest.parameter} {farthest.value}), worst run {worst:.3f} m",
        farthest.tally.final_m <= MAX_ANYWHERE_RMSE_M and worst <= MAX_ANYWHERE_WORST_M,
    )


def _robustness(findings: Findings) -> Claim:
    cells = findings.of(BEST, ROBUSTNESS)
    lost = sum(cell.tally.diverged(MAX_OFF_M) for cell in cells)
    runs = " + ".join(f"{cell.tally.runs:,}" for cell in cells)
    return Claim(
        "The same, many runs in each regime",
        "-",
        f"no run ends more than {MAX_OFF_M:g} m off",
        f"{lost} of {runs} runs, worst {max(cell.tally.worst_m for cell in cells):.3f} m",
        lost == 0,
    )


def _bound(findings: Findings) -> Claim:
    ratios: dict[str, float] = {}
    for planner, label in PLANNER_LABELS.items():
        cells = findings.find(System("map", planner), REGIMES)
        if cells:
            ratios[label] = max(c.tally.final_m / float(c.tally.rmse_bound_m[-1]) for c in cells)
    asked = {label: ratio for label, ratio in ratios.items() if label in INFORMED}
    if not asked:
        raise NotFlownError
    others = [f"{label} {ratio:.2f}" for label, ratio in ratios.items() if label not in asked]
    return Claim(
        "Our best estimator (MAP) by the Cramer-Rao bound of its own tracks, worst regime",
        "-",
        f"<= {MAX_BOUND_RATIO} on crossing and FIM tracks",
        ", ".join(f"{label} {ratio:.2f}" for label, ratio in asked.items())
        + (f" (elsewhere: {', '.join(others)})" if others else ""),
        max(asked.values()) <= MAX_BOUND_RATIO,
    )


def _nees(findings: Findings) -> Claim:
    cells = _honest_cells(findings)
    finals = [float(cell.tally.mean_nees[-1]) for cell in cells]
    low, high = metrics.nees_band(min(cell.tally.runs for cell in cells))
    return Claim(
        f"Consistency ({cells[0].system.label.partition(' ')[0]}): mean NEES of the position, "
        "well-specified noise",
        "-",
        f"in the 95 % band, {low:.2f} to {high:.2f}",
        f"{min(finals):.2f} to {max(finals):.2f} over {len(cells)} cells",
        all(low <= value <= high for value in finals),
    )


def _coverage(findings: Findings) -> Claim:
    cells = _honest_cells(findings)
    shares = np.array([share for c in cells for share in c.tally.coverage[SETTLED_STEP:]])
    low, high = COVERAGE_BAND
    return Claim(
        f"The same: the R95 circle holds the target, every step after the {SETTLED_STEP}th",
        "-",
        f"in {100 * low:g} to {100 * high:g} % of runs",
        f"{100 * shares.min():.1f} to {100 * shares.max():.1f} %, mean {100 * shares.mean():.1f} %",
        bool(low <= shares.min() and shares.max() <= high),
    )


def _reversal(findings: Findings) -> Claim:
    """Check the printed planner if it was flown; the companion's of that name differs."""
    reactive, ours = findings.of(REACTIVE, OBSTACLE)[0], findings.find(FIM, OBSTACLE)[:1]
    fim = _flown([*findings.find(FIM_PRINTED, OBSTACLE)[:1], *ours])[0]
    is_later, is_worse = (
        _steps(fim) > _steps(reactive),
        fim.tally.median_m > reactive.tally.median_m,
    )
    return Claim(
        "Behind the obstacle FIM fails and reactive crossing does not",
        "a reversal",
        f"{fim.system.label} later and worse than {reactive.system.label}",
        "; ".join(dict.fromkeys(_ending(cell) for cell in (fim, *ours, reactive)))
        + f": {'later' if is_later else 'not later'}, "
        f"{'and worse' if is_worse else 'but not worse'}",
        is_later and is_worse,
    )


def _obstacle(findings: Findings) -> Claim:
    best = findings.of(BEST, OBSTACLE)[0]
    others = [findings.of(FIM, OBSTACLE)[0], findings.of(REACTIVE, OBSTACLE)[0]]
    others += findings.find(FIM_PRINTED, OBSTACLE)[:1]
    is_met = all(
        best.tally.median_m < other.tally.median_m and _steps(best) < _steps(other)
        for other in others
    )
    return Claim(
        f"{BEST.label} beats both behind the obstacle, in median error and in time",
        "-",
        "less than FIM's, and than reactive crossing's",
        _ending(best),
        is_met,
    )


def _ending(cell: CellResult) -> str:
    steps = steps_to_settle(cell.tally.rmse_m)
    settled = "never settles" if steps is None else f"{steps} steps"
    finals = (
        f"{cell.tally.final_m:.4f} m, median {cell.tally.median_m:.4f} m, {_diverged_text([cell])}"
    )
    return f"{cell.system.label} {settled}, {finals}"


def _costs(findings: Findings) -> Claim:
    measured: dict[str, float] = {}
    for row in findings.costs:
        if row.system in MAX_COST_MS and row.metric == "cost_ms_per_step" and row.ours:
            cost_ms = numbers(row.ours)
            measured[row.system] = max(measured.get(row.system, cost_ms), cost_ms)
    if not measured:
        raise NotFlownError
    costs = {system: measured[system] for system in MAX_COST_MS if system in measured}
    ratio = ""
    if len(costs) == len(MAX_COST_MS):
        reactive, fim = costs.values()
        ratio = f", a ratio of {fim / reactive:.1f} (paper: {PAPER_COST_RATIO})"
    return Claim(
        "Cost of a step, filter and reactive planner / filter and FIM",
        "0.012 / 0.28 ms",
        "<= " + " / ".join(f"{MAX_COST_MS[system]:g}" for system in costs) + " ms compiled",
        " / ".join(f"{value:.4f}" for value in costs.values()) + f" ms on this machine{ratio}",
        all(value <= MAX_COST_MS[system] for system, value in costs.items()),
    )


JUDGES: Sequence[Judge] = (
    _one_sided,
    _reactive,
    _regimes,
    _settling,
    _anywhere,
    _robustness,
    _bound,
    _nees,
    _coverage,
    _reversal,
    _obstacle,
    _costs,
)


def _diverged_text(cells: Sequence[CellResult]) -> str:
    lost = sum(cell.tally.diverged() for cell in cells)
    return (
        f"{lost} of {sum(c.tally.runs for c in cells):,} runs diverged" if lost else NONE_DIVERGED
    )


def _honest_cells(findings: Findings) -> list[CellResult]:
    """Return the companion's tracker, in the noise that it assumes, in sufficiently long runs."""
    return _flown(
        [
            cell
            for cell in findings.cells
            if cell.table == CONSISTENCY
            and cell.system.filter == "tracker"
            and cell.case.channel.p_nlos == 0.0
            and len(cell.tally.mean_nees) > SETTLED_STEP
        ]
    )


def _steps(cell: CellResult) -> float:
    steps = steps_to_settle(cell.tally.rmse_m)
    return float("inf") if steps is None else float(steps)


def _list(values: Sequence[float], form: str = ".3f") -> str:
    return " / ".join(f"{value:{form}}" for value in values)
