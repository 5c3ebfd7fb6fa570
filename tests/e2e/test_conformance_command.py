"""`companion-conformance` against a running simulator that is stopped, killed or started again."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.simulator_process import PATIENCE_S
from tests.ports import free_port

pytestmark = pytest.mark.slow
CHANGING = "parameters.[ls]*"
"""Lists, sets and asks: some twenty seconds."""
NOTHING = "# parameters that differ from their defaults\n"
IN_A_RULE_S = 0.5
FLYING = "flights.[ls]*"


class Bench:
    """A simulated vehicle over UDP (PX4) or TCP (ArduPilot), and the command."""

    def __init__(self, flavour: str, folder: Path) -> None:
        self.folder, self.report = folder, folder / "report.json"
        port = free_port()
        self._vehicle = ["--autopilot", flavour, "--parameters", str(folder / "parameters.txt")]
        if flavour == "px4":
            self.url = f"udpin:127.0.0.1:{port}"
            self._vehicle += ["--send-to", f"127.0.0.1:{port}"]
        else:
            self.url = f"tcp:127.0.0.1:{port}"
            self._vehicle += ["--link", f"tcpin:127.0.0.1:{port}"]
        self._vehicle += ["--listen", f"127.0.0.1:{free_port()}", "--quiet"]
        self._stack = ExitStack()

    def close(self) -> None:
        self._stack.close()

    def _started(self, *command: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", *command], stdout=subprocess.PIPE, text=True, cwd=self.folder
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        assert process.stdout is not None
        self._stack.callback(process.stdout.close)
        return process

    def boot(self) -> subprocess.Popen[str]:
        vehicle = self._started("sim_link", *self._vehicle)
        assert vehicle.stdout is not None
        assert vehicle.stdout.readline()
        return vehicle

    def try_rules(self, pattern: str, *options: str) -> subprocess.Popen[str]:
        arguments = ["--url", self.url, "--only", pattern, "--json", str(self.report), *options]
        return self._started("sim_link.lab.conformance", *arguments)

    def end_of(self, trial: subprocess.Popen[str]) -> tuple[int, list[str], dict[str, Any]]:
        """Exit code, lines and report."""
        output, _ = trial.communicate(timeout=PATIENCE_S)
        return trial.returncode, output.splitlines(), json.loads(self.report.read_text())


def lines_until(trial: subprocess.Popen[str], part: str) -> None:
    assert trial.stdout is not None
    assert any(part in text for text in iter(trial.stdout.readline, ""))


@pytest.fixture(params=["px4", "ardupilot"])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    made = Bench(request.param, tmp_path)
    yield made
    made.close()


def stored(bench: Bench) -> str:
    """The parameters that the vehicle would boot with."""
    path = bench.folder / "parameters.txt"
    return path.read_text() if path.exists() else ""


def assert_only_silent(report: dict[str, Any]) -> None:
    """Assert that the silence is reported, and that nothing is left behind."""
    assert [text.partition(" after ")[0] for text in report["problems"]] == ["it fell silent"]


def test_a_stopped_vehicle_is_waited_for(bench: Bench) -> None:
    vehicle = bench.boot()
    trial = bench.try_rules(CHANGING, "--allow-changes")
    lines_until(trial, "parameters.")
    time.sleep(IN_A_RULE_S)
    vehicle.send_signal(signal.SIGSTOP)
    lines_until(trial, "for it to come back")
    vehicle.send_signal(signal.SIGCONT)
    code, lines, report = bench.end_of(trial)
    assert (code, report["summary"]) == (1, lines[-1])
    assert_only_silent(report)
    assert "NOT RUN" not in {rule["verdict"] for rule in report["rules"]}


def test_a_killed_vehicle_that_is_started_again_gets_its_parameters_back(bench: Bench) -> None:
    vehicle = bench.boot()
    trial = bench.try_rules(CHANGING, "--allow-changes")
    lines_until(trial, "parameters.set")
    time.sleep(IN_A_RULE_S)
    vehicle.kill()
    lines_until(trial, "for it to come back")
    bench.boot()
    code, lines, report = bench.end_of(trial)
    assert (code, report["summary"]) == (1, lines[-1])
    assert_only_silent(report)
    assert stored(bench) in ("", NOTHING)


def test_ctrl_c_in_flight_lands_and_tells(bench: Bench) -> None:
    bench.boot()
    trial = bench.try_rules(FLYING, "--allow-flight")
    time.sleep(14.0)
    trial.send_signal(signal.SIGINT)
    code, lines, report = bench.end_of(trial)
    assert code == 1
    assert any(text.startswith("... stopped: putting the vehicle in order") for text in lines)
    assert "not run" in lines[-1]
    assert report["problems"] == []


def test_a_report_is_written_although_its_output_is_not_read(bench: Bench) -> None:
    bench.boot()
    trial = bench.try_rules("commands.[a-h]*")
    assert trial.stdout is not None
    trial.stdout.readline()
    trial.stdout.close()
    assert trial.wait(timeout=PATIENCE_S) in (0, 3)
    assert json.loads(bench.report.read_text())["rules"]
