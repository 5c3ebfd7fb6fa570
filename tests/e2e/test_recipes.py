"""The recipes of CONTRIBUTING.md, followed to the letter in a copy of the tree: each ends green.

The page says where, `recipe_steps` what: a step that touches a file which the page does not name
fails, as does a file that is named and left alone.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.recipe_edits import Command, Edit
from tests.e2e.recipe_steps import RECIPES, Recipe

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
COPIED = (
    "companion",
    "configs",
    "docs",
    "packaging",
    "sim_link",
    "tests",
    "tools",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "README.md",
    "SECURITY.md",
    "pyproject.toml",
)
LIMIT_S = 1800.0
"""Time limit of one command on a busy machine."""


def section_of(heading: str) -> str:
    """The text of a recipe, line breaks of its paragraphs undone."""
    found = re.search(rf"^### {re.escape(heading)}\n(.*?)(?=^##)", PAGE, re.DOTALL | re.MULTILINE)
    assert found, heading
    return re.sub(r"\n {3}(?=\S)", " ", found[1])


def steps_of(heading: str) -> dict[int, str]:
    """Return the numbered steps below a heading."""
    numbered = re.findall(r"^(\d+)\. (.*)$", section_of(heading), re.MULTILINE)
    return {int(number): text for number, text in numbered}


def runs_of(heading: str, name: str) -> list[list[str]]:
    """Return the tests that a recipe names, as arguments of pytest."""
    (paragraph,) = re.findall(r"^Run (.*?)(?:\n\n|\Z)", section_of(heading), re.DOTALL | re.M)
    codes = re.findall(r"`([^`]+)`", paragraph.replace("\n", " "))
    return [shlex.split(code.replace("NAME", name)) for code in codes]


def named_in(text: str, name: str) -> set[str]:
    """Every file and folder that a step names; one without a folder lies in the last one named."""
    found: set[str] = set()
    folder = ""
    for code in re.findall(r"`([^`\s]+)`|\]\(([^)#]+)", text):
        path = (code[0] or code[1]).replace("NAME", name)
        if "/" not in path and not re.search(r"\.(py|yaml|bin|jsonl|md)$", path):
            continue
        paths = [path] if "/" in path else [f"{folder}/{path}", f"{Path(folder).parent}/{path}"]
        there = [each for each in paths if (ROOT / each).exists()]
        path = (there or paths)[0]
        found.add(path)
        if (ROOT / path).is_dir():
            folder = path
    return found


def touched_by(step: object) -> str:
    assert isinstance(step, Edit | Command)
    return step.path if isinstance(step, Edit) else step.makes


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda each: str(each.heading))
def test_a_recipe_names_the_files_that_are_touched_and_no_others(recipe: Recipe) -> None:
    texts = steps_of(recipe.heading)
    assert texts.keys() == recipe.steps.keys()
    for number, edits in recipe.steps.items():
        named = named_in(texts[number], recipe.name) - recipe.mentions
        touched = {touched_by(edit) for edit in edits}
        for path in touched:
            assert any(path == each or path.startswith(f"{each}/") for each in named), path
        for named_path in named:
            assert any(
                path == named_path or path.startswith(f"{named_path}/") for path in touched
            ), named_path


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda each: str(each.heading))
def test_the_lines_that_a_recipe_edits_are_there(recipe: Recipe, tmp_path: Path) -> None:
    edits = [each for step in recipe.steps.values() for each in step if isinstance(each, Edit)]
    for path in {edit.path for edit in edits}:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / path).exists():
            shutil.copy2(ROOT / path, tmp_path / path)
    for edit in edits:
        edit.apply(tmp_path)


def test_there_is_a_specimen_for_every_recipe() -> None:
    part = PAGE.partition("\n## Recipes\n")[2].partition("\n## ")[0]
    assert re.findall(r"^### (.*)$", part, re.MULTILINE) == [each.heading for each in RECIPES]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The tree without what is made from it."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        elif (ROOT / name).exists():
            shutil.copy2(ROOT / name, tmp_path / name)
    return tmp_path


def python(root: Path, *words: str) -> str:
    """Return the output of the tests' interpreter, with the copy's packages before any others."""
    done = subprocess.run(
        [sys.executable, *words],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout[-6000:]}{done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda each: str(each.heading))
def test_a_recipe_followed_to_the_letter_ends_green(recipe: Recipe, copy: Path) -> None:
    for number in sorted(recipe.steps):
        for edit in recipe.steps[number]:
            if isinstance(edit, Edit):
                edit.apply(copy)
            else:
                python(copy, *edit.words)
    where = python(copy, "-c", "import companion, sim_link; print(companion.__file__)")
    assert Path(where.strip()).is_relative_to(copy)
    said = ""
    for words in runs_of(recipe.heading, recipe.name):
        said += python(copy, "-m", "pytest", "-v", "-p", "no:cacheprovider", *words)
    assert re.search(rf"[_\[-]{recipe.name}.* PASSED", said), "no test spoke of it"
