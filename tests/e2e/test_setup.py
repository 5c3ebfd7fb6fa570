"""`companion setup` next to a running vehicle: files written and examined, settings listed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.config.schema import load_config
from tests.e2e.simulator_process import PATIENCE_S, running_simulator
from tests.ports import free_port

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_vehicle_is_set_up_examined_and_the_setup_undone(flavour: str, tmp_path: Path) -> None:
    address = f"127.0.0.1:{free_port()}"
    etc, environment = tmp_path / "etc", dict(os.environ, XDG_STATE_HOME=str(tmp_path))
    command = [sys.executable, "-m", "companion", "setup", "--directory", str(etc)]
    options = ["--autopilot", flavour, "--connect", f"udp:{address}"]

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *more],
            cwd=tmp_path,
            env=dict(environment, NUMBA_DISABLE_JIT="1"),
            capture_output=True,
            text=True,
            timeout=2.0 * PATIENCE_S,
        )

    with running_simulator(flavour, 1.0, None, "--send-to", address):
        made = run(*options)
    assert made.returncode == 0, made.stdout + made.stderr
    assert "fit to fly" in made.stdout
    assert f"{'PX4' if flavour == 'px4' else 'ArduPilot'} multicopter, system 1" in made.stdout
    assert "set in PX4" in made.stdout or "set in ArduPilot" in made.stdout
    assert load_config(etc / "companion.yaml")
    assert run("--remove").returncode == 0
    assert list(etc.iterdir()) == []
