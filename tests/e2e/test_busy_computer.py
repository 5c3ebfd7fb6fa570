"""Processes that get no processor for a while, as on a computer with much else to do."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.e2e.simulator_process import PATIENCE_S

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
STALL_S = 1.2
"""At four times real time nearly five seconds of flight: the mode is lost after one."""
FLIGHT_S = 300.0
CANONICAL = Path(__file__).parents[2] / "configs/missions/canonical.yaml"


def child_of(pid: int, command: str) -> int:
    """The child process with this in its command line."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            if command in Path(f"/proc/{child}/cmdline").read_text():
                return int(child)
        time.sleep(0.05)
    pytest.fail(f"{command} was not started")


def starve(pid: int) -> None:
    """Give a process no processor for a while, and then some again."""
    os.kill(pid, signal.SIGSTOP)
    time.sleep(STALL_S)
    os.kill(pid, signal.SIGCONT)
    time.sleep(STALL_S)


def test_a_demo_localises_although_its_processes_are_starved_in_turn(tmp_path: Path) -> None:
    command = [str(BIN / "companion"), "demo", "--speed", "4", "--no-plot", "--json", "end.json"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as demo:
        assert demo.stderr is not None
        lines: list[str] = []
        for line in demo.stderr:
            lines.append(line)
            if "following the plan" in line:
                break
        reader = threading.Thread(target=lambda: lines.extend(demo.stderr or ()))
        reader.start()
        for pid in (child_of(demo.pid, "sim_link"), demo.pid):
            starve(pid)
        assert demo.stdout is not None
        output = demo.stdout.read()
        demo.wait(FLIGHT_S)
        reader.join()
    assert output.startswith("LOCALISED"), output + "".join(lines)
    assert demo.returncode == 0
    assert re.search(r"this computer is too busy for 4x: continuing at 2x", "".join(lines))


def test_a_mission_passes_although_its_processes_are_starved_in_turn(tmp_path: Path) -> None:
    command = [str(BIN / "sim-link"), "mission", "run", str(CANONICAL), "--speed", "4"]
    command += ["--autopilot", "px4"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as mission:
        assert mission.stdout is not None
        lines: list[str] = []
        for line in mission.stdout:
            lines.append(line)
            if "wait_until" in line:
                break
        for pid in (
            child_of(mission.pid, "--stop-on-eof"),
            child_of(mission.pid, "supervised_companion"),
            mission.pid,
        ):
            starve(pid)
        lines += mission.stdout
        mission.wait(FLIGHT_S)
    assert mission.returncode == 0, "".join(lines)
    assert any("this computer is too busy for speed 4: slowed to" in line for line in lines)
