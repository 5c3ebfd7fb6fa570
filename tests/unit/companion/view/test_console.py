"""Lines for people that never hold up a flight."""

from __future__ import annotations

import io
import logging
import os
import time

import pytest

from companion.view import log_lines
from companion.view.log_lines import ConsoleHandler


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prolong the timeout for a writer on a busy machine."""
    monkeypatch.setattr(log_lines, "CLOSE_TIMEOUT_S", 30.0)


def logger_with(handler: logging.Handler) -> logging.Logger:
    logger = logging.Logger("test")
    logger.addHandler(handler)
    return logger


def test_lines_arrive_in_order() -> None:
    stream = io.StringIO()
    handler = ConsoleHandler(stream)
    logger = logger_with(handler)
    for number in range(100):
        logger.info("line %d", number)
    handler.close()
    assert stream.getvalue().splitlines() == [f"line {n}" for n in range(100)]


def test_a_pipe_that_is_not_read_blocks_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_lines, "MAX_QUEUED", 10)
    monkeypatch.setattr(log_lines, "CLOSE_TIMEOUT_S", 0.05)
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream:
        handler = ConsoleHandler(stream)
        logger = logger_with(handler)
        started_s = time.monotonic()
        for _ in range(200):
            logger.warning("x" * 1000)
        handler.close()
        assert time.monotonic() - started_s < 10.0
        assert handler.writer.dropped > 0
        heard = b""
        while heard.count(b"\n") < 200 - handler.writer.dropped:
            heard += os.read(reader, 65536)
    os.close(reader)


def test_lost_lines_are_reported_with_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_lines, "MAX_QUEUED", 2)
    stream = io.StringIO()
    handler = ConsoleHandler(stream)
    logger = logger_with(handler)
    handler.writer.overflowed = 3
    logger.info("here again")
    handler.close()
    assert stream.getvalue() == "(3 lines were lost here)\nhere again\n"


def test_a_reader_that_went_away_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        handler = ConsoleHandler(stream)
        logger_with(handler).info("to no reader")
        handler.close()
    assert handler.writer.dropped == 0
