from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.errors import CompanionError
from companion.kernel import IS_COMPILED
from sim_link.lab.pool import Pool
from tools.study.study import Study
from tools.study.study_run import (
    FOLDER_NAME,
    STEPS,
    PlannedStudy,
    Store,
    carried_out,
    cost_of,
    planned,
    results_of,
    work_of,
)
from tools.study.trials import RunSeries
from tools.verify_estimation import tallies_of

SWEEP = {
    "parameter": "p_nlos",
    "case": {"steps": 6},
    "varies": ["channel.p_nlos"],
    "values": [0.1, 0.9],
}
RUNS, SEED = 60, 4


def _study(*systems: str, **changes: Any) -> Study:
    fields = {"table": "t", "title": "T", "systems": list(systems), "sweeps": [SWEEP]}
    return msgspec.convert({**fields, **changes}, Study)


def _planned(*systems: str) -> list[PlannedStudy]:
    return planned([_study(*systems)], RUNS)


class _Recorder(Pool):
    """This process, with what was asked of it; gives up after some results."""

    def __init__(self, gives_up_after: int | None = None) -> None:
        super().__init__()
        self.asked: list[RunSeries] = []
        self.asked_first: list[tuple[RunSeries, ...]] = []
        self._left = gives_up_after

    def results(
        self, work: Callable[[Any], Any], items: Sequence[Any]
    ) -> Generator[tuple[int, Any], None, None]:
        self.asked_first.append(items[0])
        self.asked += [task for (task,) in items[1:]]
        for position, result in super().results(work, items):
            if self._left is not None and position > 0:
                self._left -= 1
                if self._left < 0:
                    raise CompanionError("gone")
            yield position, result


def _done(_: float) -> None:
    pass


def test_runs_are_the_studys_unless_somebody_says_otherwise() -> None:
    study = _study("huber/passive", runs=7)
    assert [planned([study], None)[0].runs, planned([study], 3)[0].runs] == [7, 3]


def test_what_two_studies_share_is_done_once() -> None:
    one = planned([_study("huber/passive", "huber/fim")], RUNS)
    both = planned([_study("huber/passive", "huber/fim"), _study("huber/fim", table="u")], RUNS)
    assert work_of(both, SEED).keys() == work_of(one, SEED).keys()
    assert work_of(one, SEED + 1).keys().isdisjoint(work_of(one, SEED))


def test_more_runs_keep_what_is_done() -> None:
    studies = [_study("huber/passive")]
    fewer, more = (work_of(planned(studies, runs), SEED) for runs in (100, 150))
    assert set(fewer) < set(more)
    assert len(set(more) - set(fewer)) == 2


def test_results_are_those_of_the_campaigns(tmp_path: Path) -> None:
    studies = _planned("asymmetric_huber/latched")
    work = work_of(studies, SEED)
    store = Store(tmp_path / FOLDER_NAME)
    carried_out(work, Pool(), store, _done)
    (result,) = results_of(studies, SEED, store)
    campaigns = [RunSeries(cell.case, cell.system, SEED, RUNS) for cell in result.cells]
    for cell, tally in zip(result.cells, tallies_of(campaigns, 1), strict=True):
        np.testing.assert_array_equal(cell.tally.final_errors_m, tally.final_errors_m)
        np.testing.assert_array_equal(cell.tally.rmse_m, tally.rmse_m)
    assert [(cell.value, cell.system.label) for cell in result.cells] == [
        ("0.1", "Proposed (Latched)"),
        ("0.9", "Proposed (Latched)"),
    ]


def test_what_was_kept_is_not_done_again(tmp_path: Path) -> None:
    studies = _planned("huber/reactive")
    work = work_of(studies, SEED)
    first, second = _Recorder(gives_up_after=3), _Recorder()
    store = Store(tmp_path / FOLDER_NAME)
    with pytest.raises(CompanionError, match="gone"):
        carried_out(work, first, store, _done)
    with pytest.raises(KeyError):
        results_of(studies, SEED, store)
    kept = store.found(work)
    left = {key: task for key, task in work.items() if key not in kept}
    carried_out(left, second, store, _done)
    results_of(studies, SEED, store)
    assert len(first.asked) == len(work) == 4
    assert second.asked == first.asked[3:]


def test_kernels_are_compiled_while_runs_that_need_none_are_done(tmp_path: Path) -> None:
    work, recorder = work_of(_planned("huber/passive", "tracker/passive"), SEED), _Recorder()
    carried_out(work, recorder, Store(tmp_path / FOLDER_NAME), _done)
    compiled = [task.system.is_compiled for task in recorder.asked]
    assert compiled == sorted(compiled)
    assert {False, True} == set(compiled)
    beside, nothing = recorder.asked_first
    assert [task.system.filter for task in beside] == (["huber"] if IS_COMPILED else [])
    assert all((task.runs, task.case.steps) == (1, STEPS) for task in beside)
    assert nothing == ()


def test_the_longest_come_first_and_progress_adds_up(tmp_path: Path) -> None:
    work = work_of(_planned("huber/passive", "admm/passive", "ekf/passive"), SEED)
    recorder, done = _Recorder(), list[float]()
    store = Store(tmp_path / FOLDER_NAME)
    carried_out(work, recorder, store, done.append)
    costs = [cost_of(task) for task in recorder.asked]
    assert costs == sorted(costs, reverse=True)
    assert sum(done) == pytest.approx(sum(map(cost_of, work.values())))
