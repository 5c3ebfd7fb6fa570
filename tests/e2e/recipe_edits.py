"""Edits and commands that make up the steps of recipes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Edit:
    """Text that goes behind the first match of a pattern; without a pattern, to the file's end."""

    path: str
    text: str
    behind: str = ""
    """A regular expression over lines; the file is made if there is none."""
    is_instead: bool = False
    """True if the text replaces the match."""

    def apply(self, root: Path) -> None:
        """Change the file below `root`; AssertionError: the lines are not there."""
        path = root / self.path
        before = path.read_text(encoding="utf-8") if path.exists() else ""
        begin = end = len(before)
        if self.behind:
            found = re.search(self.behind, before, re.MULTILINE)
            assert found, f"{self.path}: no lines like {self.behind}"
            begin, end = found.start() if self.is_instead else found.end(), found.end()
        path.write_text(before[:begin] + self.text + before[end:], encoding="utf-8", newline="")


@dataclass(frozen=True, slots=True)
class Command:
    """A command that a step names, run by the interpreter of the tests."""

    words: tuple[str, ...]
    makes: str
    """The file that it writes."""


Steps = Mapping[int, Sequence[Edit | Command]]
"""By the number of the step on the page. Optional steps that a specimen does not need are empty."""
