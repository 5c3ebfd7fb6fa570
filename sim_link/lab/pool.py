"""Map of a function over many items, in this process, several processes, or a cluster.

The function is at module level and needs only its item, so that the result does not depend on where
it runs. Items are given out in order, no more at a time than keep all workers busy. A worker leaves
Ctrl-C to its parent, and ends with it; a parent that stops listening ends the work: processes are
interrupted and clean up, what has begun on a cluster runs to its end and is forgotten.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import multiprocessing
import os
import platform
import re
import signal
import socket
import struct
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from time import monotonic, sleep
from types import FrameType
from typing import Any, TypeVar, cast

from companion.errors import CompanionError, ConfigError, how_to_install
from companion.kernel import IS_COMPILED
from companion.kernel_cache import digest_of

Item = TypeVar("Item")
Result = TypeVar("Result")

LOCAL, SCHEME = "local", "dask://"
ADDRESS = re.compile(re.escape(SCHEME) + r"(\[[0-9a-fA-F:]+\]|[^\s:/]+):([0-9]{1,5})")
AHEAD = 2
"""Items that each worker gets at a time: one in work, and the next one."""
GRACE_S = 10.0
"""Time for which an interrupted process may clean up before it is killed."""
CONNECT_S = 3.0
FIRST_WORKER_S = 5.0
FRAME_COUNT, MAX_FRAMES = struct.Struct("<Q"), 1000
"""Greeting of a dask scheduler: the number of its handshake's frames, and the largest."""
THREADS_OF = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that are 1 in processes when there is one per core."""

ROOT, PACKAGES = (
    Path(__file__).resolve().parents[2],
    ("companion", "sim_link", "tools/study", "tools/campaign"),
)
"""Sources that results depend on; the last two exist in a checkout only."""
LIBRARIES = ("numpy", "scipy", "numba", "filterpy")
"""Libraries whose other versions may round differently."""


class WorkerLostError(CompanionError):
    """A worker is gone; `positions` are those of its unfinished items."""

    def __init__(self, text: str, positions: Sequence[int]) -> None:
        super().__init__(text)
        self.positions = tuple(positions)


class Pool:
    """Distributes work to workers, some items at a time; without workers, this process does it."""

    def __init__(self, workers: Processes | Cluster | None = None, width: int = 1) -> None:
        self._workers = workers
        self._width = width

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Generator[tuple[int, Result], None, None]:
        """Yield results with their positions as they come, until an error or interrupt."""
        if self._workers is None:
            yield from ((position, work(item)) for position, item in enumerate(items))
            return
        running: dict[Future[Result], int] = {}
        try:
            yield from self._as_completed(self._workers, work, items, running)
        except self._workers.lost as error:
            raise WorkerLostError(self._workers.lost_text, sorted(running.values())) from error
        except KeyboardInterrupt:
            self._stop(self._workers, running)
            for future in list(running):
                if future.done() and not future.cancelled() and future.exception() is None:
                    yield running.pop(future), future.result()
            raise
        finally:
            self._stop(self._workers, running)

    def _as_completed(
        self,
        workers: Processes | Cluster,
        work: Callable[[Item], Result],
        items: Sequence[Item],
        running: dict[Future[Result], int],
    ) -> Generator[tuple[int, Result], None, None]:
        coming = iter(enumerate(items))
        while True:
            for position, item in islice(coming, self._width - len(running)):
                running[workers.submit(work, item)] = position
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                result = future.result()
                yield running.pop(future), result

    @staticmethod
    def _stop(workers: Processes | Cluster, running: Iterable[Future[Any]]) -> None:
        left = [future for future in running if not future.cancel() and not future.done()]
        if left:
            workers.interrupt()


@contextmanager
def open_pool(backend: str = LOCAL, jobs: int = 1) -> Iterator[Pool]:
    """Yield this process, more of this machine, or dask://HOST:PORT (`ConfigError`: no answer)."""
    if backend != LOCAL:
        with _connected(backend) as cluster:
            yield Pool(cluster, AHEAD * cluster.size)
    elif jobs <= 1:
        yield Pool()
    else:
        with Processes(jobs) as processes:
            yield Pool(processes, AHEAD * jobs)


