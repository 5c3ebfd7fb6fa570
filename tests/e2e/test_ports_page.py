"""The commands of the pages, read there and flown: ports of their own, and a router."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from tests.e2e.mavproxy_process import MavProxy
from tests.e2e.simulator_process import PATIENCE_S, running_simulator
from tests.ports import free_port

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"
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
"""Command that the operator types, and its result."""


class Block:
    """A block of commands of a page, on ports of this test's own."""

    def __init__(self, page: str, marker: str) -> None:
        text = (DOCS / page).read_text(encoding="utf-8")
        blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        (text,) = (each for each in blocks if marker in each)
        self._ports = {port: free_port() for port in set(re.findall(r":(\d{4,5})\b", text))}
        own = re.sub(r":(\d{4,5})\b", lambda match: f":{self._ports[match[1]]}", text)
        lines = [shlex.split(line, comments=True) for line in own.splitlines()]
        self.commands = {line[0].removeprefix(".venv/bin/"): line[1:] for line in lines}

    def at(self, port: int) -> str:
        """Return the text that replaces an address of the page."""
        return f"127.0.0.1:{self._ports[str(port)]}"


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


def hears_the_vehicle(address: str) -> bool:
    """Return True if a ground station behind the router receives the autopilot's HEARTBEAT."""
    connect: Any = mavutil.mavlink_connection
    station = connect(f"udpin:{address}", source_system=254)
    heard = [
        station.recv_match(type="HEARTBEAT", blocking=True, timeout=PATIENCE_S) for _ in range(4)
    ]
    station.close()
    return any(each is not None and each.get_srcComponent() == 1 for each in heard)


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


@contextmanager
def vehicle_and_operator(
    flavour: str, directory: Path, links: list[str], operator: list[str]
) -> Iterator[MavProxy]:
    """A vehicle without a radio of its own, with these links, and MAVProxy on one of them."""
    scenario = directory / "no-radio.yaml"
    scenario.write_text(NO_RADIO)
    options = ["--scenario", str(scenario), *links]
    with (
        running_simulator(flavour, 1.0, None, *options),
        MavProxy(directory, *operator) as mavproxy,
    ):
        mavproxy.expect("Detected vehicle 1:1")
        yield mavproxy


def find_the_emitter(flavour: str, block: Block, operator: MavProxy, directory: Path) -> None:
    """Start companion and radio as the block says, fly, and look at what is reported."""
    own = ["companion", *block.commands["companion"], "--once"]
    radio = ["sim_link", *block.commands["sim-link"]]
    with running(directory, *radio), running(directory, *own) as companion:
        wait_for(companion, "ready: switch to")
        for command, answer in TO_OFFBOARD[flavour]:
            operator.ask(command, answer) if command else operator.expect(answer)
        wait_for(companion, "LOCALISED")
        assert companion.wait(timeout=PATIENCE_S) == 0
    (result,) = directory.glob("flights/*/result.json")
    found = json.loads(result.read_text())
    assert abs(found["east_m"] - 50.0) < 1.0
    assert abs(found["north_m"] - 50.0) < 1.0


def test_three_programs_share_a_px4s_port_behind_mavproxy(tmp_path: Path) -> None:
    block = Block("ports.md", "--master=udpin:127.0.0.1:14540")
    links, router = ["--send-to", block.at(14540)], block.commands["mavproxy.py"]
    with vehicle_and_operator("px4", tmp_path, links, router) as operator:
        assert hears_the_vehicle(block.at(14543))
        find_the_emitter("px4", block, operator, tmp_path)


def test_three_programs_share_an_ardupilots_tcp_port_behind_mavproxy(tmp_path: Path) -> None:
    block = Block("ports.md", "--master=tcp:127.0.0.1:5760")
    links, router = ["--link", f"tcpin:{block.at(5760)}"], block.commands["mavproxy.py"]
    with vehicle_and_operator("ardupilot", tmp_path, links, router) as operator:
        assert hears_the_vehicle(block.at(14550))
        find_the_emitter("ardupilot", block, operator, tmp_path)


def test_each_program_has_a_udp_port_of_a_px4_for_itself(tmp_path: Path) -> None:
    block, station = Block("px4.md", "companion --connect udp"), f"127.0.0.1:{free_port()}"
    links = ["--send-to", block.at(14540), "--link", f"udpout:{block.at(14030)}#narrow"]
    links += ["--link", f"udpout:{station}#station"]
    with vehicle_and_operator("px4", tmp_path, links, [f"--master=udpin:{station}"]) as operator:
        find_the_emitter("px4", block, operator, tmp_path)


def test_each_program_has_a_tcp_port_of_an_ardupilot_for_itself(tmp_path: Path) -> None:
    block, station = Block("ardupilot.md", "companion --connect tcp"), f"127.0.0.1:{free_port()}"
    addresses = (block.at(5762), block.at(5763), station)
    links = [part for address in addresses for part in ("--link", f"tcpin:{address}")]
    router = [f"--master=tcp:{station}"]
    with vehicle_and_operator("ardupilot", tmp_path, links, router) as operator:
        find_the_emitter("ardupilot", block, operator, tmp_path)
