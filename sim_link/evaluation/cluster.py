"""Blocks of runs on the workers of a dask scheduler that somebody else has started.

A worker that is lost loses nothing: the scheduler gives its blocks to another. A worker with other
sources or library versions is refused, because its numbers might differ.
"""

from __future__ import annotations

import concurrent.futures
import re
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from companion.errors import CompanionError, ConfigError
from sim_link.evaluation.sources import sources_digest

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
    """The workers of a scheduler.

    Args:
        client: Connected to it.
        address: For errors.
    """

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
            f"--backend {address}: dask is not installed; pip install 'companion-guidance[cluster]'"
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
