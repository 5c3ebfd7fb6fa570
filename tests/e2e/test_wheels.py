"""Both distributions, built, installed into fresh environments and flown from there alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from companion import __version__

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
FLIGHT, LABORATORY = "companion-guidance", "companion-sim-link"
LABORATORY_ONLY = {"mavsdk", "dask", "distributed", "filterpy", "scipy", "matplotlib", "rich"}
NAMES = "import importlib.metadata as m; print(*(d.name.lower() for d in m.distributions()))"


def run(*command: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run it as a user does: nothing of this checkout is on the path of modules."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600.0,
        check=False,
    )


def pip(*arguments: str | Path, cwd: Path) -> None:
    done = run(sys.executable, "-m", "pip", *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist of each, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    probe = run(sys.executable, "-m", "pip", "download", "-q", "-d", folder / "probe", "pyserial")
    if probe.returncode != 0:
        pytest.skip("no package index can be reached")
    build_into(folder)
    return folder


def build_into(folder: Path) -> None:
    for project in (ROOT, ROOT / "sim_link"):
        build = (sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, project)
        done = run(*build, cwd=folder)
        assert done.returncode == 0, done.stdout + done.stderr


def environment(folder: Path, wheels: Path, *requirements: str) -> Path:
    """The folder of the commands of a new environment with these packages."""
    assert run(sys.executable, "-m", "venv", "--without-pip", folder).returncode == 0
    to = ("--python", folder / "bin" / "python", "install", "--quiet", "--no-compile")
    pip(*to, "--find-links", wheels, *requirements, cwd=folder)
    return folder / "bin"


@pytest.fixture(scope="module")
def flight(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return environment(tmp_path_factory.mktemp("flight"), wheels, FLIGHT)


@pytest.fixture(scope="module")
def laboratory(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return environment(tmp_path_factory.mktemp("laboratory"), wheels, LABORATORY)


def test_each_wheel_holds_its_own_package_alone(wheels: Path) -> None:
    packages = {"companion_guidance": "companion", "companion_sim_link": "sim_link"}
    for name, package in packages.items():
        wheel = zipfile.ZipFile(wheels / f"{name}-{__version__}-py3-none-any.whl")
        tops = {entry.partition("/")[0] for entry in wheel.namelist()}
        assert tops == {
            package,
            *(f"{name}-{__version__}.{kind}" for kind in ("data", "dist-info")),
        }
        there = {
            str(path.relative_to(ROOT))
            for path in (ROOT / package).rglob("*")
            if path.suffix in {".py", ".j2", ".css", ".js", ".xml", ".typed"}
            and path.name != "hatch_build.py"
        }
        assert there <= set(wheel.namelist())
        assert (wheels / f"{name}-{__version__}.tar.gz").exists()


def test_two_builds_are_the_same_bytes_and_fit_for_an_index(wheels: Path, tmp_path: Path) -> None:
    build_into(tmp_path)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 4
    assert {
        file.name for file in files if file.read_bytes() != (wheels / file.name).read_bytes()
    } == set()
    checked = run(sys.executable, "-m", "twine", "check", "--strict", *files)
    assert checked.returncode == 0, checked.stdout


def test_the_flight_program_alone_brings_nothing_of_the_laboratory(flight: Path) -> None:
    names = set(run(flight / "python", "-c", NAMES).stdout.split())
    assert FLIGHT in names
    assert names & (LABORATORY_ONLY | {LABORATORY}) == set()
    assert "No module named 'sim_link'" in run(flight / "python", "-Ic", "import sim_link").stderr
    for command in (["--help"], ["doctor", "--help"], ["replay", "--help"]):
        done = run(flight / "companion", *command)
        assert (done.returncode, done.stderr) == (0, "")


def test_the_demo_without_the_simulator_says_what_to_install(flight: Path, tmp_path: Path) -> None:
    done = run(flight / "companion", "demo", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "the simulator is not installed" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_both_wheels_bring_man_pages_and_completions(laboratory: Path) -> None:
    for command in ("companion", "sim-link"):
        share = laboratory.parent / "share"
        assert ".TH " in (share / f"man/man1/{command}.1").read_text()
        assert "complete" in (share / f"bash-completion/completions/{command}").read_text()


def test_the_demo_flies_from_both_wheels(laboratory: Path, tmp_path: Path) -> None:
    for command in ("companion", "sim-link", "companion-conformance"):
        done = run(laboratory / command, "--version", cwd=tmp_path)
        assert done.stdout == f"{command} {__version__}\n", done.stderr
    done = run(laboratory / "companion", "demo", "--speed", "1", "--json", "end.json", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "LOCALISED: " in done.stdout
    assert json.loads((tmp_path / "end.json").read_text())["localised"] is True
