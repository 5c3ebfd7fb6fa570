"""Addresses and strangers; real schedulers and workers are in tests/e2e."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from companion.errors import ConfigError
from sim_link.lab.evaluation.backends import (
    check_listening,
    check_same_sources,
    connected_to,
    sources_digest,
)


@contextmanager
def _server(greeting: bytes) -> Iterator[int]:
    """Says something to the first caller and hangs up."""
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
        connected_to(address).__enter__()


@pytest.mark.parametrize("port", [1, 99999])
def test_nobody_there(port: int) -> None:
    with pytest.raises(ConfigError, match="no dask scheduler answers there"):
        connected_to(f"dask://127.0.0.1:{port}").__enter__()


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH_9.7\r\n", b"hi", b""])
def test_somebody_else_there(greeting: bytes) -> None:
    with _server(greeting) as port, pytest.raises(OSError, match="something else"):
        check_listening("127.0.0.1", port)


def test_a_scheduler_announces_a_few_frames() -> None:
    with _server((4).to_bytes(8, "little") + b"rest") as port:
        check_listening("127.0.0.1", port)


def test_other_sources_are_refused() -> None:
    check_same_sources(sources_digest(), "dask://host:1")
    with pytest.raises(ConfigError, match="other sources or library versions"):
        check_same_sources("0123456789abcdef", "dask://host:1")
