"""The `sim-link` process that independent clients fly."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.ports import free_port

PATIENCE_S = 120.0
"""Time limit of an event that must come, on a slow machine that is shared."""
PATIENT = {
    "px4": "offboard_loss_timeout_s: %g, parameters: {COM_DISARM_PRFLT: 60}",
    "ardupilot": "flavour: ardupilot, offboard_loss_timeout_s: %g, parameters: {DISARM_DELAY: 120, "
    "GUID_TIMEOUT: 5}",
}
"""Autopilots that bear with a client which the machine keeps waiting: faster than real time, its
second of silence is over within a moment."""


def patient_scenario(flavour: str, directory: Path, bears_s: float = 60.0) -> Path:
    """A file with the canonical scenario, whose PX4 tolerates `bears_s` without setpoints."""
    path = directory / f"patient-{flavour}.yaml"
    path.write_text(f"autopilot: {{{PATIENT[flavour] % bears_s}}}\n", encoding="utf-8")
    return path


@contextmanager
def running_simulator(
    flavour: str,
    speed: float,
    listen_port: int | None = None,
    *options: str,
    bears_s: float | None = None,
) -> Iterator[int]:
    """A simulator that is stopped at the end; the UDP port that it sends to."""
    port = free_port()
    command = [sys.executable, "-m", "sim_link", "--autopilot", flavour, "--speed", str(speed)]
    command += ["--listen", f"127.0.0.1:{listen_port or free_port()}"]
    command += ["--send-to", f"127.0.0.1:{port}", *options]
    with tempfile.TemporaryDirectory() as directory:
        if bears_s is not None:
            command += ["--scenario", str(patient_scenario(flavour, Path(directory), bears_s))]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            try:
                assert "scenario canonical" in process.stdout.readline()
                yield port
                process.send_signal(signal.SIGTERM)
                assert process.wait(timeout=PATIENCE_S) == 0
                assert "stopped after" in process.stdout.read()
            finally:
                process.kill()
