"""MAVSDK, an independent MAVLink stack, flies the `sim-link` process over UDP."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing
from pathlib import Path
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync, PositionNedYaw
from mavsdk.asyncio.plugins.telemetry import FlightMode, LandedState, TelemetryAsync

SPEED = 3.0
PATIENCE_S = 20.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def report(tmp_path: Path) -> Path:
    return tmp_path / "report.json"


@pytest.fixture
def client_port(report: Path) -> Iterator[int]:
    """A running simulator; the UDP port that it sends to."""
    port = free_port()
    command = [sys.executable, "-m", "sim_link", "--speed", str(SPEED), "--report", str(report)]
    command += ["--listen", f"127.0.0.1:{free_port()}", "--send-to", f"127.0.0.1:{port}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "scenario canonical" in process.stdout.readline()
        try:
            yield port
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=5.0) == 0
            assert "stopped after" in process.stdout.read()
        finally:
            process.kill()


async def until(updates: AsyncGenerator[Any, None], condition: Callable[[Any], bool]) -> Any:
    """The first update that meets a condition."""
    async with asyncio.timeout(PATIENCE_S), aclosing(updates):
        async for update in updates:
            if condition(update):
                return update
    raise AssertionError("the updates ended")


async def fly(system: System) -> None:
    action, telemetry = ActionAsync(system), TelemetryAsync(system)
    offboard = OffboardAsync(system)
    health = await until(
        telemetry.subscribe_health(),
        lambda update: update.is_armable and update.is_home_position_ok,
    )
    assert health.is_gyrometer_calibration_ok
    assert health.is_accelerometer_calibration_ok
    assert health.is_magnetometer_calibration_ok
    assert health.is_local_position_ok
    assert health.is_global_position_ok

    await action.arm()
    await until(telemetry.subscribe_armed(), bool)
    await action.takeoff()
    await until(telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.TAKEOFF)
    await until(telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.HOLD)

    await offboard.set_position_ned(PositionNedYaw(25.0, 20.0, -8.0, 90.0))
    await offboard.start()
    await until(telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.OFFBOARD)
    await until(
        telemetry.subscribe_position_velocity_ned(),
        lambda state: (
            abs(state.position.north_m - 25.0) < 0.3
            and abs(state.position.east_m - 20.0) < 0.3
            and abs(state.position.down_m + 8.0) < 0.3
        ),
    )
    await offboard.stop()
    await until(telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.HOLD)

    await action.land()
    await until(telemetry.subscribe_landed_state(), lambda state: state == LandedState.ON_GROUND)
    await until(telemetry.subscribe_armed(), lambda is_armed: not is_armed)


async def connect_and_fly(port: int) -> None:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as client:
        await client.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await client.first_autopilot(timeout_s=10.0)
        assert system is not None
        assert await system.get_system_id() == 1
        await fly(system)


def test_mavsdk_checks_health_arms_takes_off_flies_offboard_and_lands(
    client_port: int, report: Path
) -> None:
    truth = json.loads(report.read_text(encoding="utf-8"))
    assert truth["state"] == "running"
    assert truth["emitter"]["enu_m"] == [50.0, 50.0, 0.0]
    asyncio.run(connect_and_fly(client_port))


def test_the_report_tells_the_flight_after_the_end(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    command = [sys.executable, "-m", "sim_link", "--report", str(path), "--seed", "9", "--quiet"]
    command += ["--listen", f"127.0.0.1:{free_port()}", "--speed", "20"]
    command += ["--send-to", f"127.0.0.1:{free_port()}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(timeout=0.5)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=5.0) == 0
        finally:
            process.kill()
    flown = json.loads(path.read_text(encoding="utf-8"))
    assert flown["state"] == "ended"
    assert flown["seed"] == 9
    assert flown["simulated_s"] > 2.0
    assert flown["track"][0] == [0.0, 10.0, 10.0, 0.0]
