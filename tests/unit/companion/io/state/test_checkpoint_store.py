"""Two files in turn: one whole checkpoint survives whatever happens to the other."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from companion.io.checkpoints import CheckpointStore, encode_checkpoint, present_moment
from companion.io.files import write_bytes_atomic
from tests.unit.companion.io.state.test_checkpoint import a_checkpoint


def store_with(tmp_path: Path, *sequences: int) -> CheckpointStore:
    store = CheckpointStore(tmp_path / "state", "udp")
    for sequence in sequences:
        store.save(a_checkpoint(sequence=sequence))
        store.close(5.0)
        store = CheckpointStore(tmp_path / "state", "udp")
    return store


def loaded_sequence(store: CheckpointStore) -> int | None:
    checkpoint = store.load().checkpoint
    return None if checkpoint is None else checkpoint.sequence


def test_nothing_is_found_where_nothing_was(tmp_path: Path) -> None:
    found = CheckpointStore(tmp_path / "nowhere", "udp").load()
    assert (found.has_files, found.checkpoint, found.problems) == (False, None, ())


def test_the_newest_is_found_and_the_one_before_is_kept(tmp_path: Path) -> None:
    store = store_with(tmp_path, 3, 4, 5)
    assert loaded_sequence(store) == 5
    store.paths[1].unlink()
    assert loaded_sequence(store) == 4
    assert {stat.S_IMODE(path.stat().st_mode) for path in store.paths if path.exists()} == {0o600}


@pytest.mark.slow
def test_a_newest_one_cut_or_flipped_at_every_byte_leaves_the_one_before(tmp_path: Path) -> None:
    store = store_with(tmp_path, 4, 5)
    whole = encode_checkpoint(a_checkpoint(sequence=5))
    assert store.paths[1].read_bytes() == whole
    for index in range(len(whole)):
        store.paths[1].write_bytes(whole[:index])
        assert loaded_sequence(store) == 4
        flipped = bytearray(whole)
        flipped[index] ^= 0x10
        store.paths[1].write_bytes(bytes(flipped))
        found = store.load()
        assert found.checkpoint == a_checkpoint(sequence=4)
        assert len(found.problems) == 1


def test_without_any_whole_one_nothing_is_believed_and_each_is_reported(tmp_path: Path) -> None:
    store = store_with(tmp_path, 4, 5)
    store.paths[0].write_bytes(b"")
    store.paths[1].unlink()
    store.paths[1].mkdir()
    found = store.load()
    assert found.has_files
    assert found.checkpoint is None
    assert [problem.partition(": ")[2] for problem in found.problems] == [
        "0 bytes",
        "cannot be read (Is a directory)",
    ]


def test_what_a_killed_writer_left_is_swept_up(tmp_path: Path) -> None:
    store = store_with(tmp_path, 4)
    half = tmp_path / "state" / ".udp.checkpoint-0.99999999.tmp"
    half.write_bytes(b"half")
    other = tmp_path / "state" / ".tcp.checkpoint-0.99999999.tmp"
    other.write_bytes(b"another link's")
    assert loaded_sequence(store) == 4
    store.save(a_checkpoint(sequence=5))
    store.close(5.0)
    assert not half.exists()
    assert other.exists()


def test_a_mission_that_ended_in_order_leaves_nothing(tmp_path: Path) -> None:
    store = store_with(tmp_path, 4, 5)
    store.discard()
    store.discard()
    assert not store.load().has_files
    assert os.listdir(tmp_path / "state") == []


def test_a_checkpoint_that_a_slow_disk_takes_after_the_end_is_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    released, began = threading.Event(), threading.Event()

    def slow(path: Path, content: bytes, mode: int) -> None:
        began.set()
        released.wait(60.0)
        write_bytes_atomic(path, content, mode)

    monkeypatch.setattr("companion.io.files.write_bytes_atomic", slow)
    store = CheckpointStore(tmp_path / "state", "udp")
    store.save(a_checkpoint())
    assert began.wait(30.0)
    store.discard()
    store.close(0.01)
    released.set()
    store.close(30.0)
    assert store.writer is not None
    assert store.writer.written == 1
    assert os.listdir(tmp_path / "state") == []
    assert caplog.records == []


def test_a_state_directory_that_cannot_be_costs_the_checkpoint_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    store = CheckpointStore(tmp_path / "file" / "state", "udp")
    store.save(a_checkpoint())
    store.close(5.0)
    assert store.writer is not None
    assert store.writer.failed == 1
    found = store.load()
    assert found.checkpoint is None


def test_a_slow_disk_gets_the_newest_only(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, "udp")
    for sequence in range(200):
        store.save(a_checkpoint(sequence=sequence))
    store.close(10.0)
    assert loaded_sequence(store) == 199


def test_moments_of_one_kernel_follow_each_other() -> None:
    first, second = present_moment(), present_moment()
    assert first.boot_id == second.boot_id != ""
    assert second.boot_s >= first.boot_s


def test_a_pipe_is_written_to_and_stays_one(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_bytes_atomic(pipe, b"content")
    assert pipe.is_fifo()
    assert os.read(reader, 100) == b"content"
    os.close(reader)


def test_whole_bytes_replace_whole_bytes(tmp_path: Path) -> None:
    write_bytes_atomic(tmp_path / "a", b"1" * 100)
    write_bytes_atomic(tmp_path / "a", b"2", 0o600)
    assert (tmp_path / "a").read_bytes() == b"2"
