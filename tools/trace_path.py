"""Number of functions that a ranging datagram and a control tick pass.

    .venv/bin/python tools/trace_path.py [--list]

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
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from companion.config.schema import CompanionConfig  # noqa: E402
from companion.entry import ignore_broken_pipe  # noqa: E402
from companion.estimation.tracker import FusionReport  # noqa: E402
from companion.guidance.commands import SessionParams  # noqa: E402
from companion.mav.dialect import MAVLink_radio_ranging_message  # noqa: E402
from companion.mav.endpoint import Chunk  # noqa: E402
from companion.mav.framing import message_id  # noqa: E402
from sim_link.autopilot.scenario import Scenario  # noqa: E402
from sim_link.lab.lockstep import Flight, MemoryJournal  # noqa: E402

PRODUCT = str(ROOT / "companion") + "/"
END = "TargetTracker.fusion"
"""Function at whose report the path ends: the measurement has moved the estimate, or was refused.
Between its steps it returns numbers, which is no end.
"""
FROM_S, DURATION_S = 22.0, 5.0
"""The canonical flight searches then, beyond its first crossing."""


@dataclass
class TracedPath:
    """Functions that one datagram or one tick passed."""

    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Calls by file and qualified name, in the order of the first call."""
    is_fused: bool = False

    @property
    def files(self) -> set[str]:
        """Return the files of the functions."""
        return {name for name, _ in self.calls}

    def __enter__(self) -> None:
        """Begin to trace."""
        sys.setprofile(self.profile)

    def __exit__(self, *_: object) -> None:
        """End it."""
        sys.setprofile(None)

    def profile(self, frame: FrameType, event: str, argument: object) -> None:
        """Note a call, until the end; for `sys.setprofile`."""
        code = frame.f_code
        if self.is_fused or not code.co_filename.startswith(PRODUCT):
            return
        if event == "call":
            name = code.co_qualname.partition(".<locals>.<")[0]
            self.calls[code.co_filename.removeprefix(PRODUCT), name] += 1
        elif event == "return" and code.co_qualname == END and isinstance(argument, FusionReport):
            self.is_fused = True


@dataclass
class Traced:
    """Paths in a window of flight."""

    datagrams: list[TracedPath] = field(default_factory=list)
    """Paths of ranging datagrams that were fused at once."""
    later: int = 0
    """Number of others, which waited for a position or whose solution took longer."""
    ticks: list[TracedPath] = field(default_factory=list)


def traced_paths() -> Traced:
    """Fly, and trace the calls within the window."""
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    flight = Flight(config, Scenario(), 1, MemoryJournal())
    flight.run(FROM_S)
    endpoint: Any = flight.companion
    traced, receive, handle = Traced(), endpoint.receive, endpoint.handle_timer

    def traced_receive(chunk: Chunk, now_s: float) -> None:
        if message_id(chunk.data) != MAVLink_radio_ranging_message.id:
            receive(chunk, now_s)
            return
        path = TracedPath()
        with path:
            receive(chunk, now_s)
        if path.is_fused:
            traced.datagrams.append(path)
        else:
            traced.later += 1

    def traced_handle(now_s: float) -> None:
        path, ticks = TracedPath(), endpoint.ticks
        with path:
            handle(now_s)
        if endpoint.ticks > ticks:
            traced.ticks.append(path)

    endpoint.receive, endpoint.handle_timer = traced_receive, traced_handle
    flight.run(DURATION_S)
    return traced


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="also the functions, in order")
    arguments = parser.parse_args()
    traced = traced_paths()
    if not traced.datagrams:
        print(f"trace_path: none of {traced.later} ranging datagrams was fused", file=sys.stderr)
        return 1
    print(
        f"{len(traced.datagrams)} ranging datagrams, from bytes to the fused estimate; "
        f"{traced.later} were later"
    )
    print_table(traced.datagrams, has_list=arguments.list)
    print(f"{len(traced.ticks)} control ticks, to the bytes of the setpoint and what follows it")
    print_table(traced.ticks, has_list=arguments.list)
    return 0


def print_table(paths: list[TracedPath], *, has_list: bool) -> None:
    """Print the median and the longest path."""
    paths.sort(key=lambda path: len(path.calls))
    middle, worst = paths[len(paths) // 2], paths[-1]
    print("| | functions | files | calls |\n|---|---|---|---|")
    median_calls = statistics.median(path.calls.total() for path in paths)
    print(f"| median | {len(middle.calls)} | {len(middle.files)} | {median_calls:.0f} |")
    print(f"| most | {len(worst.calls)} | {len(worst.files)} | {worst.calls.total()} |")
    if has_list:
        for (name, function), calls in middle.calls.items():
            print(f"  {name:42} {function} {calls}")


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
