"""A chore that fails ends itself and nothing else."""

from __future__ import annotations

import logging

import pytest

from companion.run import PeriodicTasks
from tests.unit.companion.process.rig import WatchedNotes, an_endpoint


def test_a_chore_that_raises_is_reported_once_and_not_done_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    done: list[str] = []

    def broken(_: float) -> None:
        done.append("broken")
        raise ZeroDivisionError

    notes = WatchedNotes()
    chores = PeriodicTasks(
        an_endpoint(notes), {"accounts": broken, "watchdog": lambda _: done.append("watchdog")}
    )
    with caplog.at_level(logging.ERROR, "companion.run"):
        for tick in range(3):
            chores.run(0.05 * tick)
    assert done == ["broken", "watchdog", "watchdog", "watchdog"]
    assert [text for _, text in notes.texts] == [
        "internal error: accounts ended; the flight continues"
    ]
    assert len(caplog.records) == 1
