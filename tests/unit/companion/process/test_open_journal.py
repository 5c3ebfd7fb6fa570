"""The folder of a flight that begins, or cannot begin."""

from __future__ import annotations

import os
import signal
import socket
import threading
from pathlib import Path

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LogConfig, ProcessConfig, with_signing_key
from companion.errors import CompanionError, ConfigError, LinkError
from companion.flight_setup import open_journal
from companion.io.files import FLIGHT
from companion.io.flight_recorder import FlightJournal, new_flight_directory
from companion.io.links.transports import FlightLink, UdpBind
from companion.io.shell import Clock
from companion.link.interface import VEHICLE_ONLY, LinkRole, LinkSpec
from companion.run import FlightOptions, FlightView, fly

UNIX_S = 1.8e9


def opened(config: CompanionConfig, folder: Path) -> FlightJournal:
    log = LogConfig(directory=str(folder))
    return open_journal(msgspec.structs.replace(config, log=log), VEHICLE_ONLY, {}, UNIX_S)


def test_a_flight_begins_with_its_facts(tmp_path: Path) -> None:
    journal = opened(CompanionConfig(), tmp_path)
    journal.close()
    assert (journal.directory / FLIGHT).is_file()


def test_a_flight_that_cannot_write_its_log_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> FlightJournal:
        raise CompanionError("flight.tlog: cannot be opened (No space left on device)")

    monkeypatch.setattr("companion.flight_setup.FlightJournal", full)
    with pytest.raises(CompanionError, match="No space left"):
        opened(CompanionConfig(), tmp_path)
    assert os.listdir(tmp_path) == []


def flown(config: CompanionConfig, port: int) -> None:
    """Fly until a view stops it, at its first look."""

    class Stop(FlightView):
        def update(self, *_: object) -> None:
            """End the flight as a service manager does."""
            os.kill(os.getpid(), signal.SIGTERM)

    links = [FlightLink(UdpBind("127.0.0.1", port), LinkSpec(LinkRole.VEHICLE))]
    fly(config, links, Clock(speed=10.0), FlightOptions(views=[Stop()]))


def test_only_a_flight_that_has_begun_deletes_older_ones(tmp_path: Path) -> None:
    log = LogConfig(directory=str(tmp_path / "flights"), keep_flights=1)
    process = ProcessConfig(state_directory=str(tmp_path / "state"))
    config = msgspec.structs.replace(CompanionConfig(), log=log, process=process)
    older = new_flight_directory(tmp_path / "flights", UNIX_S)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="in use"):
            flown(config, taken.getsockname()[1])
    assert os.listdir(tmp_path / "flights") == [older.name]
    flown(config, 0)
    for thread in threading.enumerate():
        if thread.name == "delete older flights":
            thread.join()
    (kept,) = os.listdir(tmp_path / "flights")
    assert kept != older.name


def test_a_path_that_is_no_text_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    name = os.fsdecode(b"Schl\xfcssel/it")
    with pytest.raises(ConfigError, match=r"Schl.*ssel/it: .* UTF-8; rename it"):
        opened(with_signing_key(CompanionConfig(), Path(name)), tmp_path)
    assert os.listdir(tmp_path) == []
