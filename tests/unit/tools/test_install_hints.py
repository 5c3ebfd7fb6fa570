"""Install hints of the programs can be followed: neither distribution is in a package index."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
SOURCES = [
    path for package in ("companion", "sim_link") for path in sorted((ROOT / package).rglob("*.py"))
]
PAGES = [ROOT / "README.md", ROOT / "sim_link/README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OURS = {"companion-guidance": ROOT, "companion-sim-link": ROOT / "sim_link"}


def extras_of(distribution: str) -> dict[str, list[str]]:
    project = tomllib.loads((OURS[distribution] / "pyproject.toml").read_text())["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    return extras


def test_an_extra_that_is_named_exists_and_needs_no_more_of_ours() -> None:
    for path in [*SOURCES, *PAGES]:
        for distribution, extra in re.findall(r"(companion-[a-z-]+)\[(\w+)\]", path.read_text()):
            needed = extras_of(distribution)[extra]
            unpublished = [text for text in needed if text.startswith(tuple(OURS))]
            assert unpublished == [], f"{path}: {distribution}[{extra}]"


def test_ours_is_never_asked_of_an_index() -> None:
    """An extra of what is installed is; `pip install companion-sim-link` is not."""
    command = re.compile(r"pipx? install (?:-\S+ )*['\"]?(companion-[a-z-]+)\b(?![\[-])")
    asked = [
        (path, m[0]) for path in [*SOURCES, *PAGES] for m in command.finditer(path.read_text())
    ]
    assert asked == []


def test_a_command_names_the_environment_that_lacks_the_package() -> None:
    build = ROOT / "sim_link/hatch_build.py"
    bare = [
        path for path in SOURCES if path != build and re.search(r"pipx? install", path.read_text())
    ]
    assert bare == []
