from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from companion.errors import CompanionError
from sim_link.lab.evaluation.backends import LocalBackend, connected


def _square(number: int) -> int:
    return number * number


def _own_process(_: int) -> tuple[int, bool, str]:
    is_deaf = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return os.getpid(), is_deaf, os.environ.get("OPENBLAS_NUM_THREADS", "")


def _ended(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def _noted(place: tuple[Path, int]) -> int:
    folder, number = place
    (folder / str(number)).touch()
    return number


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_with_their_positions(jobs: int) -> None:
    assert sorted(LocalBackend(jobs).results(_square, range(20))) == [
        (number, number * number) for number in range(20)
    ]


def test_processes_leave_interrupts_to_us_and_use_one_thread_each() -> None:
    found = [result for _, result in LocalBackend(2).results(_own_process, range(8))]
    assert os.getpid() not in {pid for pid, _, _ in found}
    assert {(is_deaf, threads) for _, is_deaf, threads in found} == {(True, "1")}


def test_a_single_item_needs_no_process() -> None:
    assert next(iter(LocalBackend(4).results(_own_process, [0])))[1][0] == os.getpid()


def test_a_process_that_dies_is_one_line() -> None:
    with pytest.raises(CompanionError, match="run the same command again"):
        list(LocalBackend(2).results(_ended, range(8)))


def test_whoever_stops_listening_stops_the_work(tmp_path: Path) -> None:
    results = LocalBackend(2).results(_noted, [(tmp_path, number) for number in range(5000)])
    next(results)
    results.close()  # type: ignore[attr-defined]
    done = len(list(tmp_path.iterdir()))
    assert done < 5000
    assert sorted(LocalBackend(2).results(_square, range(3))) == [(0, 0), (1, 1), (2, 4)]


def test_the_local_backend_is_always_there() -> None:
    with connected("local", 1) as backend:
        assert list(backend.results(_square, [3])) == [(0, 9)]
