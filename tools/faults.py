"""Fault campaigns: random missions with faults, take-overs, bad links; every invariant watched.

Exit code 0 without findings, 1 with some (each with the command that repeats it), 2 for bad
arguments, 130 after Ctrl-C, with the findings until then.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # as on a vehicle, without a minute of compiling

from companion import __version__
from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError
from companion.io.files import write_json_atomic
from sim_link.lab.pool import LOCAL
from tools.campaign import runner
from tools.campaign.flights import Trial
from tools.console import OneLineParser, non_negative, positive, shown

REPLAY = "python tools/faults.py --replay"
SHOWN_FINDINGS = 20
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a campaign, or one of its trials again; return the exit code."""
    epilog = "parts: " + "; ".join(f"{part.name}: {part.title}" for part in runner.PARTS.values())
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0], epilog=epilog)
    parser.add_argument("--campaign", choices=runner.SIZES, default="ci", help="its size")
    parser.add_argument("--only", action="append", default=[], metavar="PART", help="this part")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument("--backend", default=LOCAL, help="local, or dask://HOST:PORT")
    parser.add_argument("--seed", type=non_negative, default=1, metavar="N")
    parser.add_argument("--replay", metavar="PART:SEED", help="one trial, with its log")
    arguments = parser.parse_args(argv)
    logging.disable(logging.CRITICAL)  # the texts of flights are in their stories
    try:
        if arguments.replay is not None:
            return replay(runner.trial_named(arguments.replay))
        trials = runner.trials_of(arguments.campaign, arguments.seed, arguments.only)
        facts = {
            "version": __version__,
            "campaign": arguments.campaign,
            "seed": arguments.seed,
        }
        return campaign(trials, arguments, facts)
    except CompanionError as error:
        parser.error(str(error))


def campaign(trials: list[Trial], arguments: argparse.Namespace, facts: dict[str, object]) -> int:
    """Run all trials, print and write the figures; return the exit code."""
    costs = {trial: runner.PARTS[trial.part].cost(trial) for trial in trials}
    started_s = time.monotonic()
    code = 0
    try:
        with shown(sum(costs.values()), sys.stderr) as done:
            tally = runner.run_all(
                trials, arguments.jobs, lambda o: done(costs[o.trial]), arguments.backend
            )
    except KeyboardInterrupt as interruption:
        tally = interruption.args[0] if interruption.args else runner.CampaignTally()
        code = INTERRUPTED
    runner.judge(tally)
    facts |= {
        "wall_s": round(time.monotonic() - started_s, 1),
        "is_complete": tally.trials == len(trials),
    }
    summary = runner.report(tally, facts, REPLAY)
    if arguments.json is not None:
        write_json_atomic(arguments.json, summary)
    for name, value in summary.items():
        if name not in ("findings", "reached_in"):
            trial = tally.reached_in.get(name)
            print(f"{name:32s} {value}" + (f"   in {trial}" if trial else ""))
    for finding in tally.findings[:SHOWN_FINDINGS]:
        print(f"FOUND {finding.what}\n      {REPLAY} {finding.trial}", file=sys.stderr)
    if len(tally.findings) > SHOWN_FINDINGS:
        print(f"... and {len(tally.findings) - SHOWN_FINDINGS} more", file=sys.stderr)
    return code or (1 if tally.findings else 0)


def replay(trial: Trial) -> int:
    """Run one trial again, print its log and its figures; return the exit code."""
    outcome = runner.run_one(trial)
    print(*outcome.story, sep="\n")
    for name, value in sorted({**outcome.most, **outcome.least}.items()):
        print(f"{name:32s} {value:.6g}")
    for what in outcome.findings:
        print(f"FOUND {what}")
    return 1 if outcome.findings else 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
