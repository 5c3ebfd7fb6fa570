"""Every path, module and link that a page names is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
ROOTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "sim_link" / "README.md"]
PAGES = sorted([*ROOTS, *ROOT.glob("docs/**/*.md")])
FOLDERS = "companion|sim_link|tests|tools|configs|docs"
PATH = re.compile(rf"(?<![\w./-])(?:{FOLDERS})/[\w./*{{}},-]*")
FILE = re.compile(r"(?<![\w./*-])[A-Za-z][\w-]*(?:/[\w-]+)*\.(?:py|sh|toml)\b")
MODULE = re.compile(r"(?<![\w./-])(?:companion|sim_link)(?:\.[A-Za-z_]\w*)+")
IMPORT = re.compile(r"^from ((?:companion|sim_link)(?:\.\w+)+) import ([\w, ]+)$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
CONDITION = re.compile(r"\bcompanion\.\w+")
"""Conditions of missions that have names like modules."""
NO_PATHS = {"companion/doctor"}
"""Texts that only look like paths: alternatives."""
OF_OTHERS = {
    "test_own.py",
    "my_radio.py",
    "companion_acme.py",
    "test_companion_acme.py",
    "conftest.py",
    "test_search.py",
    "mavproxy.py",
    "sim_vehicle.py",
}
"""Files that a reader is to make, and programs of others."""
OF_SETUP = {"companion.yaml", "companion.service"}
"""Files that are called like modules."""


def has_path(text: str) -> bool:
    """Return True if a path exists, as a pattern with * or {a,b} or as it stands."""
    choice = re.search(r"\{([^}]*)\}", text)
    if choice is not None:
        parts = choice[1].split(",")
        return all(has_path(text[: choice.start()] + p + text[choice.end() :]) for p in parts)
    return any(ROOT.glob(text.rstrip("/."))) if "*" in text else (ROOT / text).exists()


def has_file(text: str) -> bool:
    """Return True if a path of the product, the tests or the tools ends with a text."""
    return (ROOT / text).exists() or any(
        path.match(text)
        for folder in FOLDERS.split("|")
        for path in (ROOT / folder).rglob(Path(text).name)
    )


def has_module(text: str) -> bool:
    """Return True if a text is a package, a module, or a name that a module defines."""
    *folders, last = text.split(".")
    if ROOT.joinpath(*folders, last).is_dir() or ROOT.joinpath(*folders, last + ".py").exists():
        return True
    module = ROOT.joinpath(*folders).with_suffix(".py")
    return module.exists() and re.search(rf"\b{last}\b", module.read_text()) is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_is_there(page: Path) -> None:
    text = page.read_text()
    if page.name == "missions.md":
        text = CONDITION.sub("", text)
    paths = {match.rstrip(".,") for match in PATH.findall(text)} - NO_PATHS
    missing = [path for path in paths if not has_path(path)]
    imported = {f"{module}.{n}" for module, ns in IMPORT.findall(text) for n in ns.split(", ")}
    missing += [name for name in imported if not has_module(name)]
    missing += [name for name in set(FILE.findall(text)) - OF_OTHERS if not has_file(name)]
    missing += [name for name in set(MODULE.findall(text)) - OF_SETUP if not has_module(name)]
    missing += [link for link in LINK.findall(text) if not (page.parent / link.strip()).exists()]
    assert sorted(set(missing)) == []
