"""A million random frames against the simulated autopilots, in memory.

Half of the frames are of kinds that an autopilot acts on, with random fields and a right CRC; some
are for others or broken. A twin of the same seed does not receive those, and must not differ.
Prints progress; exit code 0 without findings, 1 with some, 2 for bad arguments.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from companion.entry import ignore_broken_pipe
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.conformance.rules import Flavour
from tests.protocol.frame_fuzzer import FuzzCampaign, FuzzFailure
from tools.console import OneLineParser

BATCH = 10_000
WARM_UP_SHARE = 0.2
MAX_GROWTH_MB = 16.0
MAX_OBJECT_GROWTH = 20_000
PAGE_BYTES = 4096


def main(argv: Sequence[str] | None = None) -> int:
    """Fuzz each flavour; return the exit code."""
    parser = OneLineParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=1_000_000, help="frames (default 1000000)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the frames (default 1)")
    parser.add_argument(
        "--autopilot",
        choices=[flavour.value for flavour in Flavour],
        help="only this one (default: half of the frames to each)",
    )
    arguments = parser.parse_args(argv)
    if arguments.frames < 1 or arguments.seed < 0:
        parser.error("--frames needs at least 1 and --seed at least 0")
    chosen = [Flavour(arguments.autopilot)] if arguments.autopilot else list(Flavour)
    share = -(-arguments.frames // len(chosen))
    passed = [fuzz(flavour, share, arguments.seed) for flavour in chosen]
    return 0 if all(passed) else 1


def fuzz(flavour: Flavour, frames: int, seed: int) -> bool:
    """Send frames to one simulator; return True without findings."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour.value))
    rng = np.random.default_rng(seed)
    campaign = FuzzCampaign(lambda: SimEndpoint(scenario, seed), rng, flavour)
    started_s = time.monotonic()
    settled: tuple[float, int] | None = None
    try:
        while campaign.frames < frames:
            campaign.run(min(BATCH, frames - campaign.frames))
            if settled is None and campaign.frames >= WARM_UP_SHARE * frames:
                settled = memory()
            if campaign.frames % (5 * BATCH) == 0 or campaign.frames == frames:
                report(flavour, campaign, frames, time.monotonic() - started_s)
    except FuzzFailure as failure:
        print(f"{flavour.value}, seed {seed}: FAILED at {failure}", file=sys.stderr)
        return False
    return is_flat(flavour, settled or memory())


def report(flavour: Flavour, campaign: FuzzCampaign, frames: int, elapsed_s: float) -> None:
    """Print a line of progress."""
    resident_mb, _ = memory()
    print(
        f"{flavour.value}: {campaign.frames} of {frames} frames, {campaign.answers} answers, "
        f"{campaign.now_s:.0f} s simulated, {campaign.frames / elapsed_s:.0f} frames/s, "
        f"{resident_mb:.0f} MB",
        flush=True,
    )


def is_flat(flavour: Flavour, settled: tuple[float, int]) -> bool:
    """Return True if memory stayed where it was after the first fifth."""
    resident_mb, objects = memory()
    grown_mb, grown = resident_mb - settled[0], objects - settled[1]
    flat = grown_mb <= MAX_GROWTH_MB and grown <= MAX_OBJECT_GROWTH
    verdict = "memory is flat" if flat else "FAILED: memory grows"
    print(
        f"{flavour.value}: {verdict} ({grown_mb:+.1f} MB, {grown:+d} objects since the first 20 %)"
    )
    return flat


def memory() -> tuple[float, int]:
    """Return resident megabytes and objects of the interpreter."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * PAGE_BYTES / 1e6, len(gc.get_objects())


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
