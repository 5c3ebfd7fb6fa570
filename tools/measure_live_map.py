"""How much ten browsers on the live map, one of them stalled, disturb the control tick.

    .venv/bin/python tools/measure_live_map.py [--rounds 3] [--seconds 20] [--browsers 10]

Flies the simulator in real time and takes turns: a while without the map, a while with it and all
browsers. Prints how late the control ticks were in each, and what memory the flight and the page's
process took. A browser here is what one is to the server: it loads the page and takes every update
over its socket; the stalled one stops reading. Exit code 1 if p99 rises by 5 ms or more.
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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from companion.config.schema import CompanionConfig
from companion.demo.simulator import free_udp_port
from companion.guidance.session import SessionParams
from companion.io.clock import Clock
from companion.io.journal import FlightJournal
from companion.io.links import UdpBind
from companion.io.shell import Shell, TimerStatistics
from companion.run import build_endpoint
from companion.web.settings import web_settings
from companion.web.view import WebView

MOST_MS = 5.0
SETTLE_S = 3.0
"""After each change, not measured."""
CONFIG = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
"""The flight never ends by itself."""


class Lateness(TimerStatistics):
    """Keeps how late every tick was."""

    def __init__(self) -> None:
        super().__init__()
        self.late_s: list[float] = []

    def note(self, late_s: float) -> None:
        """Take in how late it is now."""
        super().note(late_s)
        self.late_s.append(late_s)


class MeasuredFlight:
    """A flight whose map can be switched on and off."""

    def __init__(self, port: int, directory: Path, web_port: int) -> None:
        self.settings = web_settings(str(web_port))
        self.view = WebView(self.settings, CONFIG)
        journal = FlightJournal(directory, time.time())
        self._journal = journal
        self.endpoint = build_endpoint(CONFIG, self.view.listen(journal), recorder=journal.inputs)
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

    def memory_mb(self) -> tuple[float, float]:
        """Of this process and of the page's."""
        return resident_mb(os.getpid()), resident_mb(self.view.process_id)


def resident_mb(process: int) -> float:
    """What a process has in memory (Linux)."""
    pages = Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


async def browse(url: str, *, is_stalled: bool) -> None:
    """One browser, until it is cancelled."""
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
    """All browsers; the last one stalls."""
    async with asyncio.TaskGroup() as group:
        for number in range(count):
            group.create_task(_browse(url, is_stalled=number == count - 1))


async def _browse(url: str, *, is_stalled: bool) -> None:
    with suppress(ConnectionClosed):  # the server gave up the one that stalled
        await browse(url, is_stalled=is_stalled)


@contextmanager
def browsers(url: str, count: int) -> Iterator[None]:
    """Browsers in a process of their own, once every one of them gets updates."""
    command = [sys.executable, __file__, "--browse", url, "--browsers", str(count)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            for _ in range(count):
                if not process.stdout.readline():
                    raise SystemExit("a browser did not get the page")
            yield
        finally:
            process.kill()


def measure(flight: MeasuredFlight, seconds: float) -> list[float]:
    """How late the ticks of a while are, milliseconds."""
    time.sleep(SETTLE_S)
    first = len(flight.timing.late_s)
    time.sleep(seconds)
    return [1e3 * late_s for late_s in flight.timing.late_s[first:]]


def line(name: str, late_ms: list[float]) -> str:
    p50, p99 = np.percentile(late_ms, [50, 99])
    return f"{name:<24} {len(late_ms):>6} {p50:>8.2f} {p99:>8.2f} {max(late_ms):>8.2f}"


def run(rounds: int, seconds: float, count: int, web_port: int) -> int:
    port = free_udp_port()
    listen = free_udp_port()
    command = [sys.executable, "-m", "sim_link", "--listen", f"127.0.0.1:{listen}"]
    command += ["--send-to", f"127.0.0.1:{port}"]
    without: list[float] = []
    with_all: list[float] = []
    memory: list[tuple[float, float]] = []
    with (
        tempfile.TemporaryDirectory() as directory,
        subprocess.Popen(command, stdout=subprocess.DEVNULL) as simulator,
    ):
        flight = MeasuredFlight(port, Path(directory), web_port)
        flight.start()
        try:
            time.sleep(15.0)  # take-off, and the page's process is up
            for _ in range(rounds):
                flight.has_map = False
                without += measure(flight, seconds)
                flight.has_map = True
                with browsers(flight.settings.url, count):
                    time.sleep(SETTLE_S)
                    memory.append(flight.memory_mb())
                    with_all += measure(flight, seconds)
                    memory.append(flight.memory_mb())
        finally:
            flight.stop()
            simulator.terminate()
    change_ms = float(np.percentile(with_all, 99) - np.percentile(without, 99))
    print(f"{'lateness of ticks, ms':<24} {'ticks':>6} {'p50':>8} {'p99':>8} {'worst':>8}")
    print(line("without the map", without))
    print(line(f"{count} browsers, 1 stalled", with_all))
    print(f"p99 changes by {change_ms:+.2f} ms (at most {MOST_MS:g})")
    for name, column in (("flight", 0), ("page", 1)):
        values = [mb[column] for mb in memory]
        turns = zip(values[::2], values[1::2], strict=True)
        text = ", ".join(f"{began:.1f} to {ended:.1f}" for began, ended in turns)
        print(f"memory of the {name} in each turn with browsers, MB: {text}")
    print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    return int(change_ms >= MOST_MS)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", metavar="N", type=int, default=3)
    parser.add_argument("--seconds", metavar="S", type=float, default=20.0, help="of each turn")
    parser.add_argument("--browsers", metavar="N", type=int, default=10)
    parser.add_argument("--port", metavar="PORT", type=int, default=8080, help="of the page")
    parser.add_argument("--browse", metavar="URL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.browse is not None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # as if on other machines
        asyncio.run(browse_all(arguments.browse, arguments.browsers))
        return 0
    return run(arguments.rounds, arguments.seconds, arguments.browsers, arguments.port)


if __name__ == "__main__":
    sys.exit(main())
