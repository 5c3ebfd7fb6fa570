"""A flight whose log does not fit on the disk."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion import flight_commands
from companion.arguments import argument_parser
from companion.errors import EXIT_FAILED
from companion.io.flight_recorder import FlightJournal
from companion.run import FlightEnd


def test_the_end_of_a_flight_says_which_log_ends_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real_write, journal = os.write, FlightJournal(tmp_path, 0.0)

    def full(descriptor: int, data: bytes) -> int:
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith(".jsonl"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real_write(descriptor, data)

    monkeypatch.setattr(os, "write", full)
    assert journal.is_whole
    for number in range(3):
        journal.record("phase", {"number": number}, 0.1 * number)
    with caplog.at_level(logging.WARNING, "companion.flight"):
        journal.close(30.0)
    assert not journal.is_whole
    (line,) = (record.message for record in caplog.records if record.name == "companion.flight")
    assert line == (f"{tmp_path}: lost to a slow or full disk: 3 entries of events.jsonl after 0 s")


@pytest.mark.parametrize(("is_whole", "code"), [(True, 0), (False, EXIT_FAILED)])
def test_a_flight_without_its_whole_log_has_failed(
    is_whole: bool, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    end = FlightEnd(SimpleNamespace(), is_whole)  # type: ignore[arg-type]
    monkeypatch.setattr(flight_commands, "fly", lambda *_: end)
    arguments = argument_parser().parse_args(["--connect", "udp:127.0.0.1:14540", "--quiet"])
    assert flight_commands.fly_vehicle(arguments) == code
