"""Every hazard of docs/reliability.md names a test that exists."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[5]
ROW = re.compile(r"^\| ([A-I]\d+) \| (.+?) \| `(tests/\S+\.py)::(test_\w+)` \|$", re.M)
LEAST = {"A": 14, "B": 6, "C": 11, "D": 7, "E": 8, "F": 6, "G": 9, "H": 11, "I": 3}
PAGE = (ROOT / "docs/reliability.md").read_text(encoding="utf-8")
ROWS = ROW.findall(PAGE)


def test_every_hazard_has_its_row() -> None:
    names = [row[0] for row in ROWS]
    counts = Counter(name[0] for name in names)
    assert names == [f"{group}{n}" for group in LEAST for n in range(1, counts[group] + 1)]
    assert all(counts[group] >= least for group, least in LEAST.items())
    assert len(re.findall(r"^\| [A-I]\d+ \|(?:[^|]*\|){2}$", PAGE, re.M)) == len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_its_test_exists(row: tuple[str, str, str, str]) -> None:
    _, hazard, file, name = row
    assert hazard
    assert re.search(rf"def {name}\(", (ROOT / file).read_text(encoding="utf-8"))
