"""The tree in docs/architecture.md against the folders and modules that there are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "architecture.md"
NAMES = re.compile(r"( *)((?:[\w/]+(?:/|\.py)(?: +|$))+)")
HIDDEN = {"__init__.py", "__main__.py"}


def named_paths() -> list[str]:
    """Every folder and module of the page's first block of code."""
    block = PAGE.read_text().split("```")[1]
    paths, parents = [], [(-1, "")]
    for line in block.strip("\n").splitlines():
        match = NAMES.match(line)
        assert match is not None, f"no name in: {line}"
        indent = len(match[1])
        while parents[-1][0] >= indent:
            parents.pop()
        below = parents[-1][1]
        names = match[2].split()
        paths += [below + name for name in names]
        parents.append((indent, below + names[-1]))
    return paths


def test_every_name_in_the_tree_exists_and_stands_there_once() -> None:
    paths = named_paths()
    assert [path for path in paths if not (ROOT / path).exists()] == []
    assert len(paths) == len(set(paths))


@pytest.mark.parametrize("package", ["companion", "sim_link"])
def test_every_folder_and_module_at_the_top_is_in_the_tree(package: str) -> None:
    there = {
        f"{package}/{path.name}/" for path in (ROOT / package).glob("*/") if any(path.glob("*.py"))
    }
    there |= {
        f"{package}/{path.name}"
        for path in (ROOT / package).glob("*.py")
        if path.name not in HIDDEN
    }
    assert there - set(named_paths()) == set()
