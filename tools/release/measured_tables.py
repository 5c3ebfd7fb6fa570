"""Writes the figures that were measured for a release into the pages.

    .venv/bin/python tools/release/measured_tables.py

Each table of PAGES stands in its page between two marks, and its figures are in `docs/measured`, as
the measuring tool wrote them. After a new measurement, copy the tool's JSON there and run this.
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

from companion.entry import ignore_broken_pipe

ROOT = Path(__file__).resolve().parents[2]
CLIENTS = {
    "native": "companion of the Debian package",
    "quiet": "the same with `link.stop_unread_streams: true`",
    "plain": "companion, kernels as plain Python",
    "warm": "companion, kernels compiled by `companion warm-up`",
    "mavsdk": "MAVSDK-Python 4, listening",
    "pymavlink": "pymavlink, listening",
}
"""Names of the clients of tools/bench_process.py."""

CAMPAIGN_PARTS = {
    "missions": (
        "{missions:,} missions, {mission_hours:.1f} h of flight",
        "{fence_breaches} breaches; nearest to a border {closest_approach_m:.2f} m",
    ),
    "override": ("{overrides:,} take-overs", "{override_late_frames} frames later than a tick"),
    "gaps": (
        "{hours_10_pct:g} h at each of 10, 30 and 50 % loss",
        "longest gap {max_gap_s_10_pct:.2f}, {max_gap_s_30_pct:.2f} and {max_gap_s_50_pct:.2f} s",
    ),
    "reaction": (
        "{cuts:,} cuts",
        "hold at most {hold_after_stale_s:.2f} s after the last position, link lost at most "
        "{link_lost_s:.2f} s after the last frame",
    ),
    "kill": (
        "{kills:,} kills, {damaged_checkpoints:,} damaged checkpoints",
        "a damaged one that is accepted, or a start that engages, is a finding",
    ),
    "stop": (
        "{stops:,} stops, {stops_in_control:,} of them in control",
        "hold at most {stop_hold_s:.2f} s later, exit at most {stop_exit_s:.2f} s later",
    ),
    "signal": (
        "{signals:,} signals to real processes",
        "hold confirmed after at most {signal_hold_s:.2f} s, gone after {signal_exit_s:.2f} s",
    ),
    "forged": (
        "{attack_frames:,} forged, replayed and unsigned frames",
        "a difference from the undisturbed flight is a finding; slowest frame "
        "{attack_slowest_frame_s:.4f} s",
    ),
    "fuzz": (
        "{fuzz_frames:,} random frames",
        "slowest frame {fuzz_slowest_frame_s:.4f} s, {fuzz_growth_mb:.0f} MB more",
    ),
    "clocks": (
        "{clock_flights:,} searches with slow, fast and slipping clocks",
        "error at most {clock_error_m:.2f} m, hold at most {clock_hold_s:.2f} s",
    ),
    "soak": (
        "{soak_hours:g} h of flight with a real journal",
        "memory grows by {soak_slope_mb_per_h:.3f} MB/h, log of {soak_log_bytes:,} bytes",
    ),
}
"""Titles of the parts of tools/faults.py: the flights and their figures."""


def process_rows(uses: list[Mapping[str, Any]]) -> list[str]:
    """Return the figures of `tools/bench_process.py --json` as a table."""
    lines = ["| | memory | processor, of one core |", "|---|---|---|"]
    return lines + [
        f"| {CLIENTS[use['client']]} | {use['resident_mb']:.0f} MB | {use['processor_pct']:.1f} % |"
        for use in uses
    ]


def campaign_rows(runs: list[Mapping[str, Any]]) -> list[str]:
    """Return several runs of `tools/faults.py --json` as a table each: a row for each part."""
    lines: list[str] = []
    for run in runs:
        command = f"--campaign {run['campaign']} --seed {run['seed']}"
        lines += [""] * bool(lines)
        lines += [f"| `{command}` | result | findings |", "|---|---|---|"]
        for part, (what, result) in CAMPAIGN_PARTS.items():
            try:
                row = f"| {what} | {result} |".format_map(run)
            except KeyError:
                continue  # this run was without that part
            found = sum(each["trial"].startswith(f"{part}:") for each in run["findings"])
            lines.append(f"{row} {found or 'none'} |")
    return lines


@dataclass(frozen=True, slots=True)
class Table:
    """A table, its page, and its form."""

    name: str
    page: Path
    rows_of: Callable[[Any], list[str]]

    def written(self, text: str) -> str:
        """Return the page's text with the table updated; a `ValueError` without marks."""
        figures = json.loads((ROOT / f"docs/measured/{self.name}.json").read_bytes())
        rows = "\n".join(self.rows_of(figures))
        begin, end = f"<!-- measured: {self.name} -->", "<!-- end of measured -->"
        marked = re.compile(f"{re.escape(begin)}\n.*?{re.escape(end)}", re.DOTALL)
        if not marked.search(text):
            raise ValueError(f"{self.page}: has no `{begin}`")
        return marked.sub(lambda _: f"{begin}\n\n{rows}\n\n{end}", text)


TABLES = (
    Table("process", ROOT / "docs/process.md", process_rows),
    Table("campaign", ROOT / "docs/reliability.md", campaign_rows),
)


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
    ignore_broken_pipe()
    sys.exit(main())
