"""A dask scheduler and its workers on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT_S = 300.0

Process = subprocess.Popen[str]


@dataclass(frozen=True, slots=True)
class DaskCluster:
    """Address of a scheduler, and the processes of its workers."""

    url: str
    workers: list[Process]


@contextmanager
def started(command: list[str], **environment: str) -> Iterator[Process]:
    """A process, which is killed at the end where it has not ended by itself."""
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def until(is_so: Callable[[], bool], process: Process) -> None:
    """Wait for something that a process does."""
    give_up_s = time.monotonic() + LIMIT_S
    while not is_so():
        assert time.monotonic() < give_up_s, "it takes too long"
        assert process.poll() is None, "it ended too early"
        time.sleep(0.02)


@contextmanager
def dask_cluster(folder: Path, workers: int, **environment: str) -> Iterator[DaskCluster]:
    """A scheduler and this number of workers of one thread."""
    path = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    where = ["--scheduler-file", str(path)]
    serve = [*dask, "scheduler", *where, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    work = [*dask, "worker", *where, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    with ExitStack() as stack:
        scheduler = stack.enter_context(started(serve))
        until(lambda: _address(path) is not None, scheduler)
        workers_started = [
            stack.enter_context(started(work, **environment)) for _ in range(workers)
        ]
        yield DaskCluster(f"dask://{_address(path)}", workers_started)


def _address(path: Path) -> str | None:
    """Return the address of a scheduler once its file is complete."""
    try:
        address: str = json.loads(path.read_text())["address"]
    except (OSError, json.JSONDecodeError):
        return None
    return address.removeprefix("tcp://")
