"""The fixtures of the pytest plugin, used as a user does, in a folder outside of the project."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TESTS = """\
import time

import pytest


@pytest.mark.sim_vehicle(autopilot="ardupilot", seed=3, speed=2)
def test_a_companion_meets_a_vehicle(sim_vehicle, companion_process, tmp_path):
    companion = companion_process("--connect", sim_vehicle)
    deadline_s = time.monotonic() + 120.0
    while "ready: switch to" not in (tmp_path / "companion.log").read_text():
        assert companion.is_alive
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    assert (tmp_path / "sim-link.log").read_text().startswith("sim-link: ardupilot, ")
    assert len(list(tmp_path.glob("flights/*/events.jsonl"))) == 1


@pytest.mark.sim_vehicle(scenario="none.yaml")
def test_a_vehicle_without_a_scenario(sim_vehicle): ...


@pytest.mark.sim_vehicle(sead=1)
def test_a_vehicle_that_is_spelt_wrong(sim_vehicle): ...


def test_a_link_that_breaks(faulty_link):
    from sim_link.lab.faults.fault_models import LinkBlackout
    from sim_link.lab.observer import Lane

    assert faulty_link.carry(b"frame", Lane.TO_VEHICLE, 1.0) == [(1.0, b"frame")]
    faulty_link.add(LinkBlackout(), 2.0)
    assert faulty_link.carry(b"frame", Lane.TO_VEHICLE, 3.0) == []


def test_without_a_mission(mission_result): ...
"""


def test_processes_and_links_are_there_for_tests_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text(TESTS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rA", "-q"],
        cwd=tmp_path,
        env=os.environ | {"XDG_STATE_HOME": str(tmp_path / "state")},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    said = done.stdout + done.stderr
    assert "PASSED test_own.py::test_a_companion_meets_a_vehicle" in said, said
    assert "none.yaml: no such file" in said, said
    assert "sim_vehicle() got an unexpected keyword argument 'sead'" in said, said
    assert not (tmp_path / "flights").exists()
    assert "PASSED test_own.py::test_a_link_that_breaks" in said, said
    assert "mission_result needs @pytest.mark.mission" in said, said
