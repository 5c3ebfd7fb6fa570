r"""Converts recorded walks of public data sets into the CSV that `companion replay` reads.

    .venv/bin/python tools/study/walks/public_walks.py librsf \
        Indoor_UWB_Input.txt Indoor_UWB_GT.txt uwb_1.csv
    .venv/bin/python tools/study/walks/public_walks.py rtt M1_13_mod.csv AP_idx.csv rtt_1.csv

Users fetch the raw files themselves, after reading their licence; none is part of this project. The
name of the CSV should begin with that of the preset's kind (`uwb`, `rtt`), by which
`tools/verify_estimation.py --only walks` finds the preset.

    librsf   text files of libRSF (TU Chemnitz; its indoor set is CC BY-SA 4.0): lines of `range2`,
             time (s), range (m), variance, anchor's x and y, its number; next to it the file with
             the truth, lines of `point2`, time, x, y
    rtt      tables of the Wi-Fi set of H. Yu (MIT): a row per scan, for every access point `APn RTT
             Distance (m)`, a time stamp in ms, and the position as `[x, y]`; next to it the table
             of access points, `,x,y`

Exit code 2: bad input, or a file that cannot be written.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.entry import ignore_broken_pipe
from companion.errors import CompanionError, ConfigError
from companion.io.files import read_file, write_text_atomic
from tools.console import OneLineParser

HEADER = "t_s,agent_x_m,agent_y_m,target_id,range_m,target_x_m,target_y_m"

Position = tuple[float, float]


class Answer(NamedTuple):
    """One range of a walk."""

    t_s: float
    agent_m: Position
    target_id: str
    range_m: float
    target_m: Position


def librsf_answers(raw: Path, truth: Path) -> Iterator[Answer]:
    """Yield ranges to each anchor, with the agent's position interpolated from the truth."""
    positions = np.array([numbers[:3] for numbers in _records(truth, "point2", 3)])
    if not len(positions):
        raise ConfigError(f"{truth}: no line begins with point2")
    for t_s, range_m, _, x, y, number in _records(raw, "range2", 6):
        east_m, north_m = (float(np.interp(t_s, positions[:, 0], positions[:, i])) for i in (1, 2))
        yield Answer(t_s, (east_m, north_m), f"U{number:.0f}", range_m, (x, y))


def _records(path: Path, kind: str, count: int) -> Iterator[list[float]]:
    """Yield the first numbers of every line of a kind."""
    for line, text in enumerate(_text(path).splitlines(), 1):
        name, *values = text.split() or [""]
        if name == kind:
            if len(values) < count:
                raise ConfigError(f"{path}: line {line}: {kind} needs {count} numbers")
            yield [_number(value, f"{path}: line {line}") for value in values[:count]]


def rtt_answers(raw: Path, anchors: Path) -> Iterator[Answer]:
    """Yield the measured ranges to each access point of every scan."""
    table = csv.DictReader(_text(anchors).splitlines())
    known = {row[""]: (_cell(row, "x", anchors), _cell(row, "y", anchors)) for row in table}
    for row in csv.DictReader(_text(raw).splitlines()):
        time_name = next((name for name in row if name.endswith("Time Stamp (ms)")), "Time Stamp")
        truth_name = next((name for name in row if name.endswith("Ground Truth")), "Ground Truth")
        t_s = 1e-3 * _cell(row, time_name, raw)
        x, _, y = (row.get(truth_name) or "").strip("[] ").partition(",")
        agent_m = (_number(x, f"{raw}: {truth_name}"), _number(y, f"{raw}: {truth_name}"))
        for target_id, target_m in known.items():
            text = row.get(f"{target_id} RTT Distance (m)") or "nan"
            range_m = _number(text, f"{raw}: {target_id}")
            if range_m > 0.0:
                yield Answer(t_s, agent_m, target_id, range_m, target_m)


def _cell(row: dict[str, str], name: str, path: Path) -> float:
    return _number(row.get(name) or "", f"{path}: {name}")


def _number(text: str, source: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{source}: not a number: `{text}`") from None


def _text(path: Path) -> str:
    return read_file(path).decode("utf-8-sig", errors="replace")


FORMATS: dict[str, tuple[Callable[[Path, Path], Iterator[Answer]], str]] = {
    "librsf": (librsf_answers, "uwb"),
    "rtt": (rtt_answers, "wifi_rtt"),
}
"""Reader of each format, and its preset."""


def walk_csv(answers: Iterator[Answer]) -> str:
    """Return answers in the order of their times, which begin at 0, as a walk's CSV."""
    ordered = sorted(answers, key=lambda answer: answer.t_s)
    if not ordered:
        raise ConfigError("no range in it")
    rows = [
        f"{t - ordered[0].t_s:.3f},{ax:.4f},{ay:.4f},{name},{range_m:.4f},{x:.4f},{y:.4f}"
        for t, (ax, ay), name, range_m, (x, y) in ordered
        if math.isfinite(ax + ay + range_m)
    ]
    return "\n".join([HEADER, *rows, ""])


def main() -> int:
    """Convert a walk, and print the command that replays it; return the exit code."""
    parser = OneLineParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("format", choices=FORMATS)
    parser.add_argument("raw", type=Path, help="what was measured")
    parser.add_argument("beside", type=Path, help="librsf: the truth; rtt: the access points")
    parser.add_argument("out", type=Path, help="the CSV to write")
    arguments: argparse.Namespace = parser.parse_args()
    read, preset = FORMATS[arguments.format]
    try:
        text = walk_csv(read(arguments.raw, arguments.beside))
        write_text_atomic(arguments.out, text)
    except CompanionError as error:
        print(f"public_walks: {error}", file=sys.stderr)
        return 2
    print(f"companion replay {arguments.out} --config configs/companion/{preset}.yaml")
    return 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
