"""Number of functions that a ranging datagram passes before it has moved the estimate.

    .venv/bin/python tools/trace_path.py [--list]

Flies the canonical search in lockstep, one process and no sockets, and traces with `sys.setprofile`
every datagram with a ranging measurement that arrives while the estimate is being made: from
`CompanionEndpoint.receive` until the tracker of its emitter has fused it. Prints the median and the
worst of a window of flight: distinct functions of `companion`, their files, calls. Comprehensions,
generator expressions and lambdas are part of their function.
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
from companion.guidance.session_params import SessionParams  # noqa: E402
from companion.mav.dialect import MAVLink_radio_ranging_message  # noqa: E402
from companion.mav.endpoint import Chunk  # noqa: E402
from companion.mav.framing import message_id  # noqa: E402
from sim_link.autopilot.scenario import Scenario  # noqa: E402
from sim_link.lab.lockstep.flight import Flight, MemoryJournal  # noqa: E402

PRODUCT = str(ROOT / "companion") + "/"
END = "TargetTracker.fuse"
"""When this returns its report, the measurement has moved the estimate, or was refused.

Between its steps it returns numbers, which is no end.
"""
FROM_S, DURATION_S = 22.0, 5.0
"""The canonical flight searches then, beyond its first crossing."""


@dataclass
class DatagramPath:
    """Functions that one datagram passed."""

    calls: Counter[tuple[str, str]] = field(default_factory=Counter)
    """By file and qualified name, in the order of the first call."""
    is_fused: bool = False

    @property
    def files(self) -> set[str]:
        """Return the files of the functions."""
        return {name for name, _ in self.calls}

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


def traced_paths() -> tuple[list[DatagramPath], int]:
    """Return the paths of ranging datagrams that were fused at once in a window of flight.

    And the number of others, which waited for a position or whose solution took longer.
    """
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    flight = Flight(config, Scenario(), 1, MemoryJournal())
    flight.run(FROM_S)
    paths: list[DatagramPath] = []
    later = 0
    receive = flight.companion.receive

    def traced(chunk: Chunk, now_s: float) -> None:
        nonlocal later
        if message_id(chunk.data) != MAVLink_radio_ranging_message.id:
            receive(chunk, now_s)
            return
        path = DatagramPath()
        sys.setprofile(path.profile)
        try:
            receive(chunk, now_s)
        finally:
            sys.setprofile(None)
        if path.is_fused:
            paths.append(path)
        else:
            later += 1

    endpoint: Any = flight.companion
    endpoint.receive = traced
    flight.run(DURATION_S)
    return paths, later


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="also the functions, in order")
    arguments = parser.parse_args()
    paths, later = traced_paths()
    if not paths:
        print(f"trace_path: none of {later} ranging datagrams was fused at once", file=sys.stderr)
        return 1
    paths.sort(key=lambda path: len(path.calls))
    middle = paths[len(paths) // 2]
    print(f"{len(paths)} ranging datagrams, from bytes to the fused estimate; {later} were later")
    print("| | functions | files | calls |\n|---|---|---|---|")
    median_calls = statistics.median(path.calls.total() for path in paths)
    print(f"| median | {len(middle.calls)} | {len(middle.files)} | {median_calls:.0f} |")
    worst = paths[-1]
    print(f"| most | {len(worst.calls)} | {len(worst.files)} | {worst.calls.total()} |")
    if arguments.list:
        for name, function in middle.calls:
            print(f"  {name:42} {function}")
    return 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
