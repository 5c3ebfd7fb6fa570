"""Missions with real processes: the companion's own, a vehicle's, and MAVSDK as the operator."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sim_link.lab.mission.over_udp import fly_over_udp
from sim_link.lab.mission.results import MissionResult
from sim_link.lab.mission.script_file import parse_mission
from sim_link.lab.monitor.monitor import WIRE
from tests.e2e.simulator_process import PATIENCE_S
from tests.ports import free_port

pytestmark = pytest.mark.slow

SPEED = 2.0
"""A stall of the machine lasts as many times longer for the vehicle and its companion."""
HOP = """\
name: hop
autopilot: {flavour: %s, parameters: {COM_OBL_RC_ACT: 5}}
time_limit_s: 400
companion: {mission: {altitude_m: 8}}
steps:
  - connect
  - wait_ready
  - arm
  - takeoff: {altitude_m: 8}
  - engage
  - wait_until: {condition: companion.measurements > 5 and vehicle.mode == offboard, limit_s: 20}
%s
  - land
expectations:
  - {name: hears the emitter, appears: {message: RADIO_RANGING, from: autopilot}}
  - {name: stands, holds: vehicle.is_armed == false}
"""


def test_a_hop_with_faults_of_link_vehicle_and_process(tmp_path: Path) -> None:
    faults = """\
  - inject: {kind: wind, east_mps: 2}
  - inject: {kind: link_blackout, duration_s: 3}
  - wait_until: {condition: companion.phase == hold, limit_s: 20}
  - wait_until: {condition: companion.is_in_control and companion.ranging_age_s < 1, limit_s: 20}
  - inject: {kind: companion_killed, down_s: 1}
  - wait_until: {condition: vehicle.mode == hold, limit_s: 10}
  - wait_until: {condition: companion.is_in_control == false, limit_s: 150}
"""
    result = fly_over_udp(
        parse_mission(HOP % ("px4", faults), "hop"), 1, speed=SPEED, keep=tmp_path
    )
    assert result.failed == [], result.record.steps
    assert [str(violated) for violated in result.record.violations] == []
    assert result.record.scope is WIRE
    assert result.record.slack_s >= 0.25 * SPEED
    assert result.record.track
    assert (tmp_path / "flight.tlog").stat().st_size > 10_000
    assert len(list(tmp_path.glob("flights/*/events.jsonl"))) == 2
    assert b'"kind":"estimate"' in result.event_log


def flown_on_a_vehicle_of_others(flavour: str, script: str, folder: Path) -> MissionResult:
    """Return the result of a script on a vehicle that ran before, without a radio."""
    path = folder / "foreign.yaml"
    path.write_text(f"autopilot: {{flavour: {flavour}}}\npayload: {{max_range_m: 0.001}}\n")
    port = free_port()
    command = [sys.executable, "-m", "sim_link", "--scenario", str(path), "--speed", str(SPEED)]
    command += ["--listen", f"127.0.0.1:{free_port()}", "--send-to", f"127.0.0.1:{port}"]
    with subprocess.Popen([*command, "--quiet"], stdout=subprocess.DEVNULL) as vehicle:
        try:
            mission = parse_mission(script, "hop")
            return fly_over_udp(mission, 1, speed=SPEED, connect=f"udpin:127.0.0.1:{port}")
        finally:
            vehicle.send_signal(signal.SIGTERM)
            vehicle.wait(timeout=PATIENCE_S)


def test_a_vehicle_of_others_gets_a_radio_beside_it(tmp_path: Path) -> None:
    # the flavour of the script is not looked at: the vehicle says whose it is
    script = (HOP % ("px4", "")).replace(", from: autopilot", "")
    result = flown_on_a_vehicle_of_others("ardupilot", script, tmp_path)
    assert result.failed == [], result.record.steps
    assert result.flavour == "ardupilot"
    assert [str(violated) for violated in result.record.violations] == []


TAKEN = """\
name: taken
%s
steps: [connect, wait_ready, arm, {pilot_override: {mode: position}}]
"""


@pytest.mark.parametrize(
    ("flavour", "autopilots", "reason"),
    [
        ("ardupilot", "autopilots: [px4]", "the script is for px4, and this is ardupilot"),
        ("ardupilot", "", "in position mode the throttle stick, now at 1000 us, would not hold"),
        ("px4", "", "position mode needs a transmitter, and the autopilot hears none"),
    ],
)
def test_a_vehicle_that_a_script_does_not_fit_is_left_alone(
    flavour: str, autopilots: str, reason: str, tmp_path: Path
) -> None:
    result = flown_on_a_vehicle_of_others(flavour, TAKEN % autopilots, tmp_path)
    assert reason in result.record.skipped
    assert result.verdicts == ()
    assert not result.record.situation.vehicle.is_armed


@pytest.mark.parametrize("argument", ["nonsense.yaml", "broken.yaml"])
def test_a_script_error_never_starts_anything(tmp_path: Path, argument: str) -> None:
    (tmp_path / "broken.yaml").write_text("name: x\nsteps: [{arm: {limit_s: -1}}]\n")
    command = [sys.executable, "-m", "sim_link", "mission", "run", str(tmp_path / argument)]
    done = subprocess.run(
        [*command, "--speed", "4", "--report", str(tmp_path / "reports")],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 2
    assert argument in done.stderr
    assert done.stdout == ""
    assert list(tmp_path.glob("reports/*")) == []


def test_an_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    script = tmp_path / "long.yaml"
    script.write_text("name: long\nsteps: [connect, {wait: {for_s: 200}}]\n")
    command = [sys.executable, "-m", "sim_link", "mission", "run", str(script), "--speed", "1"]
    junit = tmp_path / "junit.xml"
    with subprocess.Popen(
        [*command, "--report", str(tmp_path / "reports"), "--junit", str(junit)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as runner:
        assert runner.stdout is not None
        assert any("step 2/2" in line for line in iter(runner.stdout.readline, ""))
        time.sleep(0.5)
        runner.send_signal(signal.SIGINT)
        output, _ = runner.communicate(timeout=PATIENCE_S)
    assert runner.returncode == 1
    assert "interrupted" in output
    assert "interrupted" in junit.read_text()
    left = subprocess.run(["ps", "-ef"], capture_output=True, text=True, check=True).stdout
    assert str(tmp_path) not in left
