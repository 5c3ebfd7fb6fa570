"""The simulator as a process of its own, and what it reports."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from companion.errors import CompanionError

START_TIMEOUT_S = 60.0
"""Compiling takes its time where the kernels of obstacles are not compiled yet."""
STOP_TIMEOUT_S = 3.0
HOST = "127.0.0.1"


def free_udp_port() -> int:
    """A UDP port of this machine that nobody has at the moment."""
    return free_udp_ports(1)[0]


def free_udp_ports(count: int) -> list[int]:
    """So many of them, each another one: none is let go before all are found."""
    with ExitStack() as stack:
        probes = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            for _ in range(count)
        ]
        for probe in probes:
            probe.bind((HOST, 0))
        return [int(probe.getsockname()[1]) for probe in probes]


class SimulatorProcess:
    """`sim-link` in a process that ends with this one, whatever ends it.

    The child reads a pipe of ours as its standard input and stops when that closes, so not even
    a kill -9 of the parent leaves it behind; it has a session of its own, so that a Ctrl-C at the
    terminal reaches only the parent, which then stops it in order.

    Args:
        report: Where the simulator writes its report.
        scenario: A scenario file; None: the canonical one.
        autopilot: px4 or ardupilot; None: the scenario's.
    """

    def __init__(
        self,
        report: Path,
        seed: int,
        speed: float,
        scenario: Path | None,
        companion_port: int,
        autopilot: str | None = None,
    ) -> None:
        self._report = report
        self._command = [
            *(sys.executable, "-m", "sim_link", "--stop-on-eof", "--quiet"),
            *("--seed", str(seed), "--speed", str(speed), "--report", str(report)),
            *("--listen", f"{HOST}:{free_udp_port()}"),
            *("--send-to", f"{HOST}:{companion_port}"),
            *(() if scenario is None else ("--scenario", str(scenario))),
            *(() if autopilot is None else ("--autopilot", autopilot)),
        ]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> SimulatorProcess:
        """Start it."""
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop it, at the latest by force."""
        self.stop()

    def stop(self) -> None:
        """End the process; it writes its report first. Does nothing the second time."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.communicate(timeout=STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()

    @property
    def is_alive(self) -> bool:
        """Whether it still runs."""
        return self._process is not None and self._process.poll() is None

    def started_report(self) -> dict[str, Any]:
        """The report that is written at the start, with the truth.

        Raises:
            CompanionError: The simulator did not start.
        """
        deadline = time.monotonic() + START_TIMEOUT_S
        while not self._report.exists():
            if not self.is_alive or time.monotonic() > deadline:
                raise CompanionError(f"the simulator did not start{self._complaint()}")
            time.sleep(0.02)
        return self.report()

    def report(self) -> dict[str, Any]:
        """The report as it is now."""
        value: dict[str, Any] = json.loads(self._report.read_text(encoding="utf-8"))
        return value

    def _complaint(self) -> str:
        if self._process is None or self._process.poll() is None or self._process.stderr is None:
            return ""
        text = self._process.stderr.read().strip().removeprefix("sim-link: ")
        return f": {text}" if text else ""
