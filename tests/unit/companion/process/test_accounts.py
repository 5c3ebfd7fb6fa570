"""Use of resources is recorded, and faults of the host are announced."""

from __future__ import annotations

from dataclasses import asdict, replace

from companion.diagnostics import ProcessDiagnostics, ProcessParts
from companion.io.links.link import LinkCounters
from companion.io.shell import TimerStatistics
from tests.unit.companion.process.rig import StillLink, WatchedNotes, an_endpoint


class Rig:
    def __init__(self, speed: float = 1.0) -> None:
        self.notes = WatchedNotes()
        self.timing = TimerStatistics()
        self.accounts = ProcessDiagnostics(
            an_endpoint(self.notes),
            ProcessParts(self.notes, self.timing, [StillLink()], None),
            speed,
        )
        self.now_s = 0.0

    def pass_time(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.05)):
            self.now_s += 0.05
            self.timing.note(0.0)
            self.accounts.run(self.now_s)

    @property
    def texts(self) -> list[str]:
        return [text for _, text in self.notes.texts]


def test_the_use_of_the_machine_is_recorded_every_ten_seconds() -> None:
    rig = Rig()
    rig.pass_time(30.5)
    records = rig.notes.of_kind("process")
    assert len(records) == 4
    assert records[-1]["ticks"] == 601
    assert records[-1]["missed_ticks"] == 0
    links = [{"name": "udp 127.0.0.1:14550", **asdict(LinkCounters())}]
    assert records[-1]["links"] == links
    assert {"resident_mb", "descriptors", "threads", "log_queued", "log_dropped", "log_mb"} < set(
        records[-1]
    )
    assert rig.texts == []


def test_a_simulation_that_runs_faster_is_recorded_by_the_wall() -> None:
    rig = Rig(speed=10.0)
    rig.pass_time(99.0)
    assert len(rig.notes.of_kind("process")) == 1


def test_a_disk_that_does_not_answer_is_reported_once_and_so_is_its_return() -> None:
    rig = Rig()
    rig.pass_time(1.0)
    for silent_s in (1.0, 2.5, 3.0, 4.0, 0.0, 0.0):
        rig.notes.health = replace(rig.notes.health, silent_s=silent_s)
        rig.pass_time(1.0)
    assert rig.texts == [
        "the disk has not responded for 2 s: the flight continues, the log waits",
        "the disk responds again",
    ]


def test_lost_entries_are_reported_when_there_are_more() -> None:
    rig = Rig()
    for dropped in (0, 7, 7, 7, 9):
        rig.notes.health = replace(rig.notes.health, dropped=dropped)
        rig.pass_time(10.0)
    assert [text.partition(" log")[0] for text in rig.texts] == ["7", "9"]


def test_a_computer_that_is_too_slow_is_reported() -> None:
    rig = Rig()
    rig.pass_time(5.0)
    for _ in range(8):
        rig.timing.note(0.1)
    rig.pass_time(20.0)
    assert rig.texts == ["computer too slow: 16 control ticks missed in 10 s"]
    worst = [record["worst_late_s"] for record in rig.notes.of_kind("process")]
    assert worst == [0.0, 0.1, 0.0]
