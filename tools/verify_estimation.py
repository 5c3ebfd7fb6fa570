"""Measures the figures that the estimation must reach; exit code 1 if one is missed.

2: bad input, or a file that cannot be written.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from companion.errors import CompanionError
from companion.io.files import check_writable, write_json_atomic
from sim_link.lab.evaluation.verification import PARTS, Figure, verified
from sim_link.lab.tool_console import OneLineParser, non_negative, positive


def main() -> int:
    """Take all figures, print and write them; the exit code."""
    arguments = parsed()
    try:
        if arguments.json is not None:
            check_writable(arguments.json)
        parts = [part for part in PARTS if part in (arguments.only or PARTS)]
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
    """What the command line says."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--only", choices=PARTS, action="append", help="may be given twice")
    parser.add_argument("--runs", type=positive, default=200, help="of every system")
    parser.add_argument("--seed", type=non_negative, default=1)
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    return parser.parse_args()


def show_progress(done: int, total: int) -> None:
    """Progress, where somebody looks."""
    if sys.stderr.isatty():
        end = "\n" if done == total else ""
        print(f"\r{done} of {total} blocks of runs", end=end, file=sys.stderr, flush=True)


def line(figure: Figure) -> str:
    """A figure and what it must be."""
    verdict = {True: "met", False: "MISSED", None: ""}[figure.is_met]
    limit = f"  (must be {figure.limit}: {verdict})" if figure.limit else ""
    note = f"  [{figure.note}]" if figure.note else ""
    return f"{figure.name:52s} {figure.value:8.4f}{limit}{note}"


if __name__ == "__main__":
    sys.exit(main())
