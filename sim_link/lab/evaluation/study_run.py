"""Carries out studies: warm-up of the kernels, blocks of runs, and the store that keeps them.

Blocks are done once, the longest first, and kept in a folder: a run that was killed goes on where
it was. A block's key names all that it follows from, sources included, so that blocks of other
studies may lie in the same folder.
"""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from companion.errors import CompanionError, ConfigError
from companion.io.files import write_bytes_atomic
from companion.kernel import IS_COMPILED
from companion.planning.crossing_kernels import NO_LATCH
from sim_link.lab.evaluation import campaign, filterpy_ekf, walk
from sim_link.lab.evaluation import case as cases
from sim_link.lab.evaluation.campaign import RunSeries
from sim_link.lab.evaluation.case import Case
from sim_link.lab.evaluation.filterpy_ekf import EkfCheck
from sim_link.lab.evaluation.study import Cell, CellResult, Study, StudyResult, cells_of
from sim_link.lab.evaluation.systems import FilterName, System, belief_of, steering_of
from sim_link.lab.pool import Pool, sources_digest
from sim_link.world.environment import NO_MEMORY

STEPS = 12
"""Enough of a run to call everything once."""


def warm_up(work: Work, pool: Pool) -> None:
    """Call every kernel once that some work needs, so that the pool's processes find them compiled.

    The first time after a change of the sources this takes the better part of a minute.
    """
    if not IS_COMPILED:
        return
    kinds: dict[tuple[bool, bool], tuple[Case, System]] = {}
    for task in work.values():
        short = msgspec.structs.replace(task.case, steps=STEPS)
        kind = (task.system.is_compiled, bool(task.case.obstacles))
        kinds.setdefault(kind, (short, task.system))
    walked = [pair for (is_compiled, _), pair in kinds.items() if is_compiled]
    callees = [partial(part, *walked[0]) for part in (_warm_filters, _warm_window) if walked]
    runs = [partial(campaign.tally_of, RunSeries(*pair, 0, 1)) for pair in kinds.values()]
    stages: tuple[Sequence[Callable[[], object]], ...] = (callees, runs)
    for stage in stages:
        for _ in pool.results(operator.call, stage):
            pass


def _warm_filters(case: Case, system: System) -> None:
    belief = belief_of(case, system)
    mean, covariance = walk.first_fix(0.0, 0.0, 20.0, 0.0, belief)
    for iterations in (0, 1):
        split = belief._replace(iterations=iterations)
        walk.updated(mean, covariance, np.zeros(3), _views(1)[0], split)


def _warm_window(case: Case, system: System) -> None:
    belief, steering = belief_of(case, system), steering_of(case, system)
    mean, covariance = walk.first_fix(0.0, 0.0, 20.0, 0.0, belief)
    rows = walk.history_of(STEPS, belief)
    rows[:, :2], rows[:, 2], rows[:, 3:6] = cases.track_of(case), 0.0, _views(STEPS)
    walk.solved(rows, mean, 1, belief)
    walk.next_place(np.zeros(3), mean, covariance, 0.0, NO_LATCH, belief, steering)
    draws, truth, _ = cases.run_inputs(case, 0)
    cases.measured_in(draws[0], 0.0, 0.0, truth, cases.scene_of(case), NO_MEMORY)


