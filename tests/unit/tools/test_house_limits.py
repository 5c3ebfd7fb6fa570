"""Modules and folders stay small enough to read; a public class has one home."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = ("companion", "sim_link")
PYTHONS_OWN = {"__init__.py", "__main__.py"}
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MAX_MODULE_LINES = 500
MAX_FOLDER_FILES = 20
MAX_SAME_NAME = 3


def lines_of(path: Path) -> int:
    return path.read_text(encoding="utf-8").count("\n")


@pytest.mark.parametrize("package", PACKAGES)
def test_no_module_outgrows_its_room(package: str) -> None:
    sizes = {str(path.relative_to(ROOT)): lines_of(path) for path in (ROOT / package).rglob("*.py")}
    assert {name: n for name, n in sizes.items() if n > MAX_MODULE_LINES} == {}


def test_no_folder_has_more_files_than_one_can_see_at_once() -> None:
    folders = Counter(path.parent.relative_to(ROOT).as_posix() for path in MODULES)
    assert {name: n for name, n in folders.items() if n > MAX_FOLDER_FILES} == {}


def test_a_module_is_found_by_its_name() -> None:
    names = Counter(path.name for path in MODULES if path.name not in PYTHONS_OWN)
    assert {name: n for name, n in names.items() if n > MAX_SAME_NAME} == {}


def test_a_public_class_has_a_name_of_its_own() -> None:
    homes: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(path.relative_to(ROOT).as_posix())
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}
