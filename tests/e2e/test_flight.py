"""The installed commands over UDP, with real processes: few and short."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from tests.e2e.simulator_process import PATIENCE_S, patient_scenario
from tests.ports import free_port

BIN = Path(sys.executable).parent
SPEED = "1.5"
"""A stall of 0.5 s of the companion's clock ends a launch, and a busy machine has short ones."""
FLIGHT_S = 300.0
"""Real time for a whole flight."""
STOP_S = 20.0
"""Time limit of a stop, which takes two seconds on an idle machine."""


class Commands:
    """Starts the installed commands in a folder of their own and ends them all."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.running: list[subprocess.Popen[str]] = []

    def start(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [BIN / name, *arguments],
            cwd=self.directory,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # A background shell hands SIGINT down as ignored; a person at a terminal does not.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        self.running.append(process)
        return process

    def simulator(self, port: int, **options: str) -> subprocess.Popen[str]:
        return self.start(
            "sim-link",
            *("--seed", "3", "--speed", SPEED, "--send-to", f"127.0.0.1:{port}"),
            *("--listen", options.get("listen", f"127.0.0.1:{free_port()}")),
            *("--report", str(self.directory / "truth.json")),
            *("--scenario", str(patient_scenario("px4", self.directory))),
        )

    def companion(self, port: int, *arguments: str) -> subprocess.Popen[str]:
        (self.directory / "auto.yaml").write_text("mission: {engage: auto}\n")
        url = f"udp:127.0.0.1:{port}"
        return self.start(
            "companion", "--connect", url, "--config", "auto.yaml", "--speed", SPEED, *arguments
        )


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    started = Commands(tmp_path)
    yield started
    for process in started.running:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Compile the kernels beforehand, so that it does not count against the time of a flight."""
    code = "from companion.run import compile_kernels; compile_kernels()"
    subprocess.run([sys.executable, "-c", code], check=True)


def wait_for_text(process: subprocess.Popen[str], text: str) -> None:
    """Read a process's standard error until a line holds `text`."""
    assert process.stderr is not None
    wait_for_line(process.stderr, text)


def wait_for_line(stream: IO[str], text: str) -> None:
    """Read a stream of a process until a line holds `text`."""
    deadline = time.monotonic() + PATIENCE_S
    heard: list[str] = []
    for line in stream:
        if text in line:
            return
        heard.append(line)
        assert time.monotonic() < deadline, f"{text!r} not in time, but\n{''.join(heard[-20:])}"
    pytest.fail(f"the process ended without {text!r}, but said\n{''.join(heard[-20:])}")


def test_companion_finds_the_emitter_and_both_end_cleanly(commands: Commands) -> None:
    port = free_port()
    companion = commands.companion(port, "--once")
    wait_for_text(companion, "waiting for an autopilot")
    simulator = commands.simulator(port)
    _, companion_errors = companion.communicate(timeout=FLIGHT_S)
    assert companion.returncode == 0, companion_errors
    simulator.send_signal(signal.SIGTERM)
    simulator.communicate(timeout=PATIENCE_S)
    assert simulator.returncode == 0

    (result_file,) = commands.directory.glob("flights/*/result.json")
    result = json.loads(result_file.read_text())
    truth = json.loads((commands.directory / "truth.json").read_text())
    east, north = truth["emitter"]["enu_m"][:2]
    error_m = ((result["east_m"] - east) ** 2 + (result["north_m"] - north) ** 2) ** 0.5
    assert error_m <= 1.0
    assert result["latitude_deg"] == pytest.approx(truth["emitter"]["latitude_deg"], abs=2e-5)
    assert result["longitude_deg"] == pytest.approx(truth["emitter"]["longitude_deg"], abs=2e-5)
    assert result["r95_m"] <= 1.0
    assert [change["mode"] for change in truth["mode_changes"]][-1] == "hold"


@pytest.mark.slow
def test_termination_in_flight_hands_the_vehicle_back(commands: Commands) -> None:
    port = free_port()
    companion = commands.companion(port)
    wait_for_text(companion, "waiting for an autopilot")
    simulator = commands.simulator(port)
    wait_for_text(companion, "following the plan")
    began = time.monotonic()
    companion.send_signal(signal.SIGTERM)
    companion.communicate(timeout=PATIENCE_S)
    assert time.monotonic() - began < STOP_S
    assert companion.returncode == 0
    assert simulator.stdout is not None
    wait_for_line(simulator.stdout, "mode offboard -> hold")
    simulator.send_signal(signal.SIGTERM)
    simulator.communicate(timeout=PATIENCE_S)
    truth = json.loads((commands.directory / "truth.json").read_text())
    assert truth["mode_changes"][-1]["mode"] == "hold"