class Processes(ProcessPoolExecutor):
    """Processes of this machine, started as they are needed, with one thread for arithmetic."""

    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)
    lost_text = "a process ended by force, perhaps for lack of memory; try fewer --jobs"

    def __init__(self, jobs: int) -> None:
        for name in THREADS_OF:
            os.environ.setdefault(name, "1")
        resource_tracker.ensure_running()  # its start would unblock what `submit` blocks
        super().__init__(jobs, multiprocessing.get_context("spawn"), _begin_worker)

    def submit(self, work: Callable[[Item], Result], item: Item) -> Future[Result]:  # type: ignore[override]  # one item
        """Submit an item; a process started for it ignores Ctrl-C, even while it loads."""
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            return super().submit(_work_unless_interrupted, work, item)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in every process, and kill those that do not end by that."""
        workers = multiprocessing.active_children()
        self.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            with suppress(ProcessLookupError):
                os.kill(cast(int, worker.pid), signal.SIGUSR1)
        give_up_s = monotonic() + GRACE_S
        for worker in workers:
            worker.join(max(give_up_s - monotonic(), 0.0))
            worker.kill()
        while any(worker.is_alive() for worker in workers):
            sleep(0.01)  # the executor's own thread may be the one that hears of the end


@dataclass(slots=True)
class _Worker:
    """State of this process as a worker of another."""

    is_busy: bool = False
    is_interrupted: bool = False

    def interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        """Stop the running tasks, and start no more."""
        self.is_interrupted = True
        if self.is_busy:
            raise KeyboardInterrupt


_worker = _Worker()


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    signal.signal(signal.SIGUSR1, _worker.interrupt)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work_unless_interrupted(work: Callable[[Item], Result], item: Item) -> Result:
    if _worker.is_interrupted:
        raise KeyboardInterrupt
    _worker.is_busy = True
    try:
        return work(item)
    finally:
        _worker.is_busy = False


class Cluster:
    """Workers of a dask scheduler started elsewhere; the tasks of a lost one go to another."""

    def __init__(self, client: Any, address: str) -> None:
        from distributed import KilledWorker

        self.lost: tuple[type[BaseException], ...] = (KilledWorker, CancelledError, OSError)
        self.lost_text = f"{address}: the scheduler is gone, or an item ended all its workers"
        self.size = max(sum(client.nthreads().values()), 1)
        self._executor = client.get_executor(pure=False)

    def submit(self, work: Callable[[Item], Result], item: Item) -> Future[Result]:
        """Submit an item to the pool."""
        future: Future[Result] = self._executor.submit(_work_if_same, sources_digest(), work, item)
        return future

    def interrupt(self) -> None:
        """Do nothing: tasks of a cluster share a process, and run to their end."""


@contextmanager
def _connected(backend: str) -> Iterator[Cluster]:
    address = ADDRESS.fullmatch(backend)
    if address is None:
        raise ConfigError(f"--backend {backend}: must be local or {SCHEME}HOST:PORT")
    try:
        client = _client(address[1], int(address[2]))
    except ImportError:
        command = how_to_install("dask", "distributed")
        raise ConfigError(f"--backend {backend}: dask is not installed; {command}") from None
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"--backend {backend}: no dask scheduler answers there ({_brief(error)}); "
            "check the address, or start one with `dask scheduler`"
        ) from None
    try:
        _check_workers(client, backend)
        yield Cluster(client, backend)
    finally:
        client.close(timeout=1.0)


def _client(host: str, port: int) -> Any:
    import dask
    from distributed import Client

    check_scheduler(host.strip("[]"), port)
    quiet = {"distributed": "critical", "distributed.client": "critical"}
    dask.config.set({"logging": quiet, "distributed.comm.timeouts.connect": f"{CONNECT_S}s"})
    return Client(f"tcp://{host}:{port}", timeout=CONNECT_S, set_as_default=False)


def check_scheduler(host: str, port: int) -> None:
    """Raise an OSError unless the peer speaks dask, whose client would wait for ever."""
    with socket.create_connection((host, port), CONNECT_S) as connected:
        greeting = connected.recv(FRAME_COUNT.size, socket.MSG_WAITALL)
    if len(greeting) < FRAME_COUNT.size or FRAME_COUNT.unpack(greeting)[0] > MAX_FRAMES:
        raise OSError("something else listens there")


def _check_workers(client: Any, backend: str) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        client.run(check_sources, sources_digest())
    except TimeoutError:
        raise ConfigError(
            f"--backend {backend}: the scheduler has no workers; start some with `dask worker`"
        ) from None
    except ConfigError as error:
        raise ConfigError(f"--backend {backend}: {error}") from None
    except Exception as error:  # whatever importing raises over there
        raise ConfigError(
            f"--backend {backend}: a worker cannot import this project ({_brief(error)}); install "
            "it there, with the same extras"
        ) from None


def _work_if_same(digest: str, work: Callable[[Item], Result], item: Item) -> Result:
    """Work on a worker that may have joined after the check."""
    check_sources(digest)
    return work(item)


def check_sources(digest: str) -> None:
    """Raise a ConfigError unless this process would produce the same results as another."""
    if digest != sources_digest():
        raise ConfigError(
            "a worker has other sources or library versions than this machine, or compiles where "
            "this one does not (NUMBA_DISABLE_JIT); install and start the same everywhere, or "
            "results would differ"
        )


@lru_cache(maxsize=1)
def sources_digest() -> str:
    """Return a short name of everything that results depend on, besides the tasks."""
    versions = [f"{name} {version_of(name)}" for name in LIBRARIES]
    python = f"{platform.python_version()} compiled {IS_COMPILED}"
    facts = (python, *versions, digest_of(ROOT, PACKAGES))
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]


def version_of(library: str) -> str:
    """Return the installed version of a library, or "none"."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _brief(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return (text or type(error).__name__)[:120]
