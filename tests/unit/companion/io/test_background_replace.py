"""Whole files replaced from a thread: the newest wins, no caller waits."""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path

import pytest

from companion.errors import CompanionError
from companion.io import files
from companion.io.files import BackgroundReplacer

PATIENCE_S = 30.0
"""Time limit of a writer on a busy machine; half the time for which a disk hangs."""


def test_a_file_holds_the_newest_content(tmp_path: Path) -> None:
    replacer = BackgroundReplacer("test")
    for number in range(100):
        replacer.replace(tmp_path / "state", str(number).encode())
    replacer.close(PATIENCE_S)
    assert (tmp_path / "state").read_bytes() == b"99"
    assert os.listdir(tmp_path) == ["state"]
    assert replacer.written + replacer.overtaken == 100


def test_a_hanging_disk_blocks_nothing_and_costs_only_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, began = threading.Event(), threading.Event()
    written: list[bytes] = []

    def hang(_path: Path, content: bytes, _mode: int) -> None:
        began.set()
        released.wait(60.0)
        written.append(content)

    monkeypatch.setattr(files, "write_bytes_atomic", hang)
    replacer = BackgroundReplacer("test")
    replacer.replace(tmp_path / "state", b"first")
    assert began.wait(PATIENCE_S)
    for number in range(1000):
        replacer.replace(tmp_path / "state", str(number).encode())
    assert replacer.health.silent_s > 0.0
    replacer.close(timeout_s=0.01)
    assert replacer.health.is_alive
    released.set()
    replacer.close(PATIENCE_S)
    assert written == [b"first", b"999"]
    assert replacer.overtaken == 999


def test_what_a_hanging_disk_may_lose_at_the_end_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    released, began = threading.Event(), threading.Event()

    def hang(_path: Path, _content: bytes, _mode: int) -> None:
        began.set()
        released.wait(60.0)

    monkeypatch.setattr(files, "write_bytes_atomic", hang)
    replacer = BackgroundReplacer("test")
    replacer.replace(tmp_path / "parameters.json", b"{}")
    assert began.wait(PATIENCE_S)
    with caplog.at_level(logging.WARNING, "companion.io"):
        assert not replacer.close(timeout_s=0.01)
    released.set()
    assert replacer.close(PATIENCE_S)
    assert [record.message for record in caplog.records] == [
        f"{tmp_path}/parameters.json: the disk hangs, its last content may be lost"
    ]


def test_a_full_disk_is_counted_reported_once_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    is_full = [True]
    done = threading.Event()

    def refuse(_path: Path, content: bytes, _mode: int) -> None:
        if is_full[0]:
            is_full[0] = content != b"2"
            raise CompanionError("state: cannot be written (No space left on device)")
        done.set()

    monkeypatch.setattr(files, "write_bytes_atomic", refuse)
    replacer = BackgroundReplacer("test")
    with caplog.at_level(logging.WARNING, "companion.io"):
        for content in (b"1", b"2", b"3"):
            replacer.replace(tmp_path / content.decode(), content)
        assert done.wait(PATIENCE_S)
        replacer.close(PATIENCE_S)
    assert (replacer.failed, replacer.written) == (2, 1)
    assert [record.message for record in caplog.records] == [
        "state: cannot be written (No space left on device)"
    ]


def test_what_comes_after_the_end_is_counted(tmp_path: Path) -> None:
    replacer = BackgroundReplacer("test")
    replacer.close(PATIENCE_S)
    replacer.close(PATIENCE_S)
    replacer.replace(tmp_path / "state", b"late")
    assert replacer.dropped == 1
    assert not replacer.health.is_alive
