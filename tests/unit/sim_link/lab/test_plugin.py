"""The pytest plugin, in an empty folder outside of this repository, as a user has it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sim_link.lab.pytest_plugin import fly_marked

ROOT = Path(__file__).parents[4]
SCRIPT = """\
name: hop
steps: [connect, wait_ready, arm, {takeoff: {altitude_m: 5}}, land]
expectations: [{name: stays low, always: vehicle.height_m < 8}]
"""
TESTS = """\
import pytest


@pytest.mark.mission("hop.yaml", autopilot="ardupilot")
def test_hop(mission_result):
    assert mission_result.is_passed


@pytest.mark.mission("high.yaml")
def test_high():
    pass


@pytest.mark.mission("broken.yaml")
def test_broken():
    pass


@pytest.mark.mission("listed.yaml")
def test_listed(request, mission_result):
    assert mission_result.flavour == request.node.callspec.id


@pytest.mark.mission("ardupilot.yaml")
def test_only(mission_result):
    assert mission_result.flavour == "ardupilot"


@pytest.mark.mission("hop.yaml")
@pytest.mark.mission("ardupilot.yaml")
def test_two():
    pass


def test_others_are_left_alone(faulty_link):
    assert faulty_link.carry(b"x", next(iter(faulty_link._effects)), 0.0) == [(0.0, b"x")]
"""


@pytest.mark.slow
def test_marked_tests_fly_and_fail_by_the_names_of_expectations(tmp_path: Path) -> None:
    (tmp_path / "hop.yaml").write_text(SCRIPT)
    (tmp_path / "high.yaml").write_text(SCRIPT.replace("< 8", "< 2"))
    (tmp_path / "broken.yaml").write_text(
        SCRIPT.replace("- name", "").replace("[connect,", "[fly,")
    )
    (tmp_path / "listed.yaml").write_text(SCRIPT + "autopilots: [px4, ardupilot]\n")
    (tmp_path / "ardupilot.yaml").write_text(SCRIPT + "autopilots: [ardupilot]\n")
    (tmp_path / "test_mine.py").write_text(TESTS)
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-rA",
            "-p",
            "sim_link.lab.pytest_plugin",
            "--strict-markers",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert "1 failed, 5 passed, 2 errors" in done.stdout, done.stdout
    assert "test_listed[px4]" in done.stdout
    assert "test_listed[ardupilot]" in done.stdout
    assert "mission: a test flies one script" in done.stdout
    assert "During handling" not in done.stdout
    assert "stays low: vehicle.height_m < 2 was false at" in done.stdout
    assert "broken.yaml:2: $.steps[0]" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ('"hop.yaml", sead=3', "mission() got an unexpected keyword argument 'sead'"),
        ('"hop.yaml", seed="x"', "mission: seed 'x' is not a whole number from 0 up"),
        ('"hop.yaml", seed=True', "mission: seed True is not a whole number from 0 up"),
        ('"hop.yaml", seed=-1', "mission: seed -1 is not a whole number from 0 up"),
        ('"hop.yaml", autopilot="boeing"', "mission: autopilot 'boeing' is not px4 or ardupilot"),
        ("", "mission() missing 1 required positional argument: 'script'"),
        ('"none.yaml"', "none.yaml: no such file"),
    ],
)
def test_a_wrong_marker_fails_in_one_line_before_anything_flies(
    arguments: str, complaint: str
) -> None:
    mark = eval(f"pytest.mark.mission({arguments})").mark  # as a test of a user writes it
    with pytest.raises(pytest.fail.Exception) as caught:
        fly_marked(mark, ROOT)
    assert complaint in str(caught.value)
    assert caught.value.__cause__ is caught.value.__context__ is None
