"""Benchmarks of filters, planners and control tick, beside libraries on the same measurements.

Exit code 0 whether or not the limits are met, because the figures depend on the machine as well. 2:
bad input, or a file that cannot be written.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from companion import kernel_cache
from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.io.files import check_writable, write_json_atomic
from tools.benches.filter_bench import ROUNDS, FilterBench, Ratio, bench_filters
from tools.benches.planner_bench import ROUNDS as PLANNER_ROUNDS
from tools.benches.planner_bench import (
    SIGHTED,
    SIGHTED_LIMIT_US,
    PlannerBench,
    StepCost,
    bench_planners,
)
from tools.benches.tick_bench import EMITTERS, LIMIT_MS, ROOT, TickCost, tick_cases
from tools.console import OneLineParser, positive


def main() -> int:
    """Measure, print, and write the figures; return the exit code."""
    arguments = parsed()
    bench: FilterBench | PlannerBench
    try:
        if arguments.json is not None:
            check_writable(arguments.json)
        if arguments.command == "tick":
            costs = tick_costs(arguments)
            if arguments.json is not None:
                write_json_atomic(arguments.json, costs)
            return 0
        if arguments.command == "filters":
            bench = bench_filters(arguments.rounds)
            print(filter_table(bench))
        else:
            bench = bench_planners(arguments.rounds)
            print(planner_table(bench))
        if arguments.json is not None:
            write_json_atomic(arguments.json, bench)
    except CompanionError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        return 1
    return 0


def parsed() -> argparse.Namespace:
    """Return the parsed command line."""
    parser = OneLineParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    subjects = {
        "filters": ("filter updates and the window MAP", ROUNDS),
        "planners": ("steps of a filter with a planner, and decisions alone", PLANNER_ROUNDS),
    }
    for name, (text, rounds) in subjects.items():
        command = commands.add_parser(name, help=text)
        command.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
        command.add_argument("--rounds", type=positive, default=rounds, help="medians over so many")
    tick = commands.add_parser("tick", help="the control tick, and the longest wait of a setpoint")
    tick.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    tick.add_argument("--seconds", type=positive, default=60, help="of flight in each case")
    tick.add_argument("--emitters", type=positive, nargs="+", default=EMITTERS, help="so many each")
    tick.add_argument("--only", choices=tuple(LIMIT_MS), help="kernels of this kind")
    tick.add_argument("--beside", type=Path, metavar="CHECKOUT", help="of an earlier release")
    return parser.parse_args()


def tick_costs(arguments: argparse.Namespace) -> list[TickCost]:
    """Measure every case and print it as soon as it is over; then those of another checkout."""
    kinds = tuple(LIMIT_MS) if arguments.only is None else (arguments.only,)
    if "compiled" in kinds and kernel_cache.kept() is None:
        kernel_cache.compile_kernels()
    print("worst tick, 99 % of the ticks, longest wait of a setpoint; milliseconds of the thread")
    costs = []
    for case in tick_cases(kinds, arguments.emitters):
        cost = case.measured(ROOT, arguments.seconds)
        verdict = "met" if cost.is_met else "NOT MET"
        text = f"{case.title:34s} {tick_figures(cost)}  limit {cost.limit_ms:g}: {verdict}"
        if arguments.beside is not None:
            earlier = case.measured(arguments.beside.resolve(), arguments.seconds)
            text += f"   beside it {tick_figures(earlier)}"
        print(text, flush=True)
        costs.append(cost)
    return costs


def tick_figures(cost: TickCost) -> str:
    """Return the three figures of a case."""
    return f"{cost.tick_worst_ms:7.2f}{cost.tick_p99_ms:7.2f}{cost.stretch_worst_ms:8.2f}"


def filter_table(bench: FilterBench) -> str:
    """Return all times of the filters with their limits."""
    lines = [
        versions(bench),
        f"medians over {bench.rounds} rounds of {bench.updates} updates, microseconds",
        "",
        f"{'':28s}{'compiled':>10s}{'plain':>10s}",
    ]
    for name, plain_us in bench.plain_us.items():
        compiled = "-" if bench.compiled_us is None else f"{bench.compiled_us[name]:.2f}"
        lines.append(f"{name:28s}{compiled:>10s}{plain_us:10.2f}")
    lines += ["", *(line(ratio) for ratio in bench.ratios)]
    return "\n".join(lines)


def line(ratio: Ratio) -> str:
    """Return a cost beside its peer's, and the limit."""
    verdict = "met" if ratio.is_met else "NOT MET"
    return (
        f"{ratio.name}: {ratio.cost_us:.2f} us, {ratio.ratio:.3f} x {ratio.reference} "
        f"({ratio.reference_us:.2f} us); limit {ratio.limit:g} x: {verdict}"
    )


def planner_table(bench: PlannerBench) -> str:
    """Return all times of the planners with their limits."""
    ratio = bench.fim_over_reactive
    return "\n".join(
        [
            versions(bench),
            f"medians over {bench.rounds} rounds of {bench.steps} steps, milliseconds",
            "",
            f"{'':28s}{'step':>10s}{'decision':>10s}{'filterpy':>10s}{'ratio':>8s}{'paper':>8s}",
            *(cost_line(cost) for cost in bench.costs),
            "",
            *(limit_line(cost) for cost in bench.costs if cost.limit_ms is not None),
            f"{SIGHTED}: {bench.sighted_us:.2f} us; limit {SIGHTED_LIMIT_US:g} us compiled",
            f"FIM over reactive: {ratio.steps:.2f} by step, {ratio.decisions:.2f} by decision; "
            f"paper: {ratio.paper:g}",
        ]
    )


def cost_line(cost: StepCost) -> str:
    """Return the cost of a system's step."""
    decision = "-" if cost.decision_ms is None else f"{cost.decision_ms:.5f}"
    paper = "-" if cost.paper_ms is None else f"{cost.paper_ms:.3f}"
    return (
        f"{cost.system:28s}{cost.step_ms:10.5f}{decision:>10s}{cost.filterpy_update_ms:10.5f}"
        f"{cost.ratio:8.3f}{paper:>8s}"
    )


def limit_line(cost: StepCost) -> str:
    """Return the limit of a system's step."""
    verdict = "met" if cost.is_met else "NOT MET"
    return f"{cost.system} step: {cost.step_ms:.5f} ms; limit {cost.limit_ms:g} ms: {verdict}"


def versions(bench: FilterBench | PlannerBench) -> str:
    """Return the versions of the measured software."""
    numba = "no numba: plain Python only" if bench.numba is None else f"numba {bench.numba}"
    return f"Python {bench.python}, numpy {bench.numpy}, {numba}"


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
