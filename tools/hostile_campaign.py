"""Feeds every filter hostile sequences; exit 1 if one ever breaks its promise about P."""

from __future__ import annotations

import itertools
import sys

from companion.estimation.filters.kalman import KINDS
from sim_link.lab.evaluation.hostile import MakeFilter, SequenceOutcome, run_campaign
from sim_link.lab.tool_console import OneLineParser

CHUNKS = 20


def main() -> int:
    """Run all sequences, print what was found; the exit code."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    make: dict[str, MakeFilter] = {str(kind): maker for kind, maker in KINDS.items()}
    total, count = SequenceOutcome(), arguments.sequences
    edges = [count * index // CHUNKS for index in range(CHUNKS + 1)]
    for first, end in itertools.pairwise(edges):
        total = total.joined(run_campaign(make, first, end - first, arguments.seed))
        print(f"{total.sequences:8d} sequences, {len(total.faults)} faults", flush=True)
    for fault in total.faults[:10]:
        print(fault, file=sys.stderr)
    print(
        f"{'FAILED' if total.faults else 'held'}: {total.updates} updates in {total.sequences} "
        f"sequences of {len(make)} filters, {total.refused} declared lost, "
        f"{len(total.faults)} faults, seed {arguments.seed}"
    )
    return 1 if total.faults else 0


if __name__ == "__main__":
    sys.exit(main())
