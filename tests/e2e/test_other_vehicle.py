"""A second vehicle with the ids of ours, heard over UDP by real processes."""

from __future__ import annotations

import re
import select
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.e2e.simulator_process import PATIENCE_S, PATIENT
from tests.e2e.test_flight import SPEED, Commands, compiled_kernels, wait_for_text
from tests.ports import free_port

pytestmark = pytest.mark.slow

__all__ = ["compiled_kernels"]

Address = tuple[str, int]


class Router:
    """A UDP router in front of a companion: each sender has a port of its own there."""

    def __init__(self, companion: Address) -> None:
        self._companion = companion
        self._front = self._socket()
        self.port: int = self._front.getsockname()[1]
        self.ways: dict[Address, socket.socket] = {}
        """Links by the sender's address."""
        self._left: list[socket.socket] = []
        self._silent: dict[Address, float] = {}
        self._is_closed = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def move(self, sender: Address, silent_s: float) -> None:
        """Drop what a sender sends for a while; then it has another port."""
        self._silent[sender] = time.monotonic() + silent_s
        self._left.append(self.ways[sender])
        self.ways[sender] = self._socket()

    def close(self) -> None:
        self._is_closed = True
        self._thread.join()
        for each in (self._front, *self.ways.values(), *self._left):
            each.close()

    def _socket(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind(("127.0.0.1", 0))
        return made

    def _run(self) -> None:
        while not self._is_closed:
            ways = dict(self.ways)
            ready, _, _ = select.select([self._front, *ways.values()], [], [], 0.05)
            with suppress(ConnectionError):
                for each in ready:
                    data, sender = each.recvfrom(65_535)
                    if each is self._front:
                        self._forward(data, sender)
                    else:
                        to = next(sender for sender, way in ways.items() if way is each)
                        self._front.sendto(data, to)

    def _forward(self, data: bytes, sender: Address) -> None:
        if sender not in self.ways:
            self.ways[sender] = self._socket()
        if time.monotonic() >= self._silent.get(sender, 0.0):
            self.ways[sender].sendto(data, self._companion)


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    started = Commands(tmp_path)
    yield started
    for process in started.running:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_neighbour_with_our_ids_gets_no_setpoint_when_the_address_of_ours_changes(
    commands: Commands, flavour: str
) -> None:
    ours: Address = ("127.0.0.1", free_port())
    companion_port = free_port()
    companion = commands.companion(companion_port)
    wait_for_text(companion, "waiting for an autopilot")
    router = Router(("127.0.0.1", companion_port))
    scenario = commands.directory / "twins.yaml"
    autopilot = f"autopilot: {{{PATIENT[flavour] % 30.0}}}\n"
    scenario.write_text(f"{autopilot}other_vehicles: [{{system_id: 1, start_s: 45}}]\n")
    simulator = commands.start(
        "sim-link",
        *("--scenario", str(scenario), "--speed", SPEED, "--listen", f"{ours[0]}:{ours[1]}"),
        *("--send-to", f"127.0.0.1:{router.port}"),
    )
    try:
        wait_for_text(companion, "in control: autopilot is in")
        deadline = time.monotonic() + PATIENCE_S
        while len(router.ways) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        time.sleep(1.0)
        router.move(ours, 6.0)
        wait_for_text(companion, "control ended: 1/1 at ")
        time.sleep(8.0)  # ours is heard again, from elsewhere
        companion.send_signal(signal.SIGTERM)
        _, errors = companion.communicate(timeout=PATIENCE_S)
        assert companion.returncode == 0, errors
        assert "in control" not in errors
        simulator.send_signal(signal.SIGTERM)
        output, _ = simulator.communicate(timeout=PATIENCE_S)
    finally:
        router.close()
    (found,) = re.findall(r"other vehicle 1: (\d+) setpoints .*, moved (\S+) m", output)
    assert int(found[0]) == 0
    assert float(found[1]) < 1.0
    received = re.findall(r"(\d+) setpoints received", output)
    assert int(received[0]) > 100  # ours was flown before
