"""Commands that pages have for copying do what they are for, if they need no vehicle."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.tools.test_commands_in_pages import PAGES, ROOT
from tests.unit.tools.test_every_command import commands_of

MODULES = {
    "companion": "companion",
    "sim-link": "sim_link",
    "companion-conformance": "sim_link.lab.conformance",
}
AT_ONCE = ("companion config", "companion radio list", "companion-conformance --list")
MISSION = "sim-link mission run configs/missions/canonical.yaml"
FLOWN = ("companion demo --no-plot", "companion replay tests/data", MISSION)
"""Commands that take a while."""
SERIAL = "/dev/ttyAMA0"
"""Address of the autopilot on the pages; it is missing here."""
PATIENCE_S = 300.0


def commands_like(*beginnings: str) -> list[str]:
    """Return all commands of the pages that begin with these words, each once."""
    found = {shlex.join(words) for page in PAGES for words in commands_of(page)}
    return sorted(text for text in found if text.startswith(beginnings))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with what a checkout has for reading, and nothing to write into but itself."""
    for name in ("configs", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The program of this checkout, not compiled, and nothing of this user's."""
    program, *rest = shlex.split(command)
    folders = {f"XDG_{name}_HOME": str(folder / name) for name in ("STATE", "CONFIG", "CACHE")}
    return subprocess.run(
        [sys.executable, "-m", MODULES[program], *rest],
        cwd=folder,
        env={**os.environ, **folders, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


@pytest.mark.parametrize("command", commands_like(*AT_ONCE))
def test_what_only_prints_prints(command: str, folder: Path) -> None:
    done = run(command, folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("command", commands_like(*FLOWN))
def test_what_needs_no_vehicle_comes_to_its_end(command: str, folder: Path) -> None:
    done = run(command, folder)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.skipif(Path(SERIAL).exists(), reason="there is a serial port, and maybe a vehicle")
@pytest.mark.parametrize("command", commands_like(f"companion --connect serial:{SERIAL}"))
def test_a_flight_needs_nothing_but_its_autopilot(command: str, folder: Path) -> None:
    done = run(command, folder)
    assert done.returncode == 2, done.stdout + done.stderr
    assert SERIAL in done.stderr.splitlines()[-1]


def test_there_are_commands_to_run() -> None:
    assert all(commands_like(beginning) for beginning in (*AT_ONCE, *FLOWN))
