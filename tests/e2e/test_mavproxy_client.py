"""MAVProxy, the command-line ground station, headless: it flies the `sim-link` process over UDP."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from companion.config.tunables import TUNABLES
from tests.e2e.mavproxy_process import MavProxy
from tests.e2e.simulator_process import PATIENCE_S, running_simulator
from tests.ports import free_port

pytestmark = pytest.mark.slow

SPEED = {"px4": 1.0, "ardupilot": 8.0}
"""On a busy machine MAVProxy does not keep up with several times a PX4's streams."""
PLAN = """\
QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397832\t8.545727\t488.0\t1
1\t0\t3\t16\t0\t0\t0\t0\t47.398000\t8.545900\t12.0\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.398100\t8.546000\t14.0\t1
"""
FENCE = """\
47.397800 8.545700
47.396800 8.544700
47.398800 8.544700
47.398800 8.546700
47.396800 8.546700
47.396800 8.544700
"""
"""A return point, then a closed square."""
GROUND_AMSL_M = 488.0
PX4_LOITER = "long MAV_CMD_DO_SET_MODE 1 4 3 0 0 0 0"
PX4_LAND = "long MAV_CMD_DO_SET_MODE 1 4 6 0 0 0 0"
"""MAVProxy's own `mode` command raises with a PX4 (version 1.8.74)."""


@contextmanager
def connected(
    flavour: str, directory: Path, listen_port: int | None = None, *options: str
) -> Iterator[MavProxy]:
    """MAVProxy on a running simulator, with all parameters read."""
    simulator = running_simulator(flavour, SPEED[flavour], listen_port, *options, bears_s=60.0)
    with simulator as port, MavProxy(directory, *master_at(port)) as mavproxy:
        mavproxy.expect("Detected vehicle 1:1")
        mavproxy.expect(r"Received \d+ parameters")
        yield mavproxy


def master_at(port: int) -> tuple[str, ...]:
    """MAVProxy on a UDP port that it binds."""
    return (f"--master=udpin:127.0.0.1:{port}", "--streamrate=4")


def overflowed(port: int) -> int:
    """Return the datagrams dropped by the system because the owner of a port reads too slowly."""
    rows = [row.split() for row in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if int(row[1].partition(":")[2], 16) == port)


def check_link_and_parameters(mavproxy: MavProxy, name: str, value: float) -> None:
    line = mavproxy.ask("link", r"link 1 OK")
    (port,) = (text for text in mavproxy.arguments if text.startswith("--master"))
    assert ", 0.0% loss" in line or overflowed(int(port.rpartition(":")[2])) > 0
    mavproxy.ask(f"param show {name}", rf"{name} +\d")
    mavproxy.say(f"param set {name} {value:g}")
    mavproxy.say(f"param fetch {name}")
    mavproxy.expect(rf"{name} = ")
    mavproxy.ask(f"param fetch {name}", rf"{name} = {value:.1f}")


def check_mission_and_fence(mavproxy: MavProxy, directory: Path) -> None:
    """Uploads first: MAVProxy never acknowledges a download, which keeps a PX4 busy for 5 s."""
    (directory / "plan.txt").write_text(PLAN, encoding="ascii")
    (directory / "fence.txt").write_text(FENCE, encoding="ascii")
    mavproxy.ask("wp load plan.txt", "Sent all 3 waypoints")
    mavproxy.expect("MISSION_ACK: TYPE_MISSION: ACCEPTED")
    mavproxy.ask("fence load fence.txt", "Sent all 5 fence items")
    mavproxy.expect("MISSION_ACK: TYPE_FENCE: ACCEPTED")
    mavproxy.ask("fence list", r"5001 0 47\.3968000\d* 8\.5447000\d* .* p1=4\.0")
    mavproxy.ask("wp list", r"16 3 47\.3980000\d* 8\.5459000\d* 12\.0")
    mavproxy.expect(r"16 3 47\.3981000\d* 8\.5460000\d* 14\.0")


def check_take_off(mavproxy: MavProxy, altitude_m: float) -> None:
    mavproxy.ask("arm throttle", "COMPONENT_ARM_DISARM: ACCEPTED")
    mavproxy.expect("ARMED")
    mavproxy.ask(f"takeoff {altitude_m:g}", "NAV_TAKEOFF: ACCEPTED")
    mavproxy.expect(r"height \d+")


def test_mavproxy_commands_a_px4(tmp_path: Path) -> None:
    with connected("px4", tmp_path) as mavproxy:
        check_link_and_parameters(mavproxy, "MIS_TAKEOFF_ALT", 7.0)
        check_mission_and_fence(mavproxy, tmp_path)
        mavproxy.ask(PX4_LOITER, "DO_SET_MODE: ACCEPTED")
        check_take_off(mavproxy, GROUND_AMSL_M + 12.0)
        mavproxy.ask(PX4_LAND, "Mode LAND|LAND>")
        mavproxy.ask("disarm", "COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")
        mavproxy.ask("disarm force", "DISARMED")  # a descent at real time takes long


