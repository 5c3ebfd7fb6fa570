from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from companion.domain import FlightMode
from companion.errors import CompanionError
from companion.io.files import check_writable, json_line, plain, write_json_atomic
from companion.io.flight_recorder import delete_old_flights, new_flight_directory
from companion.io.log_files import EventLog


@dataclass(frozen=True, slots=True)
class Fix:
    east_m: float
    mode: FlightMode


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (math.nan, None),
        (math.inf, None),
        ([1.5, -math.inf], [1.5, None]),
        ({"a": (1, "x", None, True)}, {"a": [1, "x", None, True]}),
        (FlightMode.HOLD, "hold"),
        (Fix(2.5, FlightMode.HOLD), {"east_m": 2.5, "mode": "hold"}),
        (np.float64("nan"), None),
        (np.int64(3), 3),
        (np.array([1.0, np.nan]), [1.0, None]),
        (Path("a/b"), "a/b"),
        ({FlightMode.HOLD: 1}, {"FlightMode.HOLD": 1}),
    ],
)
def test_anything_becomes_valid_json(value: object, expected: object) -> None:
    assert plain(value) == expected
    assert json.loads(json_line({"is": value, "at": 0.5})) == {"is": expected, "at": 0.5}


def test_events_are_one_json_object_per_line(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    log.write({"time_s": 0.1, "range_m": math.nan, "text": "line\nbreak \x1b[31m \ud800 Größe"})
    log.write({"time_s": 1 / 3})
    log.close()
    lines = (tmp_path / "events.jsonl").read_bytes().decode("ascii").splitlines()
    assert len(lines) == 2
    assert "\x1b" not in lines[0]
    assert json.loads(lines[0])["range_m"] is None
    assert json.loads(lines[1]) == {"time_s": 1 / 3}
    assert log.dropped == 0


def test_a_json_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "status.json"
    write_json_atomic(path, {"r95_m": math.inf})
    write_json_atomic(path, {"r95_m": 12.5})
    assert json.loads(path.read_text()) == {"r95_m": 12.5}
    assert os.listdir(tmp_path) == ["status.json"]


def test_a_failed_replacement_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "status.json"
    write_json_atomic(path, 1)

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(CompanionError, match="No space left"):
        write_json_atomic(path, 2)
    assert path.read_text() == "1\n"
    assert os.listdir(tmp_path) == ["status.json"]


def test_a_file_can_be_replaced_where_its_folder_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An old file's own permissions decide nothing: a new one takes its name."""
    path = tmp_path / "result.json"
    path.write_text("{}")
    monkeypatch.setattr("os.access", lambda asked, _: asked != path)
    check_writable(path)
    monkeypatch.setattr("os.access", lambda asked, _: asked != tmp_path)
    with pytest.raises(CompanionError, match="cannot be written; check its permissions"):
        check_writable(path)


@pytest.mark.parametrize("name", ["null", "stdout", "fd/1"])
def test_a_device_is_written_to_in_a_folder_of_others(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = Path("/dev") / name
    monkeypatch.setattr("os.access", lambda asked, _: asked == path)
    check_writable(path)


def test_a_flight_is_named_by_its_utc_time(tmp_path: Path) -> None:
    root = tmp_path / "deep" / "flights"
    names = [new_flight_directory(root, 1_795_229_400.9).name for _ in range(3)]
    assert names == ["2026-11-21T02-50-00Z", "2026-11-21T02-50-00Z-2", "2026-11-21T02-50-00Z-3"]
    assert all((root / name).is_dir() for name in names)


def test_a_root_that_is_a_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "flights").write_text("")
    with pytest.raises(CompanionError) as caught:
        new_flight_directory(tmp_path / "flights", 0.0)
    assert "\n" not in str(caught.value)


def test_only_flights_beyond_the_newest_are_deleted(tmp_path: Path) -> None:
    names = [
        "2026-11-21T02-50-00Z",
        "2026-11-21T02-50-00Z-2",
        "2026-11-21T02-50-00Z-10",
        "2026-11-22T00-00-00Z",
    ]
    for name in (*names, "notes", "2025-01-01T00-00-00Z.zip"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "flight.tlog").write_text("x")
    (tmp_path / "2020-01-01T00-00-00Z").write_text("a file")
    present = tmp_path / names[-1]
    deleted = delete_old_flights(tmp_path, 2, present)
    assert sorted(path.name for path in deleted) == names[:2]
    assert delete_old_flights(tmp_path, 2, present) == []
    assert {*names[2:], "notes", "2020-01-01T00-00-00Z"} < set(os.listdir(tmp_path))


def test_a_clock_that_was_set_back_never_costs_the_present_flight(tmp_path: Path) -> None:
    earlier = [new_flight_directory(tmp_path, 1_795_229_400.0 + n) for n in range(2)]
    present = new_flight_directory(tmp_path, 0.0)
    assert delete_old_flights(tmp_path, 2, present) == earlier[:1]
    assert delete_old_flights(tmp_path, 1, present) == earlier[1:]
    assert present.is_dir()
