"""The `sim-link` process that independent clients fly."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_simulator(flavour: str, speed: float, listen_port: int | None = None) -> Iterator[int]:
    """A simulator that is stopped at the end; the UDP port that it sends to."""
    port = free_port()
    command = [sys.executable, "-m", "sim_link", "--autopilot", flavour, "--speed", str(speed)]
    command += [
        "--listen",
        f"127.0.0.1:{listen_port or free_port()}",
        "--send-to",
        f"127.0.0.1:{port}",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "scenario canonical" in process.stdout.readline()
        try:
            yield port
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=5.0) == 0
        finally:
            process.kill()
