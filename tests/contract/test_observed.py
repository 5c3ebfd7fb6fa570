"""Every row that was observed on a real autopilot, played against its flavour."""

from __future__ import annotations

import pytest

from tests.contract.observed_player import Player
from tests.contract.observed_rows import FLAVOURS, ROOT, Row, load_sheet

GROUNDED = ("", "booting", "ready", "guided", "armed")
"""States of the sheets that take no flight; the others are slow."""
SHEETS = {flavour: load_sheet(flavour) for flavour in FLAVOURS}
CASES = [
    pytest.param(
        flavour,
        row,
        id=f"{flavour}-{row.id}",
        marks=[] if row.state in GROUNDED else [pytest.mark.slow],
    )
    for flavour, sheet in SHEETS.items()
    for row in sheet.rows
    if row.steps
]
PROVED = [
    pytest.param(row.proved_by, id=f"{flavour}-{row.id}")
    for flavour, sheet in SHEETS.items()
    for row in sheet.rows
    if row.proved_by
]


@pytest.mark.parametrize(("flavour", "row"), CASES)
def test_the_flavour_does_as_the_real_one(flavour: str, row: Row) -> None:
    Player(SHEETS[flavour], row, flavour).play()


@pytest.mark.parametrize("proof", PROVED)
def test_what_another_test_proves_has_that_test(proof: str) -> None:
    path, _, name = proof.partition("::")
    assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_every_row_has_a_name_of_its_own(flavour: str) -> None:
    names = [row.id for row in SHEETS[flavour].rows]
    assert sorted(names) == sorted(set(names))
