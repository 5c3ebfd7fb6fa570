"""Where blocks of runs are done: here, in processes of this machine, or on a dask cluster.

What is done is a module's function of a value that can be pickled; results come back as they are
ready, with the positions of their items, and no more items wait than keep everybody busy.
"""

from __future__ import annotations

import concurrent.futures
import os
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from time import sleep
from typing import Protocol, TypeVar

from companion.errors import CompanionError

Item = TypeVar("Item")
Result = TypeVar("Result")

LOCAL = "local"
LOOK_EVERY_S = 0.5
"""How often a process looks whether the one that gives it work is still there."""


class Backend(Protocol):
    """Does the same to many items."""

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result]]:
        """The results with the positions of their items, as they come.

        Raises:
            CompanionError: Who should do it is gone.
        """


class LocalBackend:
    """This process, or several of this machine through joblib.

    Args:
        jobs: Processes; 1: this one.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result]]:
        """See `Backend`; whoever stops listening ends the processes, too."""
        jobs = min(self._jobs, len(items))
        if jobs <= 1:
            yield from ((position, work(item)) for position, item in enumerate(items))
            return
        from joblib import Parallel, delayed, parallel_config

        do = delayed(partial(_numbered, os.getpid(), work))
        with parallel_config(backend="loky", inner_max_num_threads=1):
            parallel = Parallel(jobs, return_as="generator_unordered", batch_size=1)
        try:
            with _deaf_to_interrupts():
                done = parallel(do(item) for item in enumerate(items))
            with _closing_quietly(done):
                yield from map(_unchanged, done)  # `done` itself it would close, with a warning
        except concurrent.futures.BrokenExecutor as error:
            raise CompanionError(
                "a process ended by force, perhaps for lack of memory; run the same command again "
                "to go on, with fewer --jobs"
            ) from error


@contextmanager
def connected(name: str, jobs: int) -> Iterator[Backend]:
    """The backend of a name: local, or dask://HOST:PORT.

    Args:
        name: Which.
        jobs: Processes of the local one.

    Raises:
        ConfigError: There is no such backend, or nobody answers there.
    """
    if name == LOCAL:
        yield LocalBackend(jobs)
        return
    from sim_link.evaluation.cluster import connected_to

    with connected_to(name) as backend:
        yield backend


def _unchanged(result: Result) -> Result:
    return result


def _numbered(
    parent: int, work: Callable[[Item], Result], item: tuple[int, Item]
) -> tuple[int, Result]:
    """In a process of joblib's."""
    _settle(parent)
    return item[0], work(item[1])


@lru_cache(maxsize=1)
def _settle(parent: int) -> None:
    """Leave a Ctrl-C to whoever listens to it, and do not outlive the process that gives work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: int) -> None:
    while os.getppid() == parent:
        sleep(LOOK_EVERY_S)
    os._exit(1)


@contextmanager
def _closing_quietly(results: Generator[Result, None, None]) -> Iterator[None]:
    """Stops the work without joblib's advice to let it end."""
    try:
        yield
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results.close()


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes started meanwhile leave a Ctrl-C to this one, even while they load."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
