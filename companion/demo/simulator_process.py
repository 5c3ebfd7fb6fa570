"""The simulator as a process of its own, and its report."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from companion.errors import CompanionError
from companion.io.child_process import HOST, START_S, ChildProcess, free_udp_port
from companion.io.shared_clock import Pacer

STOP_TIMEOUT_S = 30.0
"""Real time for its last report, which a busy computer delays."""


class SimulatorProcess(ChildProcess):
    """`sim-link`, which ends with this process; its output goes beside its report."""

    def __init__(
        self,
        report: Path,
        seed: int,
        clock: Pacer,
        scenario: Path | None,
        companion_port: int,
        autopilot: str | None,
    ) -> None:
        self._report = report
        arguments = [
            *("-m", "sim_link", "--stop-on-eof", "--quiet"),
            *("--seed", str(seed), "--speed", str(clock.speed), "--report", str(report)),
            *("--listen", f"{HOST}:{free_udp_port()}"),
            *("--send-to", f"{HOST}:{companion_port}"),
            *(() if scenario is None else ("--scenario", str(scenario))),
            *(() if autopilot is None else ("--autopilot", autopilot)),
        ]
        super().__init__("sim-link", arguments, report.with_suffix(".log"), clock.environment(0))

    def __enter__(self) -> SimulatorProcess:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop(STOP_TIMEOUT_S)

    def started_report(self) -> dict[str, Any]:
        """Return the report, with the truth, of a started simulator; else `CompanionError`."""
        deadline = time.monotonic() + START_S
        while not self._report.exists():
            if not self.is_alive or time.monotonic() > deadline:
                words = self.last_words.removeprefix("sim-link: ")
                raise CompanionError(f"the simulator did not start{words and ': '}{words}")
            time.sleep(0.02)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return the current report."""
        value: dict[str, Any] = json.loads(self._report.read_text(encoding="utf-8"))
        return value
