"""Benchmarks of filters and of the control tick, compared with a library or an earlier release.

Exit code 0 whether or not the limits are met, because the figures depend on the machine as well. 2:
bad input.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from companion import kernel_cache
from companion.entry import ignore_broken_pipe
from tools.benches.filter_bench import ROUNDS, print_filters
from tools.benches.tick_bench import EMITTERS, LIMIT_MS, ROOT, tick_cases
from tools.console import OneLineParser, positive


def main() -> int:
    """Measure and print; return the exit code."""
    arguments = parsed()
    try:
        if arguments.command == "filters":
            print_filters(arguments.rounds)
        else:
            print_ticks(arguments)
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        return 1
    return 0


def parsed() -> argparse.Namespace:
    """Return the parsed command line."""
    parser = OneLineParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    filters = commands.add_parser("filters", help="filter updates")
    filters.add_argument(
        "--rounds", type=positive, default=ROUNDS, help="number of them for the medians"
    )
    tick = commands.add_parser("tick", help="the control tick, and the longest wait of a setpoint")
    tick.add_argument(
        "--seconds", type=positive, default=60, help="duration of the flight in each case"
    )
    tick.add_argument(
        "--emitters", type=positive, nargs="+", default=EMITTERS, help="number of them in a case"
    )
    tick.add_argument("--only", choices=tuple(LIMIT_MS), help="kernels of this kind")
    tick.add_argument(
        "--beside", type=Path, metavar="CHECKOUT", help="earlier release to compare with"
    )
    return parser.parse_args()


def print_ticks(arguments: argparse.Namespace) -> None:
    """Measure every case and print each result at once, next to that of another checkout."""
    kinds = tuple(LIMIT_MS) if arguments.only is None else (arguments.only,)
    if "compiled" in kinds and kernel_cache.kept() is None:
        kernel_cache.compile_kernels()
    print("worst tick, 99 % of the ticks, longest wait of a setpoint; milliseconds of the thread")
    for case in tick_cases(kinds, arguments.emitters):
        cost = case.measured(ROOT, arguments.seconds)
        verdict = "met" if cost.is_met else "NOT MET"
        text = f"{case.title:34s} {cost.figures}  limit {cost.limit_ms:g}: {verdict}"
        if arguments.beside is not None:
            earlier = case.measured(arguments.beside.resolve(), arguments.seconds)
            text += f"   beside it {earlier.figures}"
        print(text, flush=True)


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
