"""The folder of a flight that begins, or cannot begin."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LogConfig, with_signing_key
from companion.errors import CompanionError, ConfigError
from companion.flight_setup import open_journal
from companion.io.files import FLIGHT
from companion.io.flight_recorder import FlightJournal
from companion.link.interface import VEHICLE_ONLY

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


def test_a_path_that_is_no_text_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    name = os.fsdecode(b"Schl\xfcssel/it")
    with pytest.raises(ConfigError, match=r"Schl.*ssel/it: .* UTF-8; rename it"):
        opened(with_signing_key(CompanionConfig(), Path(name)), tmp_path)
    assert os.listdir(tmp_path) == []
