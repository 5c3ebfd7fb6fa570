"""Writes the figures that were measured for a release into the pages.

    .venv/bin/python tools/measured_tables.py

Each table of PAGES stands in its page between two marks, and its figures are in `docs/measured`, as
the tool wrote them that measured. After measuring anew: copy the tool's JSON there, and run this.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CLIENTS = {
    "native": "companion of the Debian package",
    "quiet": "the same with `link.stop_unread_streams: true`",
    "plain": "companion, kernels as plain Python",
    "numba": "companion with numba",
    "mavsdk": "MAVSDK-Python 4, listening",
    "pymavlink": "pymavlink, listening",
}
"""Of tools/bench_process.py, in words."""


def process_rows(uses: list[Mapping[str, Any]]) -> list[str]:
    """What `tools/bench_process.py --json` has, as a table."""
    lines = ["| | memory | processor, of one core |", "|---|---|---|"]
    return lines + [
        f"| {CLIENTS[use['client']]} | {use['resident_mb']:.0f} MB | {use['processor_pct']:.1f} % |"
        for use in uses
    ]


@dataclass(frozen=True, slots=True)
class Table:
    """A table, the page where it stands, and its form."""

    name: str
    page: Path
    rows_of: Callable[[Any], list[str]]

    @property
    def figures(self) -> Path:
        """What was measured."""
        return ROOT / f"docs/measured/{self.name}.json"

    def written(self, text: str) -> str:
        """The page's text with the table as the figures have it; a `ValueError` without marks."""
        rows = "\n".join(self.rows_of(json.loads(self.figures.read_text(encoding="utf-8"))))
        begin, end = f"<!-- measured: {self.name} -->", "<!-- end of measured -->"
        marked = re.compile(f"{re.escape(begin)}\n.*?{re.escape(end)}", re.DOTALL)
        if not marked.search(text):
            raise ValueError(f"{self.page}: has no `{begin}`")
        return marked.sub(lambda _: f"{begin}\n\n{rows}\n\n{end}", text)


TABLES = (Table("process", ROOT / "docs/install.md", process_rows),)


def main() -> int:
    """Write every table."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    for table in TABLES:
        before = table.page.read_text(encoding="utf-8")
        after = table.written(before)
        table.page.write_text(after, encoding="utf-8")
        print(f"{table.page.relative_to(ROOT)}: {'as it was' if after == before else 'renewed'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
