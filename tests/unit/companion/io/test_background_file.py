from __future__ import annotations

import logging
import os
import threading
from pathlib import Path

import pytest

from companion.errors import CompanionError
from companion.io import files
from companion.io.files import BackgroundFile

PATIENCE_S = 30.0
"""Time limit of a writer on a busy machine; half the time for which a disk hangs."""


def test_records_arrive_in_order(tmp_path: Path) -> None:
    file = BackgroundFile(tmp_path / "log")
    for number in range(2000):
        file.append(f"{number}\n".encode())
    file.close(PATIENCE_S)
    assert (tmp_path / "log").read_text().split() == [str(n) for n in range(2000)]
    assert file.dropped == 0


def test_an_existing_file_is_continued(tmp_path: Path) -> None:
    for text in (b"a", b"b"):
        file = BackgroundFile(tmp_path / "log")
        file.append(text)
        file.close(PATIENCE_S)
    assert (tmp_path / "log").read_bytes() == b"ab"


def test_a_full_disk_is_counted_and_announced_once(caplog: pytest.LogCaptureFixture) -> None:
    file = BackgroundFile(Path("/dev/full"))
    with caplog.at_level(logging.WARNING, "companion.io"):
        for _ in range(50):
            file.append(b"record")
        file.close(PATIENCE_S)
    assert file.dropped == 50
    assert len(caplog.records) == 1


def test_a_disk_that_fills_up_keeps_whole_records_and_recovers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = [10]

    def write(fd: int, data: bytes) -> int:
        if room[0] == 0:
            raise OSError(28, "No space left on device")
        taken = data[: room[0]]
        room[0] -= len(taken)
        return real_write(fd, taken)

    real_write = os.write
    monkeypatch.setattr(os, "write", write)
    file = BackgroundFile(tmp_path / "log")
    for record in (b"aaaa", b"bbbb", b"cccc"):
        file.append(record)
    file.close(PATIENCE_S)
    written = (tmp_path / "log").read_bytes()
    assert len(written) % 4 == 0
    assert file.dropped == 3 - len(written) // 4
    assert file.dropped > 0


def test_a_hanging_disk_never_holds_up_the_caller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    real_write = os.write

    def hang(fd: int, data: bytes) -> int:
        released.wait(60.0)
        return real_write(fd, data)

    monkeypatch.setattr(os, "write", hang)
    monkeypatch.setattr(files, "MAX_QUEUED", 5)
    file = BackgroundFile(tmp_path / "log")
    for _ in range(5000):
        file.append(b"x")
    assert file.dropped >= 5000 - 5 - files.MAX_BATCH
    file.close(0.05)
    assert file.health.is_alive
    released.set()
    file.close(PATIENCE_S)


def test_a_record_after_the_end_is_counted(tmp_path: Path) -> None:
    file = BackgroundFile(tmp_path / "log")
    file.close(PATIENCE_S)
    file.close(PATIENCE_S)
    file.append(b"late")
    assert file.dropped == 1


def test_a_log_without_a_directory_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match="cannot be opened") as caught:
        BackgroundFile(tmp_path / "nowhere" / "log")
    assert "\n" not in str(caught.value)


def test_a_capped_file_keeps_the_newest_half_to_whole_of_its_cap(tmp_path: Path) -> None:
    file = BackgroundFile(tmp_path / "flight.tlog", max_bytes=1000)
    for number in range(1000):
        file.append(f"{number:09d}\n".encode())
    file.close(PATIENCE_S)
    older, newer = tmp_path / "flight.old.tlog", tmp_path / "flight.tlog"
    kept = (older.read_text() + newer.read_text()).split()
    assert kept == [f"{n:09d}" for n in range(1000 - len(kept), 1000)]
    assert 500 < 10 * len(kept) <= 1000
    assert file.dropped == 0
    assert file.health.bytes_kept == 10 * len(kept)


def test_an_existing_capped_file_counts_towards_its_cap(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"x" * 60)
    file = BackgroundFile(tmp_path / "log", max_bytes=100)
    file.append(b"new")
    file.close(PATIENCE_S)
    assert (tmp_path / "log").read_bytes() == b"new"
    assert (tmp_path / "log.old").read_bytes() == b"x" * 60


def test_a_record_larger_than_the_cap_is_lost_and_nothing_else(tmp_path: Path) -> None:
    file = BackgroundFile(tmp_path / "log", max_bytes=20)
    for record in (b"small", b"x" * 50, b"again"):
        file.append(record)
    file.close(PATIENCE_S)
    assert (tmp_path / "log.old").read_bytes() + (tmp_path / "log").read_bytes() == b"smallagain"
    assert file.dropped == 1


def test_a_part_that_cannot_be_put_aside_stays_within_the_cap(tmp_path: Path) -> None:
    (tmp_path / "log.old" / "in the way").mkdir(parents=True)
    file = BackgroundFile(tmp_path / "log", max_bytes=20)
    for _ in range(10):
        file.append(b"12345")
    file.close(PATIENCE_S)
    assert (tmp_path / "log").read_bytes() == b"12345" * 2
    assert file.dropped == 8


def test_a_writer_that_hangs_is_seen_from_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, began = threading.Event(), threading.Event()
    real_write = os.write

    def hang(fd: int, data: bytes) -> int:
        began.set()
        released.wait(60.0)
        return real_write(fd, data)

    monkeypatch.setattr(os, "write", hang)
    file = BackgroundFile(tmp_path / "log")
    assert file.health.silent_s == 0.0
    file.append(b"x")
    assert began.wait(PATIENCE_S)
    file.append(b"y")
    health = file.health
    assert health.silent_s > 0.0
    assert (health.queued, health.is_alive) == (1, True)
    released.set()
    file.close(PATIENCE_S)
    assert file.health.silent_s == 0.0
    assert not file.health.is_alive


def test_a_full_queue_ends_and_loses_nothing_of_what_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, began = threading.Event(), threading.Event()
    real_write = os.write

    def hang(fd: int, data: bytes) -> int:
        began.set()
        released.wait(60.0)
        return real_write(fd, data)

    monkeypatch.setattr(os, "write", hang)
    monkeypatch.setattr(files, "MAX_QUEUED", 3)
    file = BackgroundFile(tmp_path / "log")
    file.append(b"0")
    assert began.wait(PATIENCE_S)
    for record in (b"1", b"2", b"3"):
        file.append(record)
    file.finish()
    released.set()
    file.close(PATIENCE_S)
    assert not file.health.is_alive
    assert (tmp_path / "log").read_bytes() == b"0123"
    assert file.dropped == 0
