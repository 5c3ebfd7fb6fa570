"""Every hazard of docs/reliability.md names a test that exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[5]
ROW = re.compile(r"^\| ([A-I]\d+) \| (.+?) \| (.+?) \| `(tests/\S+\.py)::(test_\w+)` \|$", re.M)
COUNTS = {"A": 14, "B": 6, "C": 11, "D": 7, "E": 8, "F": 6, "G": 9, "H": 11, "I": 3}
ROWS = ROW.findall((ROOT / "docs/reliability.md").read_text(encoding="utf-8"))


def test_every_hazard_has_its_row() -> None:
    expected = [f"{group}{n}" for group, count in COUNTS.items() for n in range(1, count + 1)]
    assert [row[0] for row in ROWS] == expected


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_its_test_exists(row: tuple[str, str, str, str, str]) -> None:
    _, hazard, reaction, file, name = row
    assert hazard
    assert reaction
    assert re.search(rf"def {name}\(", (ROOT / file).read_text(encoding="utf-8"))
