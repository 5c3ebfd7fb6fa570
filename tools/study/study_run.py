"""Carries out studies: kernels, blocks of runs, and the store that keeps them.

Blocks are done once, the longest first, and kept in a folder: a killed run resumes where it was. A
block's key covers everything that determines it, sources included, so that blocks of other studies
may lie in the same folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from companion.errors import CompanionError, ConfigError
from companion.io.files import write_bytes_atomic
from companion.kernel import IS_COMPILED
from sim_link.lab.pool import Pool, sources_digest
from tools.study import trials
from tools.study.study import Cell, CellResult, Study, StudyResult, cells_of
from tools.study.systems import FilterName
from tools.study.trials import RunSeries

FOLDER_NAME = "blocks"


def key_of(*parts: object) -> str:
    """Return the key of the values that determine a result, encoded by msgspec."""
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


class Store:
    """Results by key, a file for each; a ConfigError if the folder cannot be made."""

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            text = f"{folder}: {error.strerror}; delete it, or choose another --out"
            raise ConfigError(text) from None
        self._folder = folder

    def found(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Return the results of those keys that have one; a CompanionError if unreadable."""
        paths = {key: self._folder / key for key in keys}
        try:
            return {key: path.read_bytes() for key, path in paths.items() if path.exists()}
        except OSError as error:
            raise CompanionError(f"{error.filename}: {error.strerror}") from error

    def keep(self, key: str, result: bytes) -> None:
        """Add a result, which then survives the process; a CompanionError if that fails."""
        write_bytes_atomic(self._folder / key, result)


Work = Mapping[str, RunSeries]
"""Results of the studies by key, each once: blocks of runs."""

COST_MS: dict[FilterName, float] = {"admm": 3.0, "map": 7.5, "tracker": 50.0}
"""Approximate time of a run of 500 steps, ms; others take USUAL_COST_MS."""
USUAL_COST_MS = 1.7
USUAL_STEPS = 500


@dataclass(frozen=True, slots=True)
class PlannedStudy:
    """A study with its cells and the number of runs of each."""

    study: Study
    runs: int
    cells: tuple[Cell, ...]

    def blocks(self, cell: Cell, seed: int) -> list[RunSeries]:
        """Return the runs of one of its cells."""
        return RunSeries(cell.case, cell.system, seed, self.runs).blocks()


def planned(studies: Sequence[Study], runs: int | None) -> list[PlannedStudy]:
    """Return studies with their cells, of so many runs each; None.

    As many as each study specifies.
    """
    return [PlannedStudy(s, runs or s.runs, tuple(cells_of(s))) for s in studies]


def work_of(studies: Iterable[PlannedStudy], seed: int) -> dict[str, RunSeries]:
    """Return all work that studies need, shared work once."""
    work: dict[str, RunSeries] = {}
    for study in studies:
        for cell in study.cells:
            work.update((task_key(task), task) for task in study.blocks(cell, seed))
    return work


def carried_out(work: Work, pool: Pool, store: Store, on_done: Callable[[float], None]) -> None:
    """Do all of it, keep it, and report the cost of every finished task.

    Runs of compiled kernels wait until one process has compiled them, which takes a minute after a
    change of the sources; the others do those that need none meanwhile.
    """
    pending = sorted(work.items(), key=lambda item: -cost_of(item[1]))
    compiled = [item for item in pending if item[1].system.is_compiled]
    others = [item for item in pending if not item[1].system.is_compiled]
    for items, first in ((others, first_runs(task for _, task in compiled)), (compiled, ())):
        for position, result in pool.results(_perform, [first, *((task,) for _, task in items)]):
            if position > 0:
                key, task = items[position - 1]
                store.keep(key, result)
                on_done(cost_of(task))


STEPS = 12
"""Enough of a run to call everything once."""


def first_runs(tasks: Iterable[RunSeries]) -> tuple[RunSeries, ...]:
    """Return short runs that call every kernel of some tasks; none if nothing is compiled."""
    kinds: dict[bool, RunSeries] = {}
    for task in tasks if IS_COMPILED else ():
        short = msgspec.structs.replace(task.case, steps=STEPS)
        kinds.setdefault(bool(task.case.obstacles), RunSeries(short, task.system, 0, 1))
    return tuple(kinds.values())


def _perform(tasks: tuple[RunSeries, ...]) -> bytes:
    """Carry out tasks, and return the encoded result of the last one."""
    result = b""
    for task in tasks:
        result = trials.tally_of(task).packed()
    return result


def results_of(studies: Iterable[PlannedStudy], seed: int, store: Store) -> list[StudyResult]:
    """Collect the results of studies from the store; KeyError if a task is missing."""
    tallies: dict[tuple[str, ...], trials.RunTally] = {}
    results: list[StudyResult] = []
    for study in studies:
        cells: list[CellResult] = []
        for cell in study.cells:
            keys = tuple(task_key(block) for block in study.blocks(cell, seed))
            if keys not in tallies:
                found = store.found(keys)
                tallies[keys] = trials.joined_in_order(trials.unpacked(found[key]) for key in keys)
            cells.append(CellResult.of(cell, tallies[keys]))
        results.append(StudyResult(study.study, study.runs, seed, tuple(cells)))
    return results


def task_key(task: RunSeries) -> str:
    """Key of a task in the store."""
    parts = ("tally", task.seed, task.first, task.runs, sources_digest())
    return key_of(task.case, task.system, *parts)


def cost_of(task: RunSeries) -> float:
    """Rough duration of a task, ms."""
    return (
        COST_MS.get(task.system.filter, USUAL_COST_MS) * task.runs * task.case.steps / USUAL_STEPS
    )
