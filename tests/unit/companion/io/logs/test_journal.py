"""The flight's black box: what it keeps, its cap, and a disk that does not help."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path

import pytest

from companion.domain import EstimateState, TargetEstimate
from companion.guidance.commands import ReportResult, Severity
from companion.io.flight_recorder import (
    FlightJournal,
    delete_old_flights,
    new_flight_directory,
)
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink

FOUND = TargetEstimate(
    time_s=60.0,
    state=EstimateState.LOCALISED,
    position_enu_m=(12.0, 34.0),
    covariance_m2=((0.04, 0.0), (0.0, 0.04)),
    r95_m=0.5,
    range_offset_m=1.0,
    bearing_offset_rad=0.0,
    measurements=500,
)


PATIENCE_S = 30.0
"""Time limit of a writer on a busy machine; half the time for which a disk hangs."""


def a_heartbeat() -> bytes:
    return MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))


def test_frames_events_texts_and_the_result_are_kept(tmp_path: Path) -> None:
    journal = FlightJournal(tmp_path, 1000.0)
    journal.frame(a_heartbeat(), 1.0)
    journal.text(Severity.NOTICE, "in control", 2.0)
    journal.result(ReportResult(FOUND, 47.0, 8.0), 60.0)
    journal.close(PATIENCE_S)
    assert (tmp_path / "flight.tlog").read_bytes()[8:] == a_heartbeat()
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert [json.loads(line)["kind"] for line in lines] == ["text", "result"]
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["east_m"], result["latitude_deg"], result["unix_s"]) == (12.0, 47.0, 1060.0)
    assert (result["r95_m"], result["own_sigma_m"], result["own_sigma_told"]) == (0.5, 3.0, False)
    assert result["absolute_r95_m"] == pytest.approx(7.36, abs=0.01)
    assert journal.health.dropped == 0


def test_the_result_keeps_every_report_and_the_searched_area(tmp_path: Path) -> None:
    journal = FlightJournal(tmp_path, 1000.0)
    journal.result_of_search({"state": "not_found", "pos": 0.5, "track": [[8.5, 47.0, 0.0]]})
    for emitter_id, at_s in ((7, 60.0), (3, 90.0)):
        journal.result(ReportResult(FOUND, 47.0, 8.0, emitter_id), at_s)
    journal.result_of_search({"state": "heard", "pos": 0.8, "track": [[8.5, 47.0, 0.0]]})
    journal.close(PATIENCE_S)
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["emitter_id"], result["state"]) == (3, FOUND.state.value)
    assert [each["emitter_id"] for each in result["reports"]] == [7, 3]
    assert result["searched"] == {"state": "heard", "pos": 0.8}


def test_a_flight_of_another_companion_is_not_deleted_while_it_lasts(tmp_path: Path) -> None:
    first, second = (new_flight_directory(tmp_path, 1_795_229_400.0 + n) for n in range(2))
    journal = FlightJournal(first, 0.0)
    assert delete_old_flights(tmp_path, 1, second) == []
    journal.close(PATIENCE_S)
    journal.close(PATIENCE_S)
    assert delete_old_flights(tmp_path, 1, second) == [first]


def test_a_flight_stays_within_its_cap(tmp_path: Path) -> None:
    journal = FlightJournal(tmp_path, 0.0, max_bytes=20_000)
    for number in range(3000):
        journal.frame(a_heartbeat(), 0.01 * number)
        journal.record("phase", {"number": number}, 0.01 * number)
        journal.inputs.tick(0.01 * number)
        if number % 500 == 0:
            time.sleep(0.01)
    journal.close(PATIENCE_S)
    sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert set(sizes) == {
        *("flight.tlog", "flight.old.tlog"),
        *("flight.inputs", "flight.old.inputs"),
        *("events.jsonl", "events.old.jsonl"),
    }
    assert sum(sizes.values()) <= 20_000
    assert journal.health.bytes_kept == sum(sizes.values())
    newest = (tmp_path / "events.jsonl").read_text().splitlines()[-1]
    assert json.loads(newest)["number"] == 2999


def test_a_disk_that_hangs_holds_up_neither_the_flight_nor_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    real_fsync = os.fsync

    def hang(fd: int) -> None:
        released.wait(60.0)
        real_fsync(fd)

    real_write = os.write

    def hang_write(fd: int, data: bytes) -> int:
        released.wait(60.0)
        return real_write(fd, data)

    monkeypatch.setattr(os, "fsync", hang)
    monkeypatch.setattr(os, "write", hang_write)
    journal = FlightJournal(tmp_path, 0.0)
    started_s = time.monotonic()
    for number in range(1000):
        journal.frame(a_heartbeat(), 0.01 * number)
    journal.result(ReportResult(FOUND, None, None), 60.0)
    assert time.monotonic() - started_s < PATIENCE_S
    journal.close(timeout_s=0.2)
    assert time.monotonic() - started_s < PATIENCE_S
    assert journal.health.silent_s > 0.1
    released.set()
    journal.close(PATIENCE_S)
