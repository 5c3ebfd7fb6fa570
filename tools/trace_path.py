"""Number of functions that a ranging datagram and a control tick pass.

    .venv/bin/python tools/trace_path.py

Flies the canonical search in lockstep, one process and no sockets, and traces with `sys.setprofile`
every datagram with a ranging measurement that arrives while the estimate is being made, from
`CompanionEndpoint.receive` until the tracker of its emitter has fused it, and every control tick,
from `CompanionEndpoint.handle_timer` to its end. Prints the median and the worst of a window of
flight: distinct functions of `companion`, their files, calls. Comprehensions, generator expressions
and lambdas are part of their function.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from companion.config.schema import CompanionConfig
from companion.entry import ignore_broken_pipe
from companion.estimation.tracker import FusionReport
from companion.guidance.commands import SessionParams
from companion.mav.codec import message_id
from companion.mav.dialect import MAVLink_radio_ranging_message
from companion.mav.endpoint import Chunk
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight, MemoryJournal

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = str(ROOT / "companion") + "/"
END = "TargetTracker.fusion"
"""Function at whose report the path ends: the measurement has moved the estimate, or was refused.
Between its steps it returns numbers, which is not the end.
"""
FROM_S, DURATION_S = 22.0, 5.0
"""The canonical flight searches then, beyond its first crossing."""


@dataclass
class TracedPath:
    """Functions that one datagram or one tick passed."""

    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Calls by file and qualified name."""
    is_fused: bool = False

    def trace(self, function: Callable[..., None], *arguments: object) -> None:
        """Call a function, and note the calls that it makes."""
        sys.setprofile(self.profile)
        try:
            function(*arguments)
        finally:
            sys.setprofile(None)

    def profile(self, frame: FrameType, event: str, argument: object) -> None:
        """Note a call, until the end; for `sys.setprofile`."""
        code = frame.f_code
        if self.is_fused or not code.co_filename.startswith(PRODUCT):
            return
        if event == "call":
            name = code.co_qualname.partition(".<locals>.<")[0]
            self.calls[code.co_filename, name] += 1
        elif event == "return" and code.co_qualname == END and isinstance(argument, FusionReport):
            self.is_fused = True


def traced_paths() -> tuple[list[TracedPath], list[TracedPath]]:
    """Fly; return the paths of ranging datagrams and of control ticks within the window."""
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    flight = Flight(config, Scenario(), 1, MemoryJournal())
    flight.run(FROM_S)
    endpoint: Any = flight.companion
    receive, handle = endpoint.receive, endpoint.handle_timer
    datagrams, ticks = list[TracedPath](), list[TracedPath]()

    def traced_receive(chunk: Chunk, now_s: float) -> None:
        """Receive a datagram, traced if it holds a range."""
        if message_id(chunk.data) != MAVLink_radio_ranging_message.id:
            receive(chunk, now_s)
            return
        datagrams.append(TracedPath())
        datagrams[-1].trace(receive, chunk, now_s)

    def traced_handle(now_s: float) -> None:
        """Handle the timer; keep the path if it was a control tick."""
        path, before = TracedPath(), endpoint.ticks
        path.trace(handle, now_s)
        if endpoint.ticks > before:
            ticks.append(path)

    endpoint.receive, endpoint.handle_timer = traced_receive, traced_handle
    flight.run(DURATION_S)
    return datagrams, ticks


def main() -> int:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    datagrams, ticks = traced_paths()
    fused = [path for path in datagrams if path.is_fused]
    later = len(datagrams) - len(fused)  # waited for a position, or their solution took longer
    if not fused:
        print(f"trace_path: none of {later} ranging datagrams was fused", file=sys.stderr)
        return 1
    print(
        f"{len(fused)} ranging datagrams, from bytes to the fused estimate; {later} were later",
        *table(fused),
        f"{len(ticks)} control ticks, to the bytes of the setpoint and what follows it",
        *table(ticks),
        sep="\n",
    )
    return 0


def table(paths: list[TracedPath]) -> list[str]:
    """Return the median and the longest path as a table."""
    paths.sort(key=lambda path: len(path.calls))
    middle, worst = paths[len(paths) // 2], paths[-1]
    median_calls = statistics.median(path.calls.total() for path in paths)
    lines = ["| | functions | files | calls |", "|---|---|---|---|"]
    for name, path, calls in (
        ("median", middle, median_calls),
        ("most", worst, worst.calls.total()),
    ):
        files = {file for file, _ in path.calls}
        lines.append(f"| {name} | {len(path.calls)} | {len(files)} | {calls:.0f} |")
    return lines


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
