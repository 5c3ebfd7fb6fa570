"""Every hazard of tests/hazards.yaml names a test that exists."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[5]
LEAST = {"A": 14, "B": 6, "C": 11, "D": 7, "E": 8, "F": 6, "G": 9, "H": 11, "I": 3}
HAZARDS = yaml.safe_load((ROOT / "tests/hazards.yaml").read_text(encoding="utf-8"))


def test_hazards_are_numbered_within_their_group() -> None:
    counts = Counter(name[0] for name in HAZARDS)
    assert list(HAZARDS) == [f"{group}{n}" for group in LEAST for n in range(1, counts[group] + 1)]
    assert all(counts[group] >= least for group, least in LEAST.items())


@pytest.mark.parametrize("name", HAZARDS)
def test_its_test_exists(name: str) -> None:
    row = HAZARDS[name]
    assert row.keys() == {"hazard", "test"}
    assert row["hazard"]
    file, test = row["test"].split("::")
    assert re.search(rf"def {test}\(", (ROOT / file).read_text(encoding="utf-8"))
