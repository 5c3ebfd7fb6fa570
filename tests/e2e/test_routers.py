"""One port for three, as docs/ports.md has it: MAVProxy as the router, and a search through it."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from tests.e2e.mavproxy_process import MavProxy
from tests.e2e.simulator_process import PATIENCE_S, running_simulator
from tests.ports import free_port

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "ports.md"
ALTITUDE_M = 20.0
GROUND_AMSL_M = 488.0
NO_RADIO = "payload: {max_range_m: 0.001}\n"
TO_OFFBOARD = {
    "px4": (
        ("long MAV_CMD_DO_SET_MODE 1 4 3 0 0 0 0", "DO_SET_MODE: ACCEPTED"),
        ("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED"),
        (f"takeoff {GROUND_AMSL_M + ALTITUDE_M:g}", "NAV_TAKEOFF: ACCEPTED"),
        ("", r"height 1\d"),
        ("long MAV_CMD_DO_SET_MODE 1 6 0 0 0 0 0", "Mode OFFBOARD|OFFBOARD>"),
    ),
    "ardupilot": (
        ("mode GUIDED", "Mode GUIDED"),
        ("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED"),
        (f"takeoff {ALTITUDE_M:g}", "NAV_TAKEOFF: ACCEPTED"),
    ),
}
"""What the operator types, and what comes of it."""


class Block:
    """A block of commands of the page, on ports of this test's own."""

    def __init__(self, master: str) -> None:
        blocks = re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
        (text,) = (each for each in blocks if f"--master={master}" in each)
        self.ports = {port: free_port() for port in set(re.findall(r":(\d{4,5})\b", text))}
        own = re.sub(r":(\d{4,5})\b", lambda match: f":{self.ports[match[1]]}", text)
        lines = [shlex.split(line) for line in own.splitlines()]
        self.commands = {line[0]: line[1:] for line in lines}

    @property
    def master_port(self) -> int:
        """Where MAVProxy hears the vehicle."""
        return int(self.commands["mavproxy.py"][0].rpartition(":")[2])

    @property
    def station_port(self) -> int:
        """What its last `--out` leaves to others."""
        return int(self.commands["mavproxy.py"][-1].rpartition(":")[2])


@contextmanager
def running(directory: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A command of ours, killed at the end."""
    environment = dict(os.environ, XDG_STATE_HOME=str(directory), NUMBA_DISABLE_JIT="1")
    with subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=directory,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def hears_the_vehicle(port: int) -> bool:
    """Whether a ground station behind the router is shown an autopilot."""
    connect: Any = mavutil.mavlink_connection
    station = connect(f"udpin:127.0.0.1:{port}", source_system=254)
    heard = station.recv_match(type="HEARTBEAT", blocking=True, timeout=PATIENCE_S)
    station.close()
    return heard is not None and heard.get_srcComponent() == 1


def wait_for(process: subprocess.Popen[str], words: str) -> None:
    """Read what a command says, up to these words; without them it is killed in the end."""
    assert process.stderr is not None
    said = []
    patience = threading.Timer(PATIENCE_S, process.kill)
    patience.start()
    try:
        for line in process.stderr:
            said.append(line)
            if words in line:
                return
    finally:
        patience.cancel()
    raise AssertionError(f"`{words}` never came: {said}")


@pytest.mark.parametrize(
    ("flavour", "master"), [("px4", "udpin:127.0.0.1:14540"), ("ardupilot", "tcp:127.0.0.1:5760")]
)
def test_three_programs_share_a_port_behind_mavproxy_and_find_the_emitter(
    flavour: str, master: str, tmp_path: Path
) -> None:
    block = Block(master)
    scenario = tmp_path / "no-radio.yaml"
    scenario.write_text(NO_RADIO)
    options = ["--scenario", str(scenario)]
    if master.startswith("tcp"):
        options += ["--link", f"tcpin:127.0.0.1:{block.master_port}"]
    else:
        options += ["--send-to", f"127.0.0.1:{block.master_port}"]
    with ExitStack() as stack:
        stack.enter_context(running_simulator(flavour, 1.0, None, *options))
        router = stack.enter_context(MavProxy(tmp_path, *block.commands["mavproxy.py"]))
        router.expect("Detected vehicle 1:1")
        assert hears_the_vehicle(block.station_port)
        radio = ["sim_link", *block.commands["sim-link"]]
        stack.enter_context(running(tmp_path, *radio))
        own = ["companion", *block.commands["companion"], "--once"]
        companion = stack.enter_context(running(tmp_path, *own))
        wait_for(companion, "ready: switch to")
        for command, answer in TO_OFFBOARD[flavour]:
            router.ask(command, answer) if command else router.expect(answer)
        wait_for(companion, "LOCALISED")
        assert companion.wait(timeout=PATIENCE_S) == 0
    (result,) = tmp_path.glob("flights/*/result.json")
    found = json.loads(result.read_text())
    assert abs(found["east_m"] - 50.0) < 1.0
    assert abs(found["north_m"] - 50.0) < 1.0
