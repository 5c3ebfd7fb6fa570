"""Standard output and error whose reader has gone away."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from companion.entry import outlive_readers


@contextmanager
def read_output(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The descriptor on which this process's standard output is read."""
    read_end, write_end = os.pipe()
    with os.fdopen(write_end, "w", encoding="ascii", errors="backslashreplace") as own:
        monkeypatch.setattr(sys, "stdout", own)
        monkeypatch.setattr(sys, "__stdout__", own)
        outlive_readers()
        yield read_end
        monkeypatch.undo()
    with suppress(OSError):
        os.close(read_end)


def test_what_is_read_arrives_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    with read_output(monkeypatch) as reader:
        sys.stdout.write("range \N{GREEK SMALL LETTER RHO}\n")
        sys.stdout.flush()
        assert os.read(reader, 100) == b"range \\u03c1\n"
        assert not sys.stdout.isatty()


def test_what_nobody_reads_is_dropped_and_nothing_is_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with read_output(monkeypatch) as reader:
        os.close(reader)
        sys.stdout.write("a line\n" * 10_000)
        sys.stdout.buffer.write(b"bytes")
        sys.stdout.flush()


def test_a_stream_that_somebody_put_in_its_place_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    other = io.StringIO()
    monkeypatch.setattr(sys, "stdout", other)
    outlive_readers()
    assert sys.stdout is other


def test_a_process_without_output_has_none_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    outlive_readers()
    assert sys.stdout is None
