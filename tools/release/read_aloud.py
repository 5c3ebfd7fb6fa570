"""Print a random sample of docstrings and operator texts to read aloud, or check their wording.

    .venv/bin/python tools/release/read_aloud.py [--seed 7]    # 60 docstrings and 40 operator texts
    .venv/bin/python tools/release/read_aloud.py --check       # exit code 1 if a limit is exceeded

The check counts docstrings that begin with a wh-word, or describe an argument with one, those of
attributes and tests included, and lines with words that this project keeps out of code and pages.
That nothing public is without a docstring is a rule of ruff.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from companion.entry import ignore_broken_pipe

ROOT = Path(__file__).parents[2]
PACKAGES = ("companion", "sim_link", "tools")
TEXTS = (*PACKAGES, "configs", "docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")
WH_CLAUSE = re.compile(r"(^|\n +\w+: )(Wh(at|ether|om?|ose|ere|en|ich|y)|How)(ever)?\b")
WORDS = re.compile(r"\b(told|tells?|anew|whoever|(no|any|some)body|somewhen|in words)\b", re.I)
LIMITS = {"wh-clauses": 0, "words": 20}
SUFFIXES = {".py", ".yaml", ".md", ".toml", ".html", ".js"}


class Docstring(NamedTuple):
    """Docstring of a module, class, function, attribute or constant."""

    location: str
    name: str
    text: str


def files_of(*paths: str) -> list[Path]:
    """Return the files below these paths that git tracks."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z", "--", *paths]
    listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def docstrings(*packages: str) -> Iterator[Docstring]:
    """Yield the docstrings in these folders: every text that is a statement."""
    for path in files_of(*packages):
        if path.suffix == ".py":
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                body = getattr(node, "body", None)
                statements = body if isinstance(body, list) else []
                for index, each in enumerate(statements):
                    if (
                        isinstance(each, ast.Expr)
                        and isinstance(each.value, ast.Constant)
                        and isinstance(each.value.value, str)
                    ):
                        location = f"{path.relative_to(ROOT)}:{each.lineno}"
                        name = _name_of(statements[index - 1] if index else node)
                        yield Docstring(location, name, inspect.cleandoc(each.value.value))


def _name_of(node: ast.AST) -> str:
    """Return the name that a reader sees above a docstring; empty: a module."""
    if isinstance(node, ast.Assign | ast.AnnAssign):
        return ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
    return str(getattr(node, "name", ""))


def operator_texts() -> list[str]:
    """Return the rows of the lists of operator messages: cause, text and action."""
    pages = [
        (ROOT / f"docs/{name}.md").read_text(encoding="utf-8") for name in ("messages", "safety")
    ]
    return [row for page in pages for row in re.findall(r"^\| (.*`.+) \|$", page, re.MULTILINE)]


def findings() -> dict[str, list[str]]:
    """Return the lines that the check counts, with their positions."""
    return {
        "wh-clauses": [
            f"{each.location}: {each.text.splitlines()[0]}"
            for each in docstrings(*PACKAGES, "tests")
            if WH_CLAUSE.search(each.text)
        ],
        "words": [
            f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
            for path in files_of(*TEXTS)
            if path != Path(__file__) and path.suffix in SUFFIXES
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
            if WORDS.search(line)
        ],
    }


def main() -> int:
    """Print the sample, or the findings of the check."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument("--check", action="store_true", help="count, and exit with 1 over a limit")
    options = parser.parse_args()
    if options.check:
        found = findings()
        for kind, lines in found.items():
            print(f"{kind}: {len(lines)}, at most {LIMITS[kind]}", *lines, sep="\n  ")
        return int(any(len(lines) > LIMITS[kind] for kind, lines in found.items()))
    draw = random.Random(options.seed)
    for each in draw.sample(list(docstrings(*PACKAGES)), 60):
        print(f"{each.location} {each.name}\n    " + each.text.replace("\n", "\n    "))
    print(*draw.sample(operator_texts(), 40), sep="\n")
    return 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
