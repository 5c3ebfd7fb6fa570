"""Many runs, in blocks that other processes may do, summed up so that it does not matter who did.

A block is a fixed range of a campaign's runs, and sums are joined in the order of the runs: the
figures of a campaign are the same bytes whatever the number of processes.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

import numpy as np

from companion.geometry.arrays import Vector
from sim_link.evaluation.case import Case
from sim_link.evaluation.cramer_rao import (
    channel_information,
    position_bound_m2,
    track_information,
)
from sim_link.evaluation.noise import run_seeds
from sim_link.evaluation.systems import System
from sim_link.evaluation.trial import TrialResult, run_block

BLOCK = 25
"""Runs that are done in one go."""
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Matrices of four by four gain nothing from threads."""

Item = TypeVar("Item")
Result = TypeVar("Result")


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


def bounds_m2(case: Case, trials: Sequence[TrialResult]) -> list[Vector]:
    """The Cramer-Rao bound on the squared error after every step of every run, (steps,) each."""
    information = channel_information(case.channel)
    priors = case.belief.prior[1][2:4] if case.offsets == "prior" else None
    target = np.array(case.target_enu_m)
    return [
        position_bound_m2(track_information(trial.track_enu_m, target, information), priors)
        for trial in trials
    ]


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
    for position, tally in in_processes(tally_of, [block for _, block in blocks], jobs):
        done[position] = tally
        on_block(len(done), len(blocks))
    joined: dict[int, Tally] = {}
    for position, (index, _) in enumerate(blocks):
        tally = done[position]
        joined[index] = joined[index].joined(tally) if index in joined else tally
    return [joined[index] for index in range(len(campaigns))]


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int
) -> Iterator[tuple[int, Result]]:
    """The results with the positions of their items, as they come.

    Whoever stops listening, by an exception or a Ctrl-C, ends the processes, too.
    """
    if jobs == 1 or len(items) < 2:
        yield from ((position, work(item)) for position, item in enumerate(items))
        return
    os.environ.update({name: os.environ.get(name, "1") for name in BLAS_THREADS})
    with _deaf_to_interrupts():
        pool = get_context("spawn").Pool(min(jobs, len(items)))
    with pool:
        yield from pool.imap_unordered(partial(_numbered, work), enumerate(items))


def _numbered(work: Callable[[Item], Result], item: tuple[int, Item]) -> tuple[int, Result]:
    return item[0], work(item[1])


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes started meanwhile leave a Ctrl-C to this one, even while they load."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
