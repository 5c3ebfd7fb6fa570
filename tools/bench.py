"""Times what must be fast, beside a library that does the same on the same measurements.

Exit code 0 whether or not the limits are met: the figures are the machine's as much as ours.
2: bad input, or a file that cannot be written.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from companion.errors import CompanionError
from companion.io.files import check_writable, write_json_atomic
from sim_link.evaluation.bench import ROUNDS, FilterBench, Ratio, bench_filters


def main() -> int:
    arguments = parsed()
    try:
        if arguments.json is not None:
            check_writable(arguments.json)
        bench = bench_filters(arguments.rounds)
        print(table(bench))
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
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    filters = commands.add_parser("filters", help="filter updates and the window MAP")
    filters.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    filters.add_argument("--rounds", type=positive, default=ROUNDS, help="medians over so many")
    return parser.parse_args()


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def table(bench: FilterBench) -> str:
    numba = "no numba: plain Python only" if bench.numba is None else f"numba {bench.numba}"
    lines = [
        f"Python {bench.python}, numpy {bench.numpy}, {numba}",
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
    verdict = "met" if ratio.is_met else "NOT MET"
    return (
        f"{ratio.name}: {ratio.cost_us:.2f} us, {ratio.ratio:.3f} x {ratio.reference} "
        f"({ratio.reference_us:.2f} us); limit {ratio.limit:g} x: {verdict}"
    )


if __name__ == "__main__":
    sys.exit(main())
