"""Carries out studies: warm-up of the kernels, blocks of runs, and the store that keeps them.

Compiles the kernels before any work is given out, as far as possible at once.

Every process that runs blocks needs the same kernels; compiled once, they find them in the cache.
The big loop waits for what it calls, so its callees come first, in two processes, and then the
loop in one and the tracker's kernels in another.

Finished blocks of runs, kept in a folder: a run that was killed goes on where it was.

The key of a block names all that it follows from, sources included: whatever has changed since
gets another key, and blocks of other studies may lie in the same folder.

Carries out studies: each block of runs once, the longest first, kept as soon as it is done.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion.errors import CompanionError, ConfigError
from companion.io.files import write_bytes_atomic
from companion.kernel import IS_COMPILED
from companion.planning.crossing_kernels import LATCH_SIZE
from sim_link.lab.evaluation.campaign import (
    Block,
    RunSeries,
    RunTally,
    joined_in_order,
    tally_of,
    unpacked,
)
from sim_link.lab.evaluation.case import (
    TRUTH,
    Case,
    channel_draws,
    measured_in,
    scene_of,
    stream,
    truth_of,
)
from sim_link.lab.evaluation.filterpy_ekf import (
    CHECKED_RUNS,
    LARGEST_DIFFERENCE_M,
    EkfCheck,
    largest_difference_m,
)
from sim_link.lab.evaluation.study import Cell, CellResult, Study, StudyResult, cells_of
from sim_link.lab.evaluation.systems import (
    FilterName,
    System,
    belief_of,
    steering_of,
    track_of,
)
from sim_link.lab.evaluation.walk import first_fix, history_of, next_place, solved, updated
from sim_link.lab.pool import Pool, sources_digest
from sim_link.world.environment import NO_MEMORY

STEPS = 12
"""Enough of a run to call everything once."""

Stage = Sequence[tuple[str, Case, System]]
"""What may be done at once: the name of a part, and what it is called with."""


def warm_up(flown: Sequence[tuple[Case, System]], pool: Pool) -> None:
    """Call every kernel once that runs of some systems need.

    Args:
        pool: Whose processes share a cache with those that will do the work.
    """
    if not IS_COMPILED or not flown:
        return
    kinds: dict[tuple[bool, bool], tuple[Case, System]] = {}
    for case, system in flown:
        short = msgspec.structs.replace(case, steps=STEPS)
        kinds.setdefault((system.is_compiled, bool(case.obstacles)), (short, system))
    walked = [pair for (is_compiled, _), pair in kinds.items() if is_compiled]
    stages: list[Stage] = []
    if walked:
        stages.append([("filters", *walked[0]), ("window", *walked[0])])
    stages.append([("run", *pair) for pair in kinds.values()])
    for stage in stages:
        for _ in pool.results(_called, stage):
            pass


def _called(part: tuple[str, Case, System]) -> None:
    name, case, system = part
    PARTS[name](case, system)


def _filters(case: Case, system: System) -> None:
    """The updates, by the closed form and by splitting."""
    belief = belief_of(case, system)
    mean, covariance = first_fix(0.0, 0.0, 20.0, 0.0, belief)
    for iterations in (0, 1):
        updated(mean, covariance, np.zeros(3), _views(1)[0], belief._replace(iterations=iterations))


def _window(case: Case, system: System) -> None:
    """The window, the planners and the channel."""
    belief, steering = belief_of(case, system), steering_of(case, system)
    mean, covariance = first_fix(0.0, 0.0, 20.0, 0.0, belief)
    rows = history_of(STEPS, belief)
    rows[:, :2], rows[:, 2], rows[:, 3:6] = track_of(case), 0.0, _views(STEPS)
    solved(rows, mean, 1, belief)
    sensor, latch = np.zeros(3), np.zeros(LATCH_SIZE)
    next_place(sensor, mean, covariance, 0.0, latch, belief, steering)
    truth, draws = truth_of(case, stream(0, TRUTH)), channel_draws(case, 0)
    measured_in(draws[0], 0.0, 0.0, truth, scene_of(case), NO_MEMORY)


def _run(case: Case, system: System) -> None:
    """A whole block of one short run, with all that is told of it."""
    tally_of(RunSeries(case, system, 0, 1).blocks()[0])


def _views(count: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Ranges and bearings of nothing in particular, (count, 3)."""
    views = np.full((count, 3), np.nan)
    views[:, 0], views[:, 1] = 20.0, np.linspace(0.0, 1.0, count)
    return views


PARTS: dict[str, Callable[[Case, System], None]] = {
    "filters": _filters,
    "window": _window,
    "run": _run,
}


FOLDER_NAME = "blocks"


def key_of(*parts: object) -> str:
    """The key of what follows from values that msgspec can encode."""
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()


class Store:
    """Results by key, a file for each.

    Raises:
        ConfigError: The folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            text = f"{folder}: {error.strerror}; delete it, or choose another --out"
            raise ConfigError(text) from None
        self._folder = folder

    def found(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Those of the keys that have a result, with it.

        Raises:
            CompanionError: A file cannot be read.
        """
        paths = {key: self._folder / key for key in keys}
        try:
            return {key: path.read_bytes() for key, path in paths.items() if path.exists()}
        except OSError as error:
            raise CompanionError(f"{error.filename}: {error.strerror}") from error

    def keep(self, key: str, result: bytes) -> None:
        """Add a result; after this it survives the process.

        Raises:
            CompanionError: The file cannot be written.
        """
        write_bytes_atomic(self._folder / key, result)


