"""Effect of ten browsers on the live map, one stalled, on the control tick and the memory.

    .venv/bin/python tools/benches/measure_live_map.py [--rounds 6] [--seconds 10] [--browsers 10]
                                               [--minutes 60] [--json FILE]

First the simulator flies in real time, alternately without the map and with it and all browsers, in
many rounds, so that other load on the machine falls on both. The figure is the median over the
rounds of the change in the 99th percentile of the ticks' lateness. Then a flight of an hour, on
invented time and as fast as it goes, is watched by the same browsers, and the memory of the
flight's and of the page's process is fitted by a line after the first quarter.

A browser here does what the server sees of one: it loads the page and receives every update over
its socket; the stalled one stops reading. Exit code 1 if the percentile changes by 5 ms or more, or
if memory grows by more than 5 MB an hour.
"""

from __future__ import annotations

import os

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # as on a vehicle

import argparse
import asyncio
import json
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.entry import ignore_broken_pipe
from companion.flight_setup import build_endpoint
from companion.guidance.session_params import SessionParams
from companion.io.child_process import free_udp_port
from companion.io.links.transports import UdpBind
from companion.io.logs.flight_recorder import FlightJournal
from companion.io.shell import Clock, Shell, TimerStatistics
from companion.run import ViewedJournal
from companion.web.live_map import WebView
from companion.web.settings import web_settings
from sim_link.autopilot.scenario import BatteryParams, Scenario
from sim_link.lab.lockstep.flight import Flight

MOST_MS = 5.0
SETTLE_S = 3.0
"""After each change, not measured."""
MOST_MB_PER_H = 5.0
SETTLED = 0.25
"""Share of the hour that is not fitted: pools and caches fill first."""
STEP_S = 0.05
SAMPLE_S = 60.0
CONFIG = CompanionConfig(
    mission=SessionParams(
        engage="auto", stop_confirm_s=1e6, battery_low_pct=0.0, battery_critical_pct=0.0
    ),
    limits=LimitsConfig(battery_pct_per_km=None),
)
"""The flight never ends by itself."""
ENDLESS = Scenario(battery=BatteryParams(endurance_s=1e6))


class Lateness(TimerStatistics):
    """Records the lateness of every tick."""

    def __init__(self) -> None:
        super().__init__()
        self.late_s: list[float] = []

    def note(self, late_s: float) -> None:
        """Record the lateness of a tick."""
        super().note(late_s)
        self.late_s.append(late_s)


