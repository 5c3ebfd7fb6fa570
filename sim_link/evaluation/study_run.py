"""Carries out studies: each block of runs once, the longest first, kept as soon as it is done."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass

import msgspec

from sim_link.evaluation.backends import Backend
from sim_link.evaluation.campaign import (
    Block,
    Campaign,
    Tally,
    joined_in_order,
    tally_of,
    unpacked,
)
from sim_link.evaluation.case import Case
from sim_link.evaluation.ekf_check import (
    CHECKED_RUNS,
    LARGEST_DIFFERENCE_M,
    EkfCheck,
    largest_difference_m,
)
from sim_link.evaluation.results import CellResult, StudyResult
from sim_link.evaluation.sources import sources_digest
from sim_link.evaluation.store import Store, key_of
from sim_link.evaluation.study import Cell, Study, cells_of
from sim_link.evaluation.systems import FilterName, System
from sim_link.evaluation.warm_up import warm_up

Task = Block | EkfCheck
"""What is done in one go and kept."""
OnDone = Callable[[float], None]

COST_MS: dict[FilterName, float] = {"admm": 2.5, "map": 11.0, "tracker": 150.0, "filterpy": 100.0}
"""Roughly, of a run of 500 steps; what is not named takes USUAL_COST_MS."""
USUAL_COST_MS = 1.6
USUAL_STEPS = 500


@dataclass(frozen=True, slots=True)
class PlannedStudy:
    """A study with its cells and the number of runs of each."""

    study: Study
    runs: int
    cells: tuple[Cell, ...]

    def campaign(self, cell: Cell, seed: int) -> Campaign:
        """The runs of one of its cells."""
        return Campaign(cell.case, cell.system, seed, self.runs)


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
        studies: Which.
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


def carried_out(work: Work, backend: Backend, store: Store, on_done: OnDone) -> None:
    """Do all of it, and keep it.

    Args:
        work: What.
        backend: Who does it.
        store: Where it is kept.
        on_done: Told the cost of every task that is done.

    Raises:
        CompanionError: The backend or the store gave out; what was done is kept.
    """
    pending = sorted(work.tasks.items(), key=lambda item: -cost_of(item[1]))
    for position, result in backend.results(performed, [task for _, task in pending]):
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
    tallies: dict[tuple[str, ...], Tally] = {}
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


def prepared(work: Work, backend: Backend) -> None:
    """Compile every kernel, so that processes find them ready.

    The first time after a change of the sources this takes the better part of a minute.
    """
    warm_up([_flown(task) for task in work.tasks.values()], backend)


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
