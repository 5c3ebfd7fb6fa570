"""Work given out to processes; addresses of clusters. Schedulers and workers are in tests/e2e."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from companion.errors import CompanionError, ConfigError
from sim_link.lab.pool import (
    AHEAD,
    ROOT,
    WorkerLostError,
    check_scheduler,
    check_sources,
    open_pool,
    sources_digest,
)


def _square(number: int) -> int:
    return number * number


def _own_process(_: int) -> tuple[int, bool, str]:
    is_deaf = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return os.getpid(), is_deaf, os.environ.get("OPENBLAS_NUM_THREADS", "")


def _ended(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def _noted(target: tuple[Path, int]) -> int:
    """Work for an hour, unless it is the first one; leaves a note on its way out."""
    folder, number = target
    try:
        time.sleep(3600.0 if number else 0.0)
    finally:
        (folder / str(number)).touch()
    return number


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_with_their_positions(jobs: int) -> None:
    with open_pool(jobs=jobs) as pool:
        assert sorted(pool.results(_square, range(20))) == [(n, n * n) for n in range(20)]
        assert sorted(pool.results(_square, [7])) == [(0, 49)]


@pytest.mark.slow
def test_processes_leave_interrupts_to_us_and_use_one_thread_each() -> None:
    with open_pool(jobs=2) as pool:
        found = [result for _, result in pool.results(_own_process, range(8))]
    assert os.getpid() not in {pid for pid, _, _ in found}
    assert {(is_deaf, threads) for _, is_deaf, threads in found} == {(True, "1")}


def test_one_job_needs_no_process() -> None:
    with open_pool() as pool:
        assert [pid for _, (pid, _, _) in pool.results(_own_process, [0])] == [os.getpid()]


def test_a_process_that_dies_is_one_line_with_what_was_given_out() -> None:
    with open_pool(jobs=2) as pool, pytest.raises(WorkerLostError, match="fewer --jobs") as caught:
        list(pool.results(_ended, range(30)))
    assert 3 in caught.value.positions
    assert len(caught.value.positions) <= 2 * AHEAD


@pytest.mark.slow
def test_a_reader_that_stops_ends_the_work_which_cleans_up(tmp_path: Path) -> None:
    with open_pool(jobs=2) as pool:
        results = pool.results(_noted, [(tmp_path, number) for number in range(9)])
        assert next(results) == (0, 0)
        time.sleep(0.5)
        results.close()
        assert multiprocessing.active_children() == []
    begun = {path.name for path in tmp_path.iterdir()}
    assert {"0", "1"} <= begun
    assert len(begun) <= 3, "what waited must not begin"


@pytest.mark.slow
def test_an_interrupt_tells_what_was_done_by_then(tmp_path: Path) -> None:
    finished: list[int] = []

    def interrupt() -> None:
        while not finished:
            time.sleep(0.02)
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    items = [(tmp_path, number) for number in range(4)]
    with pytest.raises(KeyboardInterrupt), open_pool(jobs=2) as pool:
        finished.extend(position for position, _ in pool.results(_noted, items))
    assert finished == [0]


ORPHANS = """
import multiprocessing, os, signal
from sim_link.lab.pool import open_pool
def main():
    with open_pool(jobs=2) as pool:
        for _, pid in pool.results(os.getpgid, [0, 0, 0]):
            print(*[child.pid for child in multiprocessing.active_children()], flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
if __name__ == "__main__":
    main()
"""


@pytest.mark.slow
def test_processes_end_with_the_one_that_gives_work(tmp_path: Path) -> None:
    script = tmp_path / "orphans.py"
    script.write_text(ORPHANS)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(script)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    left = {int(pid) for pid in done.stdout.split()}
    give_up_s = time.monotonic() + 30.0
    while left:
        assert time.monotonic() < give_up_s, "a worker goes on"
        left = {pid for pid in left if Path(f"/proc/{pid}").exists()}
        time.sleep(0.05)


@contextmanager
def _server(greeting: bytes) -> Iterator[int]:
    """Serve a greeting to the first caller, and hang up."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(greeting)

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1]
        thread.join()


@pytest.mark.parametrize(
    "address", ["dusk://127.0.0.1:1", "dask://", "dask://127.0.0.1", "dask://a b:1", "LOCAL"]
)
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(ConfigError, match="must be local or dask://HOST:PORT"):
        open_pool(address).__enter__()


@pytest.mark.parametrize("port", [1, 99999])
def test_no_scheduler_answers(port: int) -> None:
    with pytest.raises(ConfigError, match="no dask scheduler answers there"):
        open_pool(f"dask://127.0.0.1:{port}").__enter__()


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH_9.7\r\n", b"hi", b""])
def test_another_program_answers(greeting: bytes) -> None:
    with _server(greeting) as port, pytest.raises(OSError, match="something else"):
        check_scheduler("127.0.0.1", port)


def test_a_scheduler_announces_a_few_frames() -> None:
    with _server((4).to_bytes(8, "little") + b"rest") as port:
        check_scheduler("127.0.0.1", port)


def test_other_sources_are_refused() -> None:
    check_sources(sources_digest())
    with pytest.raises(ConfigError, match="other sources or library versions"):
        check_sources("0123456789abcdef")
    assert isinstance(WorkerLostError("gone", [1]), CompanionError)
