"""Carries out studies: blocks of runs or flights, and the store that keeps their results.

Each is done once and kept in a folder: a killed run resumes where it was. A key covers everything
that determines a result, sources included, so that results of other studies may lie in the same
folder.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import msgspec

from companion.errors import CompanionError, ConfigError
from companion.io.files import write_bytes_atomic
from sim_link.lab.pool import Pool, sources_digest
from tools.console import say, shown
from tools.study import trials
from tools.study.study import CellResult, Study, StudyResult, cells_of
from tools.study.systems import FilterName
from tools.study.trials import RunSeries

Task = TypeVar("Task")
FOLDER_NAME = "blocks"


def key_of(*parts: object) -> str:
    """Return the key of the values that determine a result, encoded by msgspec."""
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


def made_folder(path: Path) -> Path:
    """Make a folder with its parents, if it is not there; a ConfigError if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        text = f"{path}: {error.strerror}; delete it, or choose another --out"
        raise ConfigError(text) from None
    return path


class Store:
    """Results by key, a file for each; a ConfigError if the folder cannot be created."""

    def __init__(self, folder: Path) -> None:
        self._folder = made_folder(folder)

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


def carried_out(
    work: Mapping[str, Task],
    perform: Callable[[Task], bytes],
    cost: Callable[[Task], float],
    pool: Pool,
    store: Store,
    name: str,
) -> None:
    """Do what is not kept yet in its order, and keep it; stderr shows the progress.

    Args:
        name: Name of the tasks, in the plural.
    """
    kept = store.found(work)
    left = [(key, task) for key, task in work.items() if key not in kept]
    say(f"{len(work)} {name}, {len(kept)} of them done before")
    with shown(sum(cost(task) for _, task in left), sys.stderr) as on_done:
        for position, result in pool.results(perform, [task for _, task in left]):
            key, task = left[position]
            store.keep(key, result)
            on_done(cost(task))


COST_MS: dict[FilterName, float] = {"admm": 3.0, "map": 7.5, "tracker": 50.0}
"""Approximate time of a run of 500 steps, ms; others take USUAL_COST_MS."""
USUAL_COST_MS = 1.7
USUAL_STEPS = 500


def blocks_of(study: Study, seed: int) -> list[list[RunSeries]]:
    """Return the runs of each cell of a study, in blocks."""
    return [
        RunSeries(cell.case, cell.system, seed, study.runs).blocks() for cell in cells_of(study)
    ]


def work_of(studies: Iterable[Study], seed: int) -> dict[str, RunSeries]:
    """Return all blocks that studies need, shared ones once, the longest first."""
    blocks = (block for study in studies for own in blocks_of(study, seed) for block in own)
    work = {task_key(block): block for block in blocks}
    return dict(sorted(work.items(), key=lambda item: -cost_of(item[1])))


def tallied(task: RunSeries) -> bytes:
    """Do a block of runs; return its encoded tally."""
    return trials.tally_of(task).packed()


def results_of(studies: Iterable[Study], seed: int, store: Store) -> list[StudyResult]:
    """Collect the results of studies from the store; KeyError if a block is missing."""
    results: list[StudyResult] = []
    for study in studies:
        cells: list[CellResult] = []
        for cell, blocks in zip(cells_of(study), blocks_of(study, seed), strict=True):
            keys = [task_key(block) for block in blocks]
            found = store.found(keys)
            tally = trials.joined_in_order(trials.unpacked(found[key]) for key in keys)
            cells.append(CellResult.of(cell, tally))
        results.append(StudyResult(study, study.runs, seed, tuple(cells)))
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
