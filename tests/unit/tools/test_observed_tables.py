"""The tables of the observed autopilots."""

from __future__ import annotations

import pytest

from tests.contract.observed_rows import FLAVOURS, Row, Step, load_sheet
from tests.contract.observed_tables import different, same, table


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_every_row_is_in_the_one_table_or_the_other(flavour: str) -> None:
    sheet = load_sheet(flavour)
    for row in sheet.rows:
        text = " ".join(row.real.split()).replace("|", "\\|")
        assert (text in different(sheet)) == bool(row.deliberate)
        assert (text in same(sheet)) != bool(row.deliberate)


def test_one_topic_is_one_line() -> None:
    text = table("what", [("arming", "A."), ("modes", "B."), ("arming", "C.")])
    assert text.splitlines()[2:] == ["| arming | A. C. |", "| modes | B. |"]


def test_row_proves_something_or_says_why_not() -> None:
    for steps, deliberate in (((), ""), ((Step(),), "both")):
        with pytest.raises(ValueError, match="one of"):
            Row(id="r", topic="t", real="It flies.", steps=steps, deliberate=deliberate)
