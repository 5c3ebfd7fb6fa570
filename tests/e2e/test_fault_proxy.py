"""A bad link between real processes: simulator, proxy and companion, as installed."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.simulator_process import PATIENCE_S, patient_scenario
from tests.e2e.test_flight import Commands, compiled_kernels, wait_for_text
from tests.ports import free_port

pytestmark = pytest.mark.slow

__all__ = ["compiled_kernels"]

SPEED = "1"
FAULTS = (
    "{kind: link_loss, share: 0.15}",
    "{kind: link_duplicates, share: 0.1, spread_s: 0.01}",
    "{kind: link_bit_flips, share: 0.05}",
    "{kind: foreign_frames, rate_hz: 20}",
)


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    started = Commands(tmp_path)
    yield started
    for process in started.running:
        if process.poll() is None:
            process.kill()
        process.communicate()


def test_a_search_is_flown_and_ended_over_a_bad_link(commands: Commands) -> None:
    port, middle = free_port(), free_port()
    faults = [word for text in FAULTS for word in ("--fault", text)]
    ends = ("--listen", f"127.0.0.1:{middle}", "--companion", f"127.0.0.1:{port}")
    proxy = commands.start("sim-link", "proxy", *ends, *faults)
    assert proxy.stdout is not None
    assert f"vehicle to 127.0.0.1:{middle}" in proxy.stdout.readline()
    companion = commands.companion(port, "--speed", SPEED)
    wait_for_text(companion, "waiting for an autopilot")
    addresses = ("--send-to", f"127.0.0.1:{middle}", "--listen", f"127.0.0.1:{free_port()}")
    scenario = ("--scenario", str(patient_scenario("px4", commands.directory)))
    commands.start("sim-link", "--speed", SPEED, *addresses, *scenario)
    wait_for_text(companion, "following the plan")
    companion.send_signal(signal.SIGTERM)
    _, errors = companion.communicate(timeout=PATIENCE_S)
    assert companion.returncode == 0, errors
    proxy.send_signal(signal.SIGTERM)
    output, _ = proxy.communicate(timeout=PATIENCE_S)
    assert proxy.returncode == 0
    counted = {name: int(value) for name, value in re.findall(r"(\w+)=(\d+)", output)}
    passed = counted["to_companion"] + counted["to_vehicle"]
    assert passed > 500
    assert counted["lost"] / (passed + counted["lost"]) == pytest.approx(0.14, abs=0.05)
    assert counted["attacks"] > 20