Task = Block | EkfCheck
"""What is done in one go and kept."""
OnDone = Callable[[float], None]

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

    def campaign(self, cell: Cell, seed: int) -> RunSeries:
        """The runs of one of its cells."""
        return RunSeries(cell.case, cell.system, seed, self.runs)


@dataclass(frozen=True, slots=True)
class Work:
    """What studies come to: tasks by key, each once."""

    tasks: dict[str, Task]

    @property
    def cost(self) -> float:
        """Of all of it, roughly, milliseconds."""
        return sum(cost_of(task) for task in self.tasks.values())

    def without(self, kept: Container[str]) -> Work:
        """What is left when tasks of some keys are done."""
        return Work({key: task for key, task in self.tasks.items() if key not in kept})


def planned(studies: Sequence[Study], runs: int | None) -> list[PlannedStudy]:
    """Studies with their cells.

    Args:
        runs: Of every cell; None: as many as each study says.

    Raises:
        ConfigError: See `cells_of`.
    """
    return [PlannedStudy(s, runs or s.runs, tuple(cells_of(s))) for s in studies]


def work_of(studies: Iterable[PlannedStudy], seed: int) -> Work:
    """All that studies need; what several of them need is in it once."""
    tasks: dict[str, Task] = {}
    for study in studies:
        for cell in study.cells:
            found: list[Task] = [*study.campaign(cell, seed).blocks()]
            if cell.system.filter == "ekf":
                found.append(EkfCheck(cell.case, cell.system, seed, min(CHECKED_RUNS, study.runs)))
            tasks.update((task_key(task), task) for task in found)
    return Work(tasks)


def carried_out(work: Work, pool: Pool, store: Store, on_done: OnDone) -> None:
    """Do all of it, and keep it.

    Args:
        on_done: Told the cost of every task that is done.

    Raises:
        CompanionError: The pool or the store gave out; what was done is kept.
    """
    pending = sorted(work.tasks.items(), key=lambda item: -cost_of(item[1]))
    for position, result in pool.results(performed, [task for _, task in pending]):
        key, task = pending[position]
        store.keep(key, result)
        on_done(cost_of(task))


def performed(task: Task) -> bytes:
    """The result of a task, as it is kept."""
    if isinstance(task, Block):
        return tally_of(task).packed()
    return msgspec.json.encode(largest_difference_m(task))


def results_of(studies: Iterable[PlannedStudy], seed: int, store: Store) -> list[StudyResult]:
    """What studies came to, from what is kept.

    Raises:
        KeyError: Not all of it was carried out.
    """
    tallies: dict[tuple[str, ...], RunTally] = {}
    results: list[StudyResult] = []
    for study in studies:
        cells: list[CellResult] = []
        for cell in study.cells:
            keys = tuple(task_key(block) for block in study.campaign(cell, seed).blocks())
            if keys not in tallies:
                found = store.found(keys)
                tallies[keys] = joined_in_order(unpacked(found[key]) for key in keys)
            named = (cell.table, cell.parameter, cell.value)
            cells.append(CellResult(*named, cell.case, cell.system, tallies[keys]))
        results.append(StudyResult(study.study, study.runs, seed, tuple(cells)))
    return results


def checks_of(work: Work, store: Store) -> dict[str, dict[str, object]]:
    """What the built-in check of the EKF came to, for checks.json; empty without an EKF."""
    checks = {key: task for key, task in work.tasks.items() if isinstance(task, EkfCheck)}
    if not checks:
        return {}
    gaps = {key: _difference(text) for key, text in store.found(checks).items()}
    worst = max(gaps, key=lambda key: gaps[key])
    return {
        "ekf_is_filterpys": {
            "what": "largest difference between the EKF of the tables and filterpy's filter after "
            "an update from the same state, with the same measurement from the same place, of a "
            "coordinate or the range offset, metres",
            "cells": len(checks),
            "runs_of_each": max(check.runs for check in checks.values()),
            "largest_difference_m": gaps[worst],
            "limit_m": LARGEST_DIFFERENCE_M,
            "is_met": gaps[worst] <= LARGEST_DIFFERENCE_M,
            "worst_system": checks[worst].system.label,
            "worst_case": msgspec.to_builtins(checks[worst].case),
        }
    }


def prepared(work: Work, pool: Pool) -> None:
    """Compile every kernel, so that processes find them ready.

    The first time after a change of the sources this takes the better part of a minute.
    """
    warm_up([_flown(task) for task in work.tasks.values()], pool)


def task_key(task: Task) -> str:
    """What a task is kept under."""
    case, system = _flown(task)
    if isinstance(task, Block):
        runs: tuple[object, ...] = ("tally", task.campaign.seed, task.first, task.runs)
    else:
        runs = ("ekf check", task.seed, task.runs)
    return key_of(case, system, *runs, sources_digest())


def cost_of(task: Task) -> float:
    """What a task takes, roughly, milliseconds."""
    case, system = _flown(task)
    name = system.filter if isinstance(task, Block) else "filterpy"
    return COST_MS.get(name, USUAL_COST_MS) * task.runs * case.steps / USUAL_STEPS


def _flown(task: Task) -> tuple[Case, System]:
    if isinstance(task, Block):
        return task.campaign.case, task.campaign.system
    return task.case, task.system


def _difference(text: bytes) -> float:
    gap = msgspec.json.decode(text)
    return float("inf") if gap is None else float(gap)  # JSON has no infinity