def test_mavproxy_commands_an_ardupilot(tmp_path: Path) -> None:
    with connected("ardupilot", tmp_path) as mavproxy:
        check_link_and_parameters(mavproxy, "RTL_ALT", 2000.0)
        check_mission_and_fence(mavproxy, tmp_path)
        mavproxy.ask("mode GUIDED", "Mode GUIDED")
        check_take_off(mavproxy, 20.0)
        mavproxy.ask("mode LAND", "Mode LAND|LAND>")
        mavproxy.expect("DISARMED")


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_mavproxy_is_reported_why_arming_is_refused(flavour: str, tmp_path: Path) -> None:
    with connected(flavour, tmp_path) as mavproxy:
        mavproxy.ask(PX4_LAND if flavour == "px4" else "mode LAND", "Mode LAND|LAND>")
        refused = "TEMPORARILY_REJECTED" if flavour == "px4" else "FAILED"
        answer, why = f"COMPONENT_ARM_DISARM: {refused}", "AP: (Arming denied|Arm): "
        said = mavproxy.ask("arm throttle", f"{answer}|{why}")
        mavproxy.expect(why if answer in said else answer)


@contextmanager
def running_companion(directory: Path, *options: str) -> Iterator[None]:
    """A companion that is stopped at the end; its state and its flights are in a directory."""
    command = [sys.executable, "-m", "companion", *options]
    environment = dict(os.environ, XDG_STATE_HOME=str(directory), NUMBA_DISABLE_JIT="1")
    with subprocess.Popen(
        command, cwd=directory, env=environment, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield
            process.terminate()
            assert process.wait(timeout=PATIENCE_S) == 0
        finally:
            process.kill()


def station_on(port: int) -> Any:
    """A ground station of bare pymavlink that hears the companion."""
    connect: Any = mavutil.mavlink_connection
    station = connect(f"udpin:127.0.0.1:{port}", source_system=254)
    heard = station.recv_match(type="HEARTBEAT", blocking=True, timeout=PATIENCE_S)
    assert heard is not None
    assert (heard.get_srcSystem(), heard.get_srcComponent()) == (1, 191)
    return station


def hear_text(station: Any, wanted: str) -> None:
    """Read what the station has been sent, up to a STATUSTEXT with these words."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        message = station.recv_match(type="STATUSTEXT", blocking=True, timeout=PATIENCE_S)
        if message is not None and wanted in message.text:
            return
    raise AssertionError(f"no text to the station: {wanted}")


def listed_parameters(station: Any) -> dict[str, float]:
    """Ask the companion for its list and read all of it."""
    station.mav.param_request_list_send(1, 191)
    values: dict[str, float] = {}
    while len(values) < len(TUNABLES):
        message = station.recv_match(type="PARAM_VALUE", blocking=True, timeout=PATIENCE_S)
        assert message is not None
        values[message.param_id] = message.param_value
    return values


def test_mavproxy_and_pymavlink_set_the_companions_parameters_and_grant(tmp_path: Path) -> None:
    vehicle, own = free_port(), free_port()
    links = ("--connect", f"udpout:127.0.0.1:{vehicle}", "--gcs", f"udpout:127.0.0.1:{own}")
    simulator = connected("px4", tmp_path, vehicle, "--share-ports")
    with simulator as mavproxy, running_companion(tmp_path, *links):
        station = station_on(own)
        mavproxy.expect("Detected vehicle 1:191")
        mavproxy.ask("vehicle 1:191", rf"Received {len(TUNABLES)} parameters")
        mavproxy.ask("param set CMP_SPEED 3", "AP: parameter CMP_SPEED: 5 -> 3")
        mavproxy.ask("param fetch CMP_SPEED", r"CMP_SPEED = 3\.0")
        mavproxy.ask("param set CMP_SPEED 30", "CMP_SPEED: 30 is above the configuration's 5")
        mavproxy.ask("long NAV_GUIDED_ENABLE 1", "AP: GRANT refused: not needed")
        mavproxy.expect("NAV_GUIDED_ENABLE: TEMPORARILY_REJECTED")
        hear_text(station, "CMP_SPEED: 30 is above")  # what was sent before is read by now
        assert listed_parameters(station)["CMP_SPEED"] == 3.0
        station.mav.param_set_send(1, 191, b"CMP_ALTITUDE", 25.0, 9)
        mavproxy.expect("AP: parameter CMP_ALTITUDE: 20 -> 25")
        station.close()
    (kept,) = tmp_path.glob("companion/*.parameters.json")
    assert json.loads(kept.read_text()) == {"CMP_SPEED": 3.0, "CMP_ALTITUDE": 25.0}