class MeasuredFlight:
    """Flight whose map can be switched on and off."""

    def __init__(self, port: int, directory: Path, web_port: int) -> None:
        self.settings = web_settings(str(web_port))
        self.view = WebView(self.settings, CONFIG)
        journal = FlightJournal(directory, time.time())
        self._journal = journal
        heard = ViewedJournal(journal, [self.view])
        self.endpoint = build_endpoint(CONFIG, heard, recorder=journal.inputs)
        self.shell = Shell(self.endpoint, [UdpBind("127.0.0.1", port)], Clock(1.0), self._update)
        self.timing = Lateness()
        self.shell.timing = self.timing
        self.has_map = False
        self._thread = threading.Thread(target=self.shell.run_blocking, daemon=True)

    def _update(self, now_s: float) -> None:
        if self.has_map:
            self.view.update(self.endpoint, now_s)

    def start(self) -> None:
        """Fly, in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """End flight and page."""
        self.shell.request_stop()
        self._thread.join(10.0)
        self.view.close()
        self._journal.close(5.0)


def resident_mb(process: int) -> float:
    """Return the resident memory of a process in MB (Linux)."""
    pages = Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


async def browse(url: str, *, is_stalled: bool) -> None:
    """Simulate one browser until it is cancelled."""
    html = await asyncio.to_thread(lambda: urllib.request.urlopen(url).read().decode())
    found = re.search(r"client_id\\?[\"']: ?\\?[\"']([0-9a-f-]+)", html)
    if found is None:
        raise SystemExit("the page has no client id: another version of NiceGUI?")
    query = {
        "EIO": 4,
        "transport": "websocket",
        "client_id": found.group(1),
        "tab_id": str(uuid.uuid4()),
        "document_id": str(uuid.uuid4()),
        "next_message_id": 0,
        "implicit_handshake": "true",
    }
    base = url.replace("http://", "ws://")
    address = f"{base}_nicegui_ws/socket.io/?{urlencode(query)}"
    async with connect(address, max_size=None, ping_interval=None) as page:
        await page.recv()
        await page.send("40")
        updates = 0
        while True:
            message = await page.recv()
            if message == "2":
                await page.send("3")
            updates += 1
            if updates == 10:
                print(json.dumps({"up": 1}), flush=True)
                if is_stalled:
                    await asyncio.sleep(3600.0)


async def browse_all(url: str, count: int) -> None:
    """Simulate all browsers; the last one stalls."""
    async with asyncio.TaskGroup() as group:
        for number in range(count):
            group.create_task(_browse(url, is_stalled=number == count - 1))


async def _browse(url: str, *, is_stalled: bool) -> None:
    with suppress(ConnectionClosed):  # the server closed the stalled one
        await browse(url, is_stalled=is_stalled)


@contextmanager
def browsers(url: str, count: int, meanwhile: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Run browsers in a process of their own, once every one of them receives updates.

    Args:
        url: Address of the page.
        count: Number of browsers.
        meanwhile: Called until they are connected.
    """
    command = [sys.executable, __file__, "--browse", url, "--browsers", str(count)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            up: list[str] = []
            reader = threading.Thread(target=lambda: up.extend(process.stdout or ()), daemon=True)
            reader.start()
            while len(up) < count:
                if process.poll() is not None:
                    raise SystemExit("a browser did not get the page")
                meanwhile()
                time.sleep(0.01)
            yield
        finally:
            process.kill()


def measure(flight: MeasuredFlight, seconds: float) -> list[float]:
    """Return the lateness of the ticks of a while, milliseconds."""
    time.sleep(SETTLE_S)
    first = len(flight.timing.late_s)
    time.sleep(seconds)
    return [1e3 * late_s for late_s in flight.timing.late_s[first:]]


@dataclass(frozen=True, slots=True)
class Turn:
    """Lateness of the ticks of one turn, milliseconds."""

    ticks: int
    p50_ms: float
    p99_ms: float
    worst_ms: float


def turn_of(late_ms: list[float]) -> Turn:
    """Return a turn's figures from the lateness of each tick."""
    p50, p99 = np.percentile(late_ms, [50, 99])
    return Turn(len(late_ms), float(p50), float(p99), max(late_ms))


def take_turns(
    flight: MeasuredFlight, rounds: int, seconds: float, count: int
) -> list[tuple[Turn, Turn]]:
    """Alternate between turns without the map and with it; every other round is reversed."""

    def without() -> Turn:
        """Take a turn without the map."""
        flight.has_map = False
        return turn_of(measure(flight, seconds))

    def watched() -> Turn:
        """Take a turn with browsers that load it."""
        flight.has_map = True
        with browsers(flight.settings.url, count):
            return turn_of(measure(flight, seconds))

    found: list[tuple[Turn, Turn]] = []
    for number in range(rounds):
        if number % 2 == 0:
            first = without()
            found.append((first, watched()))
        else:
            last = watched()
            found.append((without(), last))
    return found


def measure_ticks(
    rounds: int, seconds: float, count: int, web_port: int
) -> list[tuple[Turn, Turn]]:
    """Measure turns without and with the map, on the simulator in real time."""
    port, listen = free_udp_port(), free_udp_port()
    command = [sys.executable, "-m", "sim_link", "--listen", f"127.0.0.1:{listen}"]
    command += ["--send-to", f"127.0.0.1:{port}"]
    with (
        tempfile.TemporaryDirectory() as directory,
        subprocess.Popen(command, stdout=subprocess.DEVNULL) as simulator,
    ):
        flight = MeasuredFlight(port, Path(directory), web_port)
        flight.start()
        try:
            time.sleep(15.0)  # take-off, and the page's process is up
            flight.has_map = True
            time.sleep(SETTLE_S)
            return take_turns(flight, rounds, seconds, count)
        finally:
            flight.stop()
            simulator.terminate()


Memory = tuple[float, float, float]
"""Time in minutes, memory of the flight's process and of the page's in MB."""


def measure_memory(minutes: float, count: int, web_port: int) -> list[Memory]:
    """Measure memory over a long flight on invented time, with all browsers on its map."""
    settings = web_settings(str(web_port))
    view = WebView(settings, CONFIG)
    with tempfile.TemporaryDirectory() as directory:
        journal = FlightJournal(Path(directory), time.time())
        flight = Flight(CONFIG, ENDLESS, 1, ViewedJournal(journal, [view]))

        def fly_to(until_s: float) -> None:
            """Fly on, and show it."""
            while flight.now_s < until_s:
                flight.run(STEP_S)
                view.update(flight.companion, flight.now_s)

        try:
            fly_to(SETTLE_S)
            with browsers(settings.url, count, lambda: fly_to(flight.now_s + 1.0)):
                samples: list[Memory] = []
                while flight.now_s < 60.0 * minutes:
                    fly_to(flight.now_s + SAMPLE_S)
                    mb = (resident_mb(os.getpid()), resident_mb(view.process.process_id))
                    samples.append((flight.now_s / 60.0, *mb))
                return samples
        finally:
            view.close()
            journal.close(5.0)


def growth_mb_per_h(samples: list[Memory], column: int) -> float:
    """Return the slope of a line through the samples after the first quarter."""
    from_min = SETTLED * samples[-1][0]
    rows = np.array([sample for sample in samples if sample[0] >= from_min])
    return float(np.polyfit(rows[:, 0] / 60.0, rows[:, column], 1)[0])


def print_ticks(turns: list[tuple[Turn, Turn]], count: int) -> bool:
    """Print the turns; return True if the limit on ticks is kept."""
    print(f"{'lateness of ticks, ms':<26} {'ticks':>6} {'p50':>8} {'p99':>8} {'worst':>8}")
    for number, pair in enumerate(turns, start=1):
        for name, t in zip(("without", f"{count} browsers"), pair, strict=True):
            figures = f"{t.ticks:>6} {t.p50_ms:>8.2f} {t.p99_ms:>8.2f} {t.worst_ms:>8.2f}"
            print(f"{f'round {number}, {name}':<26} {figures}")
    change_ms = p99_change_ms(turns)
    is_kept = change_ms < MOST_MS
    word = "MET" if is_kept else "NOT MET"
    print(
        f"{word}: p99 changes by {change_ms:+.2f} ms, median of {len(turns)} rounds, "
        f"{count} browsers, one stalled (below {MOST_MS:g} ms)"
    )
    return is_kept


def p99_change_ms(turns: list[tuple[Turn, Turn]]) -> float:
    """Return the median over the rounds of the change in the 99th percentile, ms."""
    return float(np.median([watched.p99_ms - alone.p99_ms for alone, watched in turns]))


def print_memory(samples: list[Memory]) -> bool:
    """Print the growth of memory; return True if it is flat."""
    print(f"{'minute of flight':<18} {'flight, MB':>12} {'page, MB':>12}")
    for minute, flight_mb, page_mb in samples[:: max(1, len(samples) // 12)]:
        print(f"{minute:<18.0f} {flight_mb:>12.1f} {page_mb:>12.1f}")
    growths = [growth_mb_per_h(samples, column) for column in (1, 2)]
    is_flat = max(growths) < MOST_MB_PER_H
    word = "MET" if is_flat else "NOT MET"
    print(
        f"{word}: after the first quarter of {samples[-1][0]:.0f} minutes the flight grows by "
        f"{growths[0]:+.1f} MB an hour, the page by {growths[1]:+.1f} (below {MOST_MB_PER_H:g})"
    )
    return is_flat


def run(arguments: argparse.Namespace) -> int:
    """Take all turns and the long flight; return the exit code."""
    count = arguments.browsers
    result: dict[str, object] = {"browsers": count, "cores": os.cpu_count()}
    is_good = True
    if arguments.rounds:
        turns = measure_ticks(arguments.rounds, arguments.seconds, count, arguments.port)
        is_good &= print_ticks(turns, count)
        result["p99_change_ms"] = p99_change_ms(turns)
        result["turns"] = [[asdict(turn) for turn in pair] for pair in turns]
    print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    if arguments.minutes:
        samples = measure_memory(arguments.minutes, count, arguments.port)
        is_good &= print_memory(samples)
        result["growth_mb_per_h"] = {
            name: growth_mb_per_h(samples, column) for name, column in (("flight", 1), ("page", 2))
        }
        result["memory_min_mb_mb"] = samples
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({**result, "is_met": is_good}, indent=1) + "\n")
    return int(not is_good)


def main() -> int:
    """Read the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", metavar="N", type=int, default=6, help="0: leaves them out")
    parser.add_argument("--seconds", metavar="S", type=float, default=10.0, help="of each turn")
    parser.add_argument(
        "--minutes", metavar="M", type=float, default=60.0, help="of the long flight; 0: none"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="where to write the figures")
    parser.add_argument("--browsers", metavar="N", type=int, default=10)
    parser.add_argument("--port", metavar="PORT", type=int, default=8080, help="of the page")
    parser.add_argument("--browse", metavar="URL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.browse is not None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # as if on other computers
        asyncio.run(browse_all(arguments.browse, arguments.browsers))
        return 0
    return run(arguments)


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
