"""Where blocks of runs are done, and the digest that names what made their numbers.

A short name for everything that makes a study's numbers, so that old ones are never reused.

Blocks of runs on the workers of a dask scheduler that somebody else has started.

A worker that is lost loses nothing: the scheduler gives its blocks to another. A worker with other
sources or library versions is refused, because its numbers might differ.

Where blocks of runs are done: here, in processes of this machine, or on a dask cluster.

What is done is a module's function of a value that can be pickled; results come back as they are
ready, with the positions of their items, and no more items wait than keep everybody busy.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import importlib.metadata
import os
import platform
import re
import signal
import socket
import struct
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from time import sleep
from typing import Any, Protocol, TypeVar

from companion.errors import CompanionError, ConfigError
from companion.kernel import IS_COMPILED

ROOT = Path(__file__).resolve().parents[3]
MAKING_NUMBERS = (
    "companion/domain.py",
    "companion/errors.py",
    "companion/estimation",
    "companion/geometry",
    "companion/kernel.py",
    "companion/planning",
    "sim_link/lab/evaluation",
    "sim_link/world",
)
"""What a run comes to follows from these alone."""
ABOUT_NUMBERS = tuple(
    f"sim_link/lab/evaluation/{name}"
    for name in (
        "backends.py",
        "bench.py",
        "hostile.py",
        "planner_bench.py",
        "reporting/",
        "study.py",
        "study_run.py",
        "verification.py",
    )
)
"""Except these, which plan runs and report them."""
LIBRARIES = ("numpy", "scipy", "numba", "filterpy")
"""Another version of these may round differently."""


@lru_cache(maxsize=1)
def sources_digest() -> str:
    """The digest of sources and versions, the same on every machine that has the same."""
    digest = hashlib.sha256(f"{platform.python_version()} compiled {IS_COMPILED}\n".encode())
    for name in LIBRARIES:
        digest.update(f"{name} {version_of(name)}\n".encode())
    for path in sources():
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()[:16]


def sources() -> list[Path]:
    """The files that a run's numbers follow from, in order."""
    found: set[Path] = set()
    for name in MAKING_NUMBERS:
        found.update([ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*.py"))
    return sorted(
        path for path in found if not path.relative_to(ROOT).as_posix().startswith(ABOUT_NUMBERS)
    )


def version_of(library: str) -> str:
    """The installed version of a library, or "none"."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "none"


Item = TypeVar("Item")
Result = TypeVar("Result")

SCHEME = "dask://"
ADDRESS = re.compile(re.escape(SCHEME) + r"(\[[0-9a-fA-F:]+\]|[^\s:/]+):[0-9]{1,5}")
CONNECT_S = 3.0
"""A scheduler that has not answered by then is not there."""
FIRST_WORKER_S = 5.0
"""How long a scheduler may be without any worker."""
IN_FLIGHT = 4
"""Blocks for each thread of a cluster, so that none waits for the network."""
FRAME_COUNT = struct.Struct("<Q")
"""What a scheduler's greeting begins with."""
MOST_FRAMES = 1000
"""A greeting with more frames than this is no greeting."""


class DaskBackend:
    """The workers of a scheduler."""

    def __init__(self, client: Any, address: str) -> None:
        self._client = client
        self._address = address

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result]]:
        """See `Backend`; whoever stops listening cancels what is in flight."""
        from distributed import KilledWorker

        try:
            yield from self._results(work, items)
        except KilledWorker:
            raise CompanionError(
                f"{self._address}: one block has ended every worker that it was given to; look at "
                "their logs (memory?), then run the same command again to go on"
            ) from None
        except (OSError, concurrent.futures.CancelledError) as error:
            raise CompanionError(
                f"{self._address}: the scheduler is gone; run the same command again to go on"
            ) from error

    def _results(
        self, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result]]:
        from distributed import as_completed

        waiting = iter(enumerate(items))
        most = IN_FLIGHT * max(sum(self._client.nthreads().values()), 1)
        ready = as_completed(loop=self._client.loop, with_results=True)
        flying = {self._sent(ready, work, item) for item in islice(waiting, most)}
        try:
            while flying:
                future, (position, digest, result) = next(ready)
                flying.discard(future)
                check_same_sources(digest, self._address)
                flying.update(self._sent(ready, work, item) for item in islice(waiting, 1))
                yield position, result
        finally:
            self._client.cancel(list(flying))

    def _sent(self, ready: Any, work: Callable[[Item], Result], item: tuple[int, Item]) -> Any:
        future = self._client.submit(_signed, work, item, pure=False)
        ready.add(future)
        return future


@contextmanager
def connected_to(address: str) -> Iterator[DaskBackend]:
    """A backend whose workers have these very sources.

    Args:
        address: dask://HOST:PORT.

    Raises:
        ConfigError: It is no such address, nobody answers there, or there are no such workers.
    """
    if not ADDRESS.fullmatch(address):
        raise ConfigError(f"--backend {address}: must be local or {SCHEME}HOST:PORT")
    client = _client(address)
    try:
        _check_workers(client, address)
        yield DaskBackend(client, address)
    finally:
        client.close(timeout=1.0)


def check_listening(host: str, port: int) -> None:
    """Make sure that something speaks dask there: its client retries and retries other servers.

    A scheduler greets whoever connects with the number of frames of its handshake.

    Raises:
        OSError: Nothing listens there, or something else.
    """
    with socket.create_connection((host, port), CONNECT_S) as connection:
        greeting = connection.recv(FRAME_COUNT.size, socket.MSG_WAITALL)
    if len(greeting) < FRAME_COUNT.size or FRAME_COUNT.unpack(greeting)[0] > MOST_FRAMES:
        raise OSError("something else listens there")


def check_same_sources(digest: str, address: str) -> None:
    """Make sure that a worker would come to our numbers.

    Raises:
        ConfigError: Its sources or libraries are others.
    """
    if digest != sources_digest():
        raise ConfigError(
            f"--backend {address}: a worker has other sources or library versions than this "
            "machine; install the same everywhere, or numbers would differ"
        )


def _client(address: str) -> Any:
    try:
        import dask

        dask.config.set(
            {
                "logging": {"distributed": "critical", "distributed.client": "critical"},
                "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
            }
        )
        from distributed import Client
    except ImportError:
        raise ConfigError(
            f"--backend {address}: dask is not installed; pip install 'companion-sim-link[cluster]'"
        ) from None
    host, _, port = address.removeprefix(SCHEME).rpartition(":")
    try:
        check_listening(host.strip("[]"), int(port))
        return Client(f"tcp://{host}:{port}", timeout=CONNECT_S, set_as_default=False)
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"--backend {address}: no dask scheduler answers there ({_brief(error)}); "
            "check the address, or start one with `dask scheduler`"
        ) from None


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError:
        raise ConfigError(
            f"--backend {address}: the scheduler has no workers; start some with `dask worker`"
        ) from None
    try:
        digests = client.run(sources_digest)
    except Exception as error:  # whatever importing raises over there
        raise ConfigError(
            f"--backend {address}: a worker cannot import this project ({_brief(error)}); install "
            "it there, with the extras eval and fast"
        ) from None
    for digest in digests.values():
        check_same_sources(digest, address)


def _signed(work: Callable[[Item], Result], item: tuple[int, Item]) -> tuple[int, str, Result]:
    """On a worker; with the state of the sources there."""
    return item[0], sources_digest(), work(item[1])


def _brief(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return (text or type(error).__name__)[:120]


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

    Raises:
        ConfigError: There is no such backend, or nobody answers there.
    """
    if name == LOCAL:
        yield LocalBackend(jobs)
        return

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
