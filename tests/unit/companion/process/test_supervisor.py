"""Messages to the service manager, on real sockets of both kinds."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from companion.diagnostics import ALIVE, READY, STOPPING, Supervisor


@contextmanager
def manager(address: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(address)
        listening.setblocking(False)
        yield listening


def test_words_arrive_at_a_path(tmp_path: Path) -> None:
    path = str(tmp_path / "notify")
    with manager(path) as listening:
        supervisor = Supervisor({"NOTIFY_SOCKET": path})
        supervisor.notify(READY)
        supervisor.status("following the plan\nR95 2.0 m " + "x" * 500)
        supervisor.notify(ALIVE)
        supervisor.notify(STOPPING)
        heard = [listening.recv(4096).decode() for _ in range(4)]
        supervisor.close()
    assert heard[0] == "READY=1"
    assert heard[1].startswith("STATUS=following the plan R95 2.0 m x")
    assert len(heard[1]) == len("STATUS=") + 200
    assert heard[2:] == ["WATCHDOG=1", "STOPPING=1"]
    assert supervisor.failed == 0


def test_words_arrive_in_the_abstract_namespace() -> None:
    name = f"companion-test-{os.getpid()}"
    with manager(f"\0{name}") as listening:
        supervisor = Supervisor({"NOTIFY_SOCKET": f"@{name}"})
        supervisor.notify(READY)
        assert listening.recv(4096) == b"READY=1"
        supervisor.close()


@pytest.mark.parametrize("address", ["", "@", "relative", "vsock:2:1234"])
def test_without_a_manager_nothing_is_said(address: str) -> None:
    supervisor = Supervisor({"NOTIFY_SOCKET": address})
    assert not supervisor.is_there
    supervisor.notify(READY)
    supervisor.close()
    assert supervisor.failed == 0


def test_a_manager_that_went_away_is_counted(tmp_path: Path) -> None:
    supervisor = Supervisor({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    supervisor.notify(READY)
    supervisor.notify(ALIVE)
    assert supervisor.failed == 2
    supervisor.close()
    supervisor.notify(ALIVE)
    assert supervisor.failed == 2


def test_a_manager_that_does_not_read_costs_no_time() -> None:
    name = f"companion-lazy-{os.getpid()}"
    with manager(f"\0{name}"):
        supervisor = Supervisor({"NOTIFY_SOCKET": f"@{name}"})
        for _ in range(10_000):
            supervisor.notify(ALIVE)
        assert supervisor.failed > 0
        supervisor.close()


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "2000000"}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
    ],
)
def test_the_watchdog_is_the_managers(
    environment: dict[str, str], watchdog_s: float | None
) -> None:
    assert Supervisor(environment).watchdog_s == watchdog_s
