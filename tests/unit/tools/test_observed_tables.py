"""The tables of docs/simulator.md that come from the rows of the observed autopilots."""

from __future__ import annotations

import pytest

from tools.release.observed_tables import PAGE, Row, Step, renewed, table


def test_page_shows_the_rows_as_they_are() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == renewed(page), "run .venv/bin/python -m tools.release.observed_tables"


def test_one_topic_is_one_line() -> None:
    text = table("what", [("arming", "A."), ("modes", "B."), ("arming", "C.")])
    assert text.splitlines()[2:] == ["| arming | A. C. |", "| modes | B. |"]


def test_row_proves_something_or_says_why_not() -> None:
    for steps, deliberate in (((), ""), ((Step(),), "both")):
        with pytest.raises(ValueError, match="one of"):
            Row(id="r", topic="t", real="It flies.", steps=steps, deliberate=deliberate)
