"""Many runs, in blocks that other processes may do, summed up so that it does not matter who did.

A block is a fixed range of a campaign's runs, and sums are joined in the order of the runs: the
figures of a campaign are the same bytes whatever the number of processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from companion.kernel import Vector
from sim_link.evaluation.backends import LocalBackend
from sim_link.evaluation.bounds import bounds_m2
from sim_link.evaluation.case import Case
from sim_link.evaluation.noise import run_seeds
from sim_link.evaluation.systems import System
from sim_link.evaluation.trial import run_block

BLOCK = 50
"""Runs that are done in one go; another number rounds sums differently."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """Runs of one system in one case."""

    case: Case
    system: System
    seed: int
    runs: int

    def blocks(self) -> list[Block]:
        """The ranges of runs, in order."""
        firsts = range(0, self.runs, BLOCK)
        return [Block(self, first, min(BLOCK, self.runs - first)) for first in firsts]


@dataclass(frozen=True, slots=True)
class Block:
    """A range of a campaign's runs."""

    campaign: Campaign
    first: int
    runs: int


@dataclass(frozen=True, slots=True)
class Tally:
    """What is kept of runs: sums over them after every step, and how each of them ended."""

    runs: int
    squared_m2: Vector
    """(steps,) sum of squared errors."""
    bound_m2: Vector
    """(steps,) sum of the Cramer-Rao bounds on them."""
    nees: Vector
    """(steps,) sum."""
    inside: Vector
    """(steps,) runs whose R95 circle contained the target."""
    range_offset_m: Vector
    """(steps,) sum of the estimates."""
    bearing_offset_rad: Vector
    """(steps,) sum of the estimates."""
    final_errors_m: Vector
    """(runs,)"""

    @property
    def rmse_m(self) -> Vector:
        """(steps,) of the position."""
        return np.asarray(np.sqrt(self.squared_m2 / self.runs))

    @property
    def rmse_bound_m(self) -> Vector:
        """(steps,) what no estimator can beat on these tracks."""
        return np.asarray(np.sqrt(self.bound_m2 / self.runs))

    @property
    def mean_nees(self) -> Vector:
        """(steps,) of the position."""
        return np.asarray(self.nees / self.runs)

    @property
    def coverage(self) -> Vector:
        """(steps,) share of runs whose R95 circle contained the target."""
        return np.asarray(self.inside / self.runs)

    def joined(self, later: Tally) -> Tally:
        """With the runs that follow these."""
        return Tally(
            self.runs + later.runs,
            self.squared_m2 + later.squared_m2,
            self.bound_m2 + later.bound_m2,
            self.nees + later.nees,
            self.inside + later.inside,
            self.range_offset_m + later.range_offset_m,
            self.bearing_offset_rad + later.bearing_offset_rad,
            np.concatenate([self.final_errors_m, later.final_errors_m]),
        )

    def packed(self) -> bytes:
        """All of it in bytes, as `unpacked` reads them."""
        parts = [getattr(self, name) for name in Tally.__slots__[1:]]
        head = [float(self.runs), float(self.squared_m2.size)]
        return np.concatenate([head, *parts]).astype("<f8").tobytes()


def unpacked(packed: bytes) -> Tally:
    """The tally in bytes of `Tally.packed`."""
    numbers = np.frombuffer(packed, dtype="<f8").astype(np.float64)
    runs, steps = int(numbers[0]), int(numbers[1])
    sums, final_errors_m = numbers[2 : 2 + 6 * steps], numbers[2 + 6 * steps :]
    squared_m2, bound_m2, nees, inside, range_offset_m, bearing_offset_rad = np.split(sums, 6)
    return Tally(
        runs,
        squared_m2,
        bound_m2,
        nees,
        inside,
        range_offset_m,
        bearing_offset_rad,
        final_errors_m,
    )


def joined_in_order(tallies: Iterable[Tally]) -> Tally:
    """All runs of tallies whose blocks follow each other."""
    return reduce(Tally.joined, tallies)


def tally_of(block: Block) -> Tally:
    """Do the runs of a block."""
    campaign = block.campaign
    seeds = run_seeds(campaign.seed, block.runs, block.first)
    trials = run_block(campaign.case, campaign.system, seeds)
    errors = np.array([trial.errors_m for trial in trials])
    inside = [trial.errors_m <= trial.r95_m for trial in trials]
    return Tally(
        runs=len(trials),
        squared_m2=np.sum(errors**2, axis=0),
        bound_m2=np.sum(bounds_m2(campaign.case, trials), axis=0),
        nees=np.sum([trial.nees for trial in trials], axis=0),
        inside=np.sum(inside, axis=0, dtype=np.float64),
        range_offset_m=np.sum([trial.range_offsets_m for trial in trials], axis=0),
        bearing_offset_rad=np.sum([trial.bearing_offsets_rad for trial in trials], axis=0),
        final_errors_m=errors[:, -1],
    )


def tallies_of(
    campaigns: Sequence[Campaign], jobs: int, on_block: Callable[[int, int], None]
) -> list[Tally]:
    """Do campaigns, all their blocks at once.

    Args:
        campaigns: Whatever they are.
        jobs: Processes; 1: this one.
        on_block: Called with the blocks done so far and their total.
    """
    blocks = [(index, block) for index, c in enumerate(campaigns) for block in c.blocks()]
    done: dict[int, Tally] = {}
    for position, tally in LocalBackend(jobs).results(tally_of, [block for _, block in blocks]):
        done[position] = tally
        on_block(len(done), len(blocks))
    return [
        joined_in_order(done[p] for p, (owner, _) in enumerate(blocks) if owner == index)
        for index in range(len(campaigns))
    ]
