"""The watchdog is fed only when every part answered."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import pytest

from companion.diagnostics import ProcessParts, Supervisor, Watchdog
from companion.io.shell import TimerStatistics
from tests.unit.companion.process.rig import StillLink, WatchedNotes, an_endpoint


class Rig:
    """A process under a manager that waits two seconds."""

    def __init__(self, listening: socket.socket, address: str) -> None:
        self.notes, self.timing, self.link = WatchedNotes(), TimerStatistics(), StillLink()
        self.supervisor = supervisor = Supervisor(
            {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "2000000"}
        )
        endpoint = an_endpoint(self.notes)
        parts = ProcessParts(self.notes, self.timing, [self.link], None)
        self.watchdog = Watchdog(supervisor, endpoint, parts)
        self._listening = listening
        self._wall_s = 100.0

    def pass_time(self, duration_s: float, *, is_ticking: bool = True) -> list[str]:
        """Let time pass; return what the service manager receives until then."""
        heard: list[str] = []
        for _ in range(round(duration_s / 0.05)):
            self._wall_s += 0.05
            if is_ticking:
                self.timing.note(0.0)
            self.watchdog.run(self._wall_s, self._wall_s)
            with suppress(BlockingIOError):  # a socket of this kind holds ten words at most
                while True:
                    heard.append(self._listening.recv(4096).decode())
        return heard


@pytest.fixture
def rig() -> Iterator[Rig]:
    name = f"companion-watchdog-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(f"\0{name}")
        listening.setblocking(False)
        rig = Rig(listening, f"@{name}")
        yield rig
        rig.supervisor.close()


def test_ready_is_said_once_and_only_when_the_control_tick_runs(rig: Rig) -> None:
    assert rig.pass_time(1.0, is_ticking=False) == []
    heard = rig.pass_time(4.0)
    assert heard[0] == "READY=1"
    assert heard.count("READY=1") == 1
    assert heard.count("STATUS=waiting") == 1


def test_a_healthy_process_feeds_it_often_within_the_timeout(rig: Rig) -> None:
    rig.pass_time(1.0)
    assert rig.pass_time(10.0).count("WATCHDOG=1") >= 17


def test_a_control_tick_that_stopped_is_not_covered_up(rig: Rig) -> None:
    rig.pass_time(1.0)
    assert rig.pass_time(5.0, is_ticking=False).count("WATCHDOG=1") <= 1
    assert rig.pass_time(5.0).count("WATCHDOG=1") >= 9


def test_a_writer_that_died_stops_the_feeding_and_is_named(rig: Rig) -> None:
    rig.pass_time(1.0)
    rig.notes.health = replace(rig.notes.health, is_alive=False)
    heard = rig.pass_time(5.0)
    assert "WATCHDOG=1" not in heard
    assert "STATUS=not responding: a writer of the log; waiting" in heard


def test_a_disk_that_hangs_is_no_reason_to_kill_a_flight(rig: Rig) -> None:
    rig.pass_time(1.0)
    rig.notes.health = replace(rig.notes.health, silent_s=60.0, queued=10_000)
    assert rig.pass_time(10.0).count("WATCHDOG=1") >= 17


def test_a_closed_link_stops_the_feeding_until_it_is_open_again(rig: Rig) -> None:
    rig.pass_time(1.0)
    rig.link.is_listening = False
    heard = rig.pass_time(5.0)
    assert "WATCHDOG=1" not in heard
    assert "STATUS=not responding: link udp 127.0.0.1:14550; waiting" in heard
    rig.link.is_listening = True
    assert rig.pass_time(5.0).count("WATCHDOG=1") >= 9
