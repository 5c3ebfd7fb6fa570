"""Processes of a mission: what they say, and the event log, read while it grows."""

from __future__ import annotations

from pathlib import Path

from companion.io.child_processes import ChildProcess
from sim_link.lab.mission.flight_readers import EventTail


def flight(root: Path, name: str, text: str) -> Path:
    folder = root / name
    folder.mkdir(parents=True)
    log = folder / "events.jsonl"
    log.write_text(text)
    return log


def test_the_words_of_a_process_are_its_own(tmp_path: Path) -> None:
    log = tmp_path / "child.log"
    log.write_text("said by an earlier one\n")
    child = ChildProcess("child", ["-c", "print('hello', flush=True); input()"], log)
    child.start()
    while child.is_alive and not child.first_words:
        pass
    assert (child.first_words, child.last_words) == ("hello", "hello")
    child.stop()
    child.start()
    child.stop()
    assert child.first_words == "hello"


def test_lines_are_read_once_they_are_whole(tmp_path: Path) -> None:
    tail = EventTail(tmp_path)
    assert not tail.look_for_flight()
    log = flight(tmp_path, "1", '{"kind":"a"}\n{"ki')
    assert tail.look_for_flight()
    assert tail.take() == [{"kind": "a"}]
    log.write_text('{"kind":"a"}\n{"kind":"b"}\n')
    assert tail.take() == [{"kind": "b"}]
    assert tail.take() == []


def test_a_restart_begins_another_log(tmp_path: Path) -> None:
    tail = EventTail(tmp_path)
    flight(tmp_path, "1", '{"kind":"a"}\n')
    assert tail.look_for_flight()
    assert not tail.look_for_flight()
    flight(tmp_path, "2", '{"kind":"b"}\n')
    assert tail.look_for_flight()
    assert tail.take() == [{"kind": "b"}]


def test_flights_that_an_earlier_mission_left_are_not_ours(tmp_path: Path) -> None:
    flight(tmp_path, "1", '{"kind":"old"}\n')
    tail = EventTail(tmp_path)
    assert not tail.look_for_flight()
    flight(tmp_path, "2", '{"kind":"new"}\n')
    assert tail.look_for_flight()
    assert tail.take() == [{"kind": "new"}]
