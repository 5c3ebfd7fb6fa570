"""The terminal's screen, its thread, and the plain lines instead of it."""

from __future__ import annotations

import io
import logging
import os
import pty
import re
import time
from contextlib import suppress
from dataclasses import replace

import pytest
from rich.console import Console

from companion.config.schema import CompanionConfig
from companion.guidance.session import EmitterStatus
from companion.view.snapshot import FlightSnapshot, PlainView, flight_snapshot
from companion.view.terminal import TerminalView, screen
from tests.loop.loop_helpers import Loop


@pytest.fixture(scope="module")
def flown() -> Loop:
    loop = Loop(seed=1)
    loop.run(30.0)
    return loop


def shown(moment: FlightSnapshot, title: str = "companion") -> str:
    console = Console(file=io.StringIO(), width=100, force_terminal=False)
    with console.capture() as captured:
        console.print(screen(moment, title))
    return captured.get()


def test_the_screen_says_what_the_operator_asks(flown: Loop) -> None:
    text = shown(flight_snapshot(flown.companion, flown.now_s, 42.0))
    estimate = flown.companion.session.estimate
    assert estimate is not None
    assert flown.phase.value in text
    assert f"{estimate.r95_m:.2f} m" in text
    assert f"{estimate.absolute_r95_m:.2f} m  absolute (GNSS 0.02 m)" in text
    assert "about 42 s" in text
    assert "autopilot 0." in text
    assert re.search(r"ranging \d+\.\d s", text)
    assert max(len(line) for line in text.splitlines()) <= 78


def test_several_emitters_have_a_row_each(flown: Loop) -> None:
    moment = flight_snapshot(flown.companion, flown.now_s)
    estimate = moment.status.estimate
    emitters = (
        EmitterStatus(3, estimate, is_current=False, is_reported=True),
        EmitterStatus(9, None, is_current=True, is_reported=False),
    )
    text = shown(replace(moment, status=replace(moment.status, emitters=emitters)))
    assert "emitter 3" in text
    assert "reported" in text
    assert "emitter 9" in text


def test_it_draws_on_a_terminal_with_log_lines_above(flown: Loop) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as stream:
        view = TerminalView(stream)
        view.update(flown.companion, flown.now_s)
        view.stream.write("[bold red]a line[/] [link=http://evil.example]of the log[/link]\n")
        view.close()
        drawn = os.read(master, 1_000_000).decode(errors="ignore")
    os.close(master)
    assert "[bold red]a line[/] [link=http://evil.example]of the log[/link]" in drawn
    assert "R95" in drawn


def test_a_terminal_that_hangs_does_not_hold_up_the_flight(flown: Loop) -> None:
    """An unread pipe is full after 64 kB, like a terminal after Ctrl-S."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while os.write(writer, b"x" * 65_536):
            pass
    os.set_blocking(writer, True)
    with os.fdopen(writer, "w") as stream:
        view = TerminalView(stream)
        started_s = time.monotonic()
        for _ in range(50):
            view._next_wall_s = 0.0
            view.update(flown.companion, flown.now_s)
        took_s = time.monotonic() - started_s
        view.close()
        os.set_blocking(reader, False)
        while view._thread.is_alive():  # the pipe is read again: the thread can end
            with suppress(BlockingIOError):
                os.read(reader, 1_000_000)
    os.close(reader)
    assert took_s < 10.0


def test_a_flight_that_never_began_leaves_the_terminal_alone() -> None:
    stream = io.StringIO()
    view = TerminalView(stream)
    view.close()
    assert stream.getvalue() == ""


def test_plain_lines_come_now_and_then_and_only_in_flight(
    flown: Loop, caplog: pytest.LogCaptureFixture
) -> None:
    view = PlainView()
    with caplog.at_level(logging.INFO, "companion.view"):
        for tenth in range(300):
            view.update(flown.companion, flown.now_s + 0.1 * tenth)
        assert len(caplog.records) == 2
        assert re.search(r"R95 [\d.]+ m absolute, [\d.]+ m relative", caplog.records[0].message)
        waiting = Loop(CompanionConfig(), seed=1)
        waiting.run(1.0)
        PlainView().update(waiting.companion, waiting.now_s)
        assert len(caplog.records) == 2
