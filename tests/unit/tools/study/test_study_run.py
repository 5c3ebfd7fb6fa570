from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.errors import CompanionError
from sim_link.lab.pool import Pool
from tools.study.study import Study
from tools.study.study_run import (
    FOLDER_NAME,
    Store,
    carried_out,
    cost_of,
    results_of,
    tallied,
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
    fields = {"table": "t", "title": "T", "runs": RUNS, "sweeps": [SWEEP]}
    fields["systems"] = list(systems)
    return msgspec.convert({**fields, **changes}, Study)


class _Recorder(Pool):
    """This process, with what was asked of it; gives up after some results."""

    def __init__(self, gives_up_after: int | None = None) -> None:
        super().__init__()
        self.asked: list[RunSeries] = []
        self._left = gives_up_after

    def results(
        self, work: Callable[[Any], Any], items: Sequence[Any]
    ) -> Generator[tuple[int, Any], None, None]:
        self.asked += items
        for position, result in super().results(work, items):
            if self._left is not None:
                self._left -= 1
                if self._left < 0:
                    raise CompanionError("gone")
            yield position, result


def _carry_out(work: dict[str, RunSeries], pool: Pool, store: Store) -> None:
    carried_out(work, tallied, cost_of, pool, store, "blocks")


def test_what_two_studies_share_is_done_once() -> None:
    one = [_study("huber/passive", "huber/fim")]
    both = [*one, _study("huber/fim", table="u")]
    assert work_of(both, SEED).keys() == work_of(one, SEED).keys()
    assert work_of(one, SEED + 1).keys().isdisjoint(work_of(one, SEED))


def test_more_runs_keep_what_is_done() -> None:
    fewer, more = (work_of([_study("huber/passive", runs=n)], SEED) for n in (100, 150))
    assert set(fewer) < set(more)
    assert len(set(more) - set(fewer)) == 2


def test_results_are_those_of_the_campaigns(tmp_path: Path) -> None:
    studies = [_study("asymmetric_huber/latched")]
    work = work_of(studies, SEED)
    store = Store(tmp_path / FOLDER_NAME)
    _carry_out(work, Pool(), store)
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
    studies = [_study("huber/reactive")]
    work = work_of(studies, SEED)
    first, second = _Recorder(gives_up_after=3), _Recorder()
    store = Store(tmp_path / FOLDER_NAME)
    with pytest.raises(CompanionError, match="gone"):
        _carry_out(work, first, store)
    with pytest.raises(KeyError):
        results_of(studies, SEED, store)
    _carry_out(work, second, store)
    results_of(studies, SEED, store)
    assert len(first.asked) == len(work) == 4
    assert second.asked == first.asked[3:]


def test_the_longest_come_first_and_progress_adds_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    totals, done = list[float](), list[float]()

    @contextmanager
    def shown(total: float, _: object) -> Iterator[Callable[[float], None]]:
        totals.append(total)
        yield done.append

    monkeypatch.setattr("tools.study.study_run.shown", shown)
    work = work_of([_study("huber/passive", "admm/passive", "ekf/passive")], SEED)
    recorder = _Recorder()
    _carry_out(work, recorder, Store(tmp_path / FOLDER_NAME))
    costs = [cost_of(task) for task in recorder.asked]
    assert costs == sorted(costs, reverse=True)
    assert totals == [pytest.approx(sum(done))] == [pytest.approx(sum(map(cost_of, work.values())))]