@pytest.mark.slow
def test_taken_port_is_one_clear_line_and_leaves_nothing_behind(commands: Commands) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        _, errors = commands.start("companion", "--connect", f"udp:127.0.0.1:{port}").communicate()
    assert commands.running[0].returncode == 2
    assert len(errors.strip().splitlines()[-1:]) == 1
    assert f"{port} is in use" in errors
    assert "Traceback" not in errors
    assert not list(commands.directory.glob("flights/*"))


@pytest.mark.slow
def test_companion_survives_garbage_and_understands_the_next_heartbeat(commands: Commands) -> None:
    port = free_port()
    companion = commands.start("companion", "--connect", f"udp:127.0.0.1:{port}")
    wait_for_text(companion, "waiting for an autopilot")
    autopilot = MavCodec(1, 1)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0x00030000, 3, 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for seed in range(10_000):
            good = autopilot.encode(heartbeat)
            noise = bytes((seed * 7 + i * i * 31 + seed // 13) % 256 for i in range(seed % 60))
            sender.sendto(noise if seed % 2 else good[: seed % len(good)], ("127.0.0.1", port))
        answers = MavCodec(255, 190).decode(
            answer_to(sender, lambda: autopilot.encode(heartbeat), ("127.0.0.1", port))
        )
    assert answers[0].get_srcComponent() == 191
    assert companion.poll() is None
    companion.send_signal(signal.SIGINT)
    _, errors = companion.communicate(timeout=PATIENCE_S)
    assert companion.returncode == 0
    assert "Traceback" not in errors


def answer_to(sender: socket.socket, frame: Callable[[], bytes], address: tuple[str, int]) -> bytes:
    """Send again until an answer comes: a socket that is full of garbage takes nothing in."""
    deadline = time.monotonic() + PATIENCE_S
    sender.settimeout(0.02)
    while time.monotonic() < deadline:
        sender.sendto(frame(), address)
        with suppress(TimeoutError):
            return sender.recv(2048)
    pytest.fail("no answer")


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_demo_writes_its_result_and_picture(commands: Commands, autopilot: str) -> None:
    options = ("--speed", SPEED, "--seed", "2", "--json", "d.json", "--autopilot", autopilot)
    scenario = str(patient_scenario(autopilot, commands.directory))
    demo = commands.start("companion", "demo", *options, "--scenario", scenario)
    output, errors = demo.communicate(timeout=FLIGHT_S)
    assert demo.returncode == 0, errors
    assert "LOCALISED" in output
    value = json.loads((commands.directory / "d.json").read_text())
    assert value["seed"] == 2
    assert value["state"] == "localised"
    assert value["final_error_m"] <= 1.0
    assert value["time_s"] > 0.0
    assert value["distance_m"] > 50.0
    assert (commands.directory / "track.png").read_bytes().startswith(b"\x89PNG")
    (report,) = commands.directory.glob("flights/*/report.html")
    assert "LOCALISED" in report.read_text()


@pytest.mark.slow
def test_a_demo_whose_log_was_lost_failed(commands: Commands) -> None:
    """RLIMIT_FSIZE stands for a full disk."""
    command = [
        "prlimit",
        "--fsize=100000",
        str(BIN / "companion"),
        "demo",
        "--speed",
        SPEED,
        "--no-plot",
    ]
    demo = subprocess.run(command, cwd=commands.directory, capture_output=True, text=True)
    assert "LOCALISED: " in demo.stdout
    assert "lost to a slow or full disk" in demo.stderr
    assert demo.returncode == 1


@pytest.mark.slow
def test_demo_that_runs_out_of_time_says_so(commands: Commands) -> None:
    (commands.directory / "short.yaml").write_text("time_limit_s: 20.0\n")
    demo = commands.start(
        "companion", "demo", "--speed", SPEED, "--scenario", "short.yaml", "--no-plot"
    )
    output, _ = demo.communicate(timeout=FLIGHT_S)
    assert demo.returncode == 1
    assert "NOT LOCALISED (time limit of 20 s)" in output


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.5, 0.9, 1.5, 3.0])
def test_interrupted_demo_leaves_no_process(commands: Commands, delay_s: float) -> None:
    demo = commands.start("companion", "demo", "--speed", "4", "--no-plot")
    time.sleep(delay_s)
    children = child_processes(demo.pid)
    demo.send_signal(signal.SIGINT)
    _, errors = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode != 0
    assert "Traceback" not in errors
    assert_they_end(children)


@pytest.mark.slow
def test_killed_demo_takes_its_simulator_with_it(commands: Commands) -> None:
    demo = commands.start("companion", "demo", "--speed", "4", "--no-plot")
    wait_for_text(demo, "ready")
    children = child_processes(demo.pid)
    assert children
    demo.kill()
    demo.communicate()
    assert_they_end(children)


def assert_they_end(pids: list[int]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while any(is_alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "a process is left"
        time.sleep(0.05)


def child_processes(pid: int) -> list[int]:
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except FileNotFoundError:
        return []
    return [int(word) for word in text.split()]


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[-1][0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