def _views(count: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    views = np.full((count, 3), np.nan)
    views[:, 0], views[:, 1] = 20.0, np.linspace(0.0, 1.0, count)
    return views


FOLDER_NAME = "blocks"


def key_of(*parts: object) -> str:
    """The key of what follows from values that msgspec can encode."""
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


class Store:
    """Results by key, a file for each; a ConfigError where the folder cannot be made."""

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            text = f"{folder}: {error.strerror}; delete it, or choose another --out"
            raise ConfigError(text) from None
        self._folder = folder

    def found(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Those of the keys that have a result, with it; a CompanionError if unreadable."""
        paths = {key: self._folder / key for key in keys}
        try:
            return {key: path.read_bytes() for key, path in paths.items() if path.exists()}
        except OSError as error:
            raise CompanionError(f"{error.filename}: {error.strerror}") from error

    def keep(self, key: str, result: bytes) -> None:
        """Add a result, which then survives the process; a CompanionError where that fails."""
        write_bytes_atomic(self._folder / key, result)


Work = Mapping[str, RunSeries]
"""What studies come to, by key, each once: blocks of runs and checks of the EKF."""

COST_MS: dict[FilterName, float] = {"admm": 2.5, "map": 24.0, "tracker": 150.0, "filterpy": 100.0}
"""Roughly, of a run of 500 steps; what is not named takes USUAL_COST_MS."""
USUAL_COST_MS = 1.6
USUAL_STEPS = 500


@dataclass(frozen=True, slots=True)
class PlannedStudy:
    """A study with its cells and the number of runs of each."""

    study: Study
    runs: int
    cells: tuple[Cell, ...]

    def blocks(self, cell: Cell, seed: int) -> list[RunSeries]:
        """The runs of one of its cells."""
        return RunSeries(cell.case, cell.system, seed, self.runs).blocks()


def planned(studies: Sequence[Study], runs: int | None) -> list[PlannedStudy]:
    """Studies with their cells, of so many runs each; None: as many as each study says."""
    return [PlannedStudy(s, runs or s.runs, tuple(cells_of(s))) for s in studies]


def work_of(studies: Iterable[PlannedStudy], seed: int) -> dict[str, RunSeries]:
    """All that studies need; what several of them need is in it once."""
    work: dict[str, RunSeries] = {}
    for study in studies:
        for cell in study.cells:
            found = study.blocks(cell, seed)
            if cell.system.filter == "ekf":
                runs = min(filterpy_ekf.CHECKED_RUNS, study.runs)
                found.append(EkfCheck(cell.case, cell.system, seed, runs))
            work.update((task_key(task), task) for task in found)
    return work


def carried_out(work: Work, pool: Pool, store: Store, on_done: Callable[[float], None]) -> None:
    """Do all of it, keep it, and tell the cost of every task that is done."""
    pending = sorted(work.items(), key=lambda item: -cost_of(item[1]))
    for position, result in pool.results(_perform, [task for _, task in pending]):
        key, task = pending[position]
        store.keep(key, result)
        on_done(cost_of(task))


def _perform(task: RunSeries) -> bytes:
    if isinstance(task, EkfCheck):
        return msgspec.json.encode(filterpy_ekf.largest_difference_m(task))
    return campaign.tally_of(task).packed()


def results_of(studies: Iterable[PlannedStudy], seed: int, store: Store) -> list[StudyResult]:
    """What studies came to, from what is kept; a KeyError where not all of it was carried out."""
    tallies: dict[tuple[str, ...], campaign.RunTally] = {}
    results: list[StudyResult] = []
    for study in studies:
        cells: list[CellResult] = []
        for cell in study.cells:
            keys = tuple(task_key(block) for block in study.blocks(cell, seed))
            if keys not in tallies:
                found = store.found(keys)
                tallies[keys] = campaign.joined_in_order(
                    campaign.unpacked(found[key]) for key in keys
                )
            cells.append(CellResult.of(cell, tallies[keys]))
        results.append(StudyResult(study.study, study.runs, seed, tuple(cells)))
    return results


def task_key(task: RunSeries) -> str:
    """What a task is kept under."""
    kind = "ekf check" if isinstance(task, EkfCheck) else "tally"
    parts = (kind, task.seed, task.first, task.runs, sources_digest())
    return key_of(task.case, task.system, *parts)


def cost_of(task: RunSeries) -> float:
    """What a task takes, roughly, milliseconds."""
    name = "filterpy" if isinstance(task, EkfCheck) else task.system.filter
    return COST_MS.get(name, USUAL_COST_MS) * task.runs * task.case.steps / USUAL_STEPS
