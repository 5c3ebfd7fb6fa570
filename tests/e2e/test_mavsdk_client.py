"""MAVSDK, an independent MAVLink stack, flies the `sim-link` process over UDP."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mavsdk.asyncio.plugins.offboard import PositionNedYaw
from mavsdk.asyncio.plugins.telemetry import FlightMode, LandedState

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from tests.e2e.mavsdk_rigs import Client, connected, heard_from_now, until
from tests.e2e.simulator_process import PATIENCE_S, running_simulator
from tests.ports import free_port

pytestmark = pytest.mark.slow

SPEED = 3.0


@pytest.fixture
def report(tmp_path: Path) -> Path:
    return tmp_path / "report.json"


@pytest.fixture
def client_port(report: Path) -> Iterator[int]:
    """A running simulator; the UDP port that it sends to."""
    options = ("--report", str(report))
    with running_simulator("px4", SPEED, None, *options, bears_s=60.0) as port:
        yield port


async def fly(client: Client) -> None:
    action, telemetry, offboard = client.action, client.telemetry, client.offboard
    health = await until(
        telemetry.subscribe_health(),
        lambda update: update.is_armable and update.is_home_position_ok,
    )
    assert health.is_gyrometer_calibration_ok
    assert health.is_accelerometer_calibration_ok
    assert health.is_magnetometer_calibration_ok
    assert health.is_local_position_ok
    assert health.is_global_position_ok

    async with heard_from_now(telemetry.subscribe_flight_mode()) as modes:
        await action.arm()
        await until(telemetry.subscribe_armed(), bool)
        await action.takeoff()
        await modes.until(lambda mode: mode == FlightMode.TAKEOFF)
        await modes.until(lambda mode: mode == FlightMode.HOLD)

        await offboard.set_position_ned(PositionNedYaw(25.0, 20.0, -8.0, 90.0))
        await offboard.start()
        await modes.until(lambda mode: mode == FlightMode.OFFBOARD)
        await until(
            telemetry.subscribe_position_velocity_ned(),
            lambda state: (
                abs(state.position.north_m - 25.0) < 0.3
                and abs(state.position.east_m - 20.0) < 0.3
                and abs(state.position.down_m + 8.0) < 0.3
            ),
        )
        await offboard.stop()
        await modes.until(lambda mode: mode == FlightMode.HOLD)

    await action.land()
    await until(telemetry.subscribe_landed_state(), lambda state: state == LandedState.ON_GROUND)
    await until(telemetry.subscribe_armed(), lambda is_armed: not is_armed)


async def connect_and_fly(port: int) -> None:
    async with connected(port, "px4") as client:
        assert await client.system.get_system_id() == 1
        await fly(client)


def test_mavsdk_checks_health_arms_takes_off_flies_offboard_and_lands(
    client_port: int, report: Path
) -> None:
    truth = json.loads(report.read_text(encoding="utf-8"))
    assert truth["state"] == "running"
    assert truth["emitter"]["enu_m"] == [50.0, 50.0, 0.0]
    asyncio.run(connect_and_fly(client_port))


def await_heartbeats(client: socket.socket, count: int) -> None:
    """Listen to an autopilot, which sends one a second of its flight."""
    codec, heard = MavCodec(255, 190), 0
    while heard < count:
        messages = codec.decode(client.recv(65_535))
        heard += sum(isinstance(each, mavlink.MAVLink_heartbeat_message) for each in messages)


def test_the_report_tells_the_flight_after_the_end(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    command = [sys.executable, "-m", "sim_link", "--report", str(path), "--seed", "9", "--quiet"]
    command += ["--listen", f"127.0.0.1:{free_port()}", "--speed", "20"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.settimeout(PATIENCE_S)
        command += ["--send-to", f"127.0.0.1:{client.getsockname()[1]}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            try:
                await_heartbeats(client, 5)
                assert process.poll() is None
                process.send_signal(signal.SIGINT)
                assert process.wait(timeout=PATIENCE_S) == 0
            finally:
                process.kill()
    flown = json.loads(path.read_text(encoding="utf-8"))
    assert flown["state"] == "ended"
    assert flown["seed"] == 9
    assert flown["simulated_s"] > 2.0
    assert flown["track"][0] == [0.0, 10.0, 10.0, 0.0]
