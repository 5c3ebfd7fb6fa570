"""Every command ends as ever, and without a word, when its output is not read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.simulator_process import PATIENCE_S
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
WALK = str(ROOT / "tests" / "data" / "rtt_mall_w9_p1.csv")
SIMULATOR = ("--listen", "127.0.0.1:{port}", "--stop-on-eof", "--seed", "1")
COMMANDS = {
    "companion": (["companion", "--help"], 0),
    "companion replay": (["companion", "replay", WALK], 0),
    "companion, refused": (["companion", "--connect", "nowhere"], 2),
    "sim-link": (["sim_link", *SIMULATOR], 0),
    "sim-link mission run": (["sim_link", "mission", "run", "{folder}/m.yaml"], 0),
    "sim-link mission run, failed": (["sim_link", "mission", "run", "{folder}/fails.yaml"], 1),
    "sim-link radio": (["sim_link", "radio", "--help"], 0),
    "sim-link proxy": (["sim_link", "proxy", "--help"], 0),
    "companion-conformance": (["sim_link.lab.conformance", "--list"], 0),
}
WORKERS = {"listeners", "tick_bench"}
"""A bench starts them and reads all that they write; `listeners` imports nothing of the project."""
TOOLS = sorted(
    path
    for path in (ROOT / "tools").rglob("*.py")
    if "__main__" in path.read_text() and path.stem not in WORKERS
)
MISSION = "name: same\nsteps: [connect]\n"
FAILING = MISSION + "expectations: [{name: late, time_s: {at_least: 999}}]\n"


def unread(command: list[str]) -> tuple[int, str]:
    """Return the exit code of a process whose standard output is closed, and its errors."""
    process = subprocess.Popen(
        [sys.executable, *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=dict(os.environ, PYTHONPATH=str(ROOT)),
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    with process.stderr as errors:
        said = errors.read()
    return process.wait(timeout=PATIENCE_S), said


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_without_a_reader_ends_as_ever(name: str, tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(MISSION)
    (tmp_path / "fails.yaml").write_text(FAILING)
    arguments, code = COMMANDS[name]
    filled = [text.format(port=free_port(), folder=tmp_path) for text in arguments]
    found, said = unread(["-m", *filled])
    assert found == code
    assert "Error" not in said
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize("path", TOOLS, ids=lambda path: path.stem)
def test_a_tool_without_a_reader_ends_as_ever(path: Path) -> None:
    text = path.read_text()
    assert 'if __name__ == "__main__":\n    ignore_broken_pipe()\n' in text
    if "Parser" in text:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        assert unread(["-m", module, "--help"]) == (0, "")
