"""Prints the observed behaviour of real autopilots, and where the simulator differs, as tables.

`observed.yaml` next to each flavour has the rows, which `tests/contract/test_observed.py` plays.
"""

from __future__ import annotations

import argparse
import sys

from companion.entry import ignore_broken_pipe
from tests.contract.observed_rows import FLAVOURS, Sheet, load_sheet


def table(head: str, lines: list[tuple[str, str]]) -> str:
    """Return a table of two columns with one row per topic."""
    topics: dict[str, list[str]] = {}
    for topic, text in lines:
        topics.setdefault(topic, []).append(text)
    rows = [f"| {topic} | {' '.join(texts)} |" for topic, texts in topics.items()]
    return "\n".join([f"| | {head} |", "|---|---|", *rows])


def same(sheet: Sheet) -> str:
    """Return the table of behaviour that the simulator shares with the autopilot."""
    rows = [(row.topic, _sentence(row.real)) for row in sheet.rows if not row.deliberate]
    return f"{sheet.firmware}\n\n{table('what it does, and the simulator too', rows)}"


def different(sheet: Sheet) -> str:
    """Return the table of deliberate differences from an autopilot."""
    rows = [
        (row.topic, f"{_sentence(row.real)} Here: {_sentence(row.deliberate)}")
        for row in sheet.rows
        if row.deliberate
    ]
    head = f"{sheet.firmware}, and what the simulator does instead"
    return table(head, rows)


def _sentence(text: str) -> str:
    one_line = " ".join(text.split()).replace("|", "\\|")
    return one_line if one_line.endswith(".") else f"{one_line}."


def main() -> int:
    """Print common and differing behaviour of each autopilot and the simulator."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    sheets = [load_sheet(flavour) for flavour in FLAVOURS]
    texts = [text for sheet in sheets for text in (same(sheet), different(sheet))]
    sys.stdout.write("\n\n".join(texts) + "\n")
    return 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
