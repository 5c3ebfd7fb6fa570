from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[4] / "tools"


def _run(tool: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TOOLS / tool), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("bench.py", ["filters"]),
        ("bench.py", ["planners"]),
        ("verify_estimation.py", []),
    ],
)
def test_a_file_that_cannot_be_written_is_one_line(
    tool: str, arguments: list[str], tmp_path: Path
) -> None:
    done = _run(tool, *arguments, "--json", str(tmp_path / "nowhere" / "figures.json"))
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "nowhere" in done.stderr


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("bench.py", ["filters", "--rounds", "0"]),
        ("bench.py", ["planners", "--rounds", "0"]),
        ("bench.py", ["filter"]),
        ("bench.py", []),
        ("verify_estimation.py", ["--runs", "0"]),
        ("verify_estimation.py", ["--seed", "-1"]),
        ("verify_estimation.py", ["--only", "planners"]),
    ],
)
def test_bad_input_is_refused(tool: str, arguments: list[str]) -> None:
    done = _run(tool, *arguments)
    assert done.returncode == 2
    assert "error:" in done.stderr


def test_figures_are_printed_and_written(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    done = _run("bench.py", "filters", "--rounds", "1", "--json", str(path))
    assert done.returncode == 0
    assert "filterpy update" in done.stdout
    assert json.loads(path.read_text())["ratios"]


def test_costs_of_planners_are_printed_and_written(tmp_path: Path) -> None:
    path = tmp_path / "costs.json"
    done = _run("bench.py", "planners", "--rounds", "1", "--json", str(path))
    assert done.returncode == 0
    assert "Proposed (Latched)" in done.stdout
    assert "FIM over reactive" in done.stdout
    figures = json.loads(path.read_text())
    assert figures["costs"]
    assert figures["fim_over_reactive"]["paper"] == 23.0
