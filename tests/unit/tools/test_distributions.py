"""Both distributions of this repository: one version, one licence, each its own dependencies."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from companion import __version__
from tools.release.make_deb import debian_version

ROOT = Path(__file__).resolve().parents[3]
FLIGHT, LABORATORY = "companion-guidance", "companion-sim-link"


def project(folder: str) -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
    return table


def requirements(folder: str) -> list[str]:
    table = project(folder)
    extras: dict[str, list[str]] = table["optional-dependencies"]
    return [*table["dependencies"], *(text for extra in extras.values() for text in extra)]


@pytest.mark.parametrize(("folder", "name"), [("", FLIGHT), ("sim_link", LABORATORY)])
def test_both_have_the_version_that_the_commands_print(folder: str, name: str) -> None:
    table = project(folder)
    assert (table["name"], table["version"]) == (name, __version__)


@pytest.mark.parametrize(("folder", "other"), [("", LABORATORY), ("sim_link", FLIGHT)])
def test_each_asks_for_the_other_in_the_same_version(folder: str, other: str) -> None:
    asked = [text for text in requirements(folder) if text.startswith(other)]
    assert asked
    assert {re.sub(r"\[.*\]", "", text) for text in asked} == {f"{other}=={__version__}"}


def test_what_flies_asks_for_nothing_of_the_laboratory() -> None:
    names = {re.split(r"[^\w-]", text, maxsplit=1)[0] for text in project("")["dependencies"]}
    laboratory = {re.split(r"[^\w-]", text, maxsplit=1)[0] for text in requirements("sim_link")}
    assert LABORATORY not in names
    assert names & laboratory <= {"numpy", "msgspec", "pyyaml", "jinja2"}


def test_both_have_one_licence() -> None:
    assert (ROOT / "LICENSE").read_bytes() == (ROOT / "sim_link" / "LICENSE").read_bytes()


def test_the_changelog_tells_of_this_version_first() -> None:
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert next(each for each in headings if each != "Unreleased") == __version__


def test_pages_name_the_files_of_this_version() -> None:
    text = (ROOT / "docs/install.md").read_text() + (ROOT / "docs/versions.md").read_text()
    wheels = set(re.findall(r"companion_\w+-([^-]+)-py3", text))
    packages = set(re.findall(r"companion-guidance_([^_]+)_amd64", text))
    assert (wheels, packages) == ({__version__}, {debian_version(__version__)})
    assert f"now {__version__} |" in text
