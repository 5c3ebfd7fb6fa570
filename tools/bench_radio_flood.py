"""How late the control tick is while a radio floods, hangs or dribbles.

    .venv/bin/python tools/bench_radio_flood.py [--seconds 20] [--rounds 2]

Runs the companion's own loop and endpoint in this process, and a bad radio in another one, over TCP
on this machine: nothing at all, one that connects and hangs, one byte a second, 10 MB a second of
noise, of good lines, and of the worst for a decoder that looks for frames (all header). Prints the
lateness of the ticks and what of the stream was dropped. Rounds alternate, so that other work on
the machine spreads over all.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from companion.config.radios import RadioConfig  # noqa: E402
from companion.config.schema import CompanionConfig  # noqa: E402
from companion.entry import outlive_readers  # noqa: E402
from companion.flight_setup import build_endpoint, radio_links  # noqa: E402
from companion.guidance.commands import ReportResult, Severity  # noqa: E402
from companion.io.child_process import free_udp_port  # noqa: E402
from companion.io.links.transports import UdpBind  # noqa: E402
from companion.io.shell import Clock, Shell, TimerStatistics  # noqa: E402
from companion.link.interface import VEHICLE_ONLY  # noqa: E402
from companion.link.radio_stage import RadioStage  # noqa: E402
from sim_link.emulators.nlink import Node, NodeState, Peer, node_frame2  # noqa: E402

BYTES_PER_S = 10_000_000
KINDS: Mapping[str, tuple[str, str]] = {
    "nobody": ("nlink", "0"),
    "hangs": ("nlink", "hang"),
    "a byte a second": ("nlink", "drip"),
    "10 MB/s of noise, nlink": ("nlink", "noise"),
    "10 MB/s of headers, nlink": ("nlink", "header"),
    "10 MB/s of noise, ndjson": ("ndjson", "noise"),
    "10 MB/s of lines, ndjson": ("ndjson", "lines"),
}
"""What the radio does: by which decoder it is read, and the word for `bad_radio`."""


class Lateness(TimerStatistics):
    """Keeps every one."""

    def __init__(self) -> None:
        super().__init__()
        self.all_s: list[float] = []

    def note(self, late_s: float) -> None:
        """Take in how late it is now."""
        super().note(late_s)
        self.all_s.append(late_s)


class Mute:
    """A journal that keeps nothing."""

    def frame(self, data: bytes, now_s: float) -> None:
        """Nothing."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Nothing."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Nothing."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """Nothing."""


def bad_radio(port: int, word: str) -> None:
    """What the other process does until it is ended."""
    deadline_s = time.monotonic() + 10.0
    while True:
        try:
            stream = socket.create_connection(("127.0.0.1", port))
            break
        except OSError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.05)
    line = b'{"emitter_id":7,"range":42.5,"range_std":1.5,"line_of_sight":true}\n'
    pieces = {"noise": os.urandom(100_000), "header": b"\x55\x04" * 50_000, "lines": line * 1500}
    piece, pause_s = pieces.get(word, b"\x55"), 1.0
    if len(piece) > 1:
        pause_s = len(piece) / BYTES_PER_S
    due_s = time.monotonic()
    while True:
        if word != "hang":
            stream.sendall(piece)
        due_s = max(due_s + pause_s, time.monotonic() - 0.1)
        time.sleep(max(0.0, due_s - time.monotonic()))


@dataclass(frozen=True)
class Trial:
    """What one radio did to the companion."""

    late_s: list[float]
    """Of each tick."""
    read_bytes: int
    dropped: int
    """Pieces that were over the budget."""
    processor: float
    """Share of a core."""


def trial(decoder: str, word: str, seconds: float) -> Trial:
    """Run the companion beside one radio."""
    vehicle_port = free_udp_port()
    with socket.create_server(("127.0.0.1", 0)) as probe:
        radio_port = probe.getsockname()[1]
    radios = (RadioConfig(name=decoder, url=f"tcpin:127.0.0.1:{radio_port}"),)
    (link,) = radio_links(radios)
    endpoint = build_endpoint(CompanionConfig(radios=radios), Mute(), (*VEHICLE_ONLY, link.spec))
    shell = Shell(endpoint, [UdpBind("127.0.0.1", vehicle_port), link.transport], Clock())
    shell.timing = Lateness()
    radio = None
    if word != "0":
        command = [sys.executable, __file__, "--bad-radio", str(radio_port), word]
        radio = subprocess.Popen(command)

    async def run() -> None:
        asyncio.get_running_loop().call_later(seconds, shell.request_stop)
        await shell.run()

    began_s = time.process_time()
    try:
        asyncio.run(run())
    finally:
        if radio is not None:
            radio.kill()
            radio.wait()
    processor = (time.process_time() - began_s) / seconds
    assert isinstance(shell.timing, Lateness)
    stage = endpoint.radios[0].stage
    return Trial(shell.timing.all_s, stage.received, endpoint.dropped_unread, processor)


FRAMES, NODES, FRAME_HZ = 2_000, 8, 200


def decoding_share() -> float:
    """Processor time that a second of NLink frames takes, 200 of 8 nodes each; best of five."""
    frames = []
    for number in range(FRAMES):
        peers = [Peer(n, 20.0 + n + 0.001 * number, -80.0, -79.0) for n in range(NODES)]
        frames.append(node_frame2(Node(0, 5 * number, 5 * number), NodeState(), peers))
    (link,) = radio_links((RadioConfig(name="nlink", url="tcpin:127.0.0.1:9"),))
    assert link.spec.radio is not None
    best_s = math.inf
    for _ in range(5):
        stage = RadioStage(link.spec.radio)
        began_s = time.process_time()
        for number, frame in enumerate(frames):
            stage.receive(frame, number / FRAME_HZ)
        best_s = min(best_s, time.process_time() - began_s)
        assert stage.measured + stage.thinned == NODES * FRAMES
    return best_s * FRAME_HZ / FRAMES


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="of each, in a round")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--bad-radio", nargs=2, metavar=("PORT", "WORD"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.bad_radio is not None:
        bad_radio(int(arguments.bad_radio[0]), arguments.bad_radio[1])
    share = 100.0 * decoding_share()
    print(f"NLink, {FRAME_HZ} frames a second of {NODES} nodes: {share:.1f} % of a core\n")
    trials: dict[str, list[Trial]] = {name: [] for name in KINDS}
    for _ in range(arguments.rounds):
        for name, (decoder, word) in KINDS.items():
            trials[name].append(trial(decoder, word, arguments.seconds))
    print("| the radio | ticks | late, median ms | p99 ms | worst ms | core | kB read | dropped |")
    print("|---|---|---|---|---|---|---|---|")
    for name, found in trials.items():
        late_ms = [1e3 * late_s for each in found for late_s in each.late_s]
        processor = statistics.mean(each.processor for each in found)
        print(
            f"| {name} | {len(late_ms)} | {statistics.median(late_ms):.2f} "
            f"| {statistics.quantiles(late_ms, n=100)[98]:.2f} | {max(late_ms):.2f} "
            f"| {100 * processor:.1f} % | {sum(each.read_bytes for each in found) / 1e3:.0f} "
            f"| {sum(each.dropped for each in found)} |"
        )
    return 0


if __name__ == "__main__":
    outlive_readers()
    sys.exit(main())
