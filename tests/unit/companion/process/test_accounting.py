"""Counts of the resources that the process holds."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from companion import diagnostics
from companion.diagnostics import process_use


def test_descriptors_and_threads_are_counted() -> None:
    before = process_use()
    reader, writer = os.pipe()
    released = threading.Event()
    thread = threading.Thread(target=released.wait)
    thread.start()
    after = process_use()
    released.set()
    thread.join()
    os.close(reader)
    os.close(writer)
    assert before.descriptors is not None
    assert after.descriptors == before.descriptors + 2
    assert after.threads == before.threads + 1
    assert process_use().descriptors == before.descriptors


def test_memory_that_is_used_is_seen() -> None:
    before_mb = process_use().resident_mb
    block = bytearray(os.urandom(1)) * 50_000_000
    assert process_use().resident_mb > before_mb + 40.0
    assert len(block) == 50_000_000


def test_a_system_without_proc_tells_the_peak(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "_STATM", Path("/nowhere/statm"))
    use = process_use()
    assert use.descriptors is None
    assert use.resident_mb > 10.0
