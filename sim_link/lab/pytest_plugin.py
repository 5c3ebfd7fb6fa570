"""Pytest plugin: a marker that flies a mission, and fixtures for other tests.

Heavy imports are deferred, because every pytest run in an environment with this project loads the
plugin.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast, get_args

import pytest

if TYPE_CHECKING:
    from companion.io.child_processes import ChildProcess
    from sim_link.autopilot.scenario import FlavourName
    from sim_link.lab.faults.faulty_link import FaultyLink
    from sim_link.lab.mission.results import MissionResult
    from sim_link.lab.mission.script import Mission

MARKER, VEHICLE = "mission", "sim_vehicle"
START_S = 150.0
"""Real time that a process may take to start; the first one of all compiles."""
FLIGHT = pytest.StashKey["MissionResult"]()
T = TypeVar("T")
StartCompanion = Callable[..., "ChildProcess"]


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    text = "mission(script, seed=0, autopilot=None): fly a mission script in lockstep"
    config.addinivalue_line("markers", text)
    text = "sim_vehicle(scenario=None, seed=0, autopilot=None, speed=1): what sim_vehicle flies"
    config.addinivalue_line("markers", text)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make a test for each autopilot that the script lists."""
    marker = metafunc.definition.get_closest_marker(MARKER)
    flavours = () if marker is None else _listed(marker, metafunc.definition.path.parent)
    if len(flavours) > 1:
        metafunc.parametrize("_mission_autopilot", flavours, indirect=True)


@pytest.fixture
def _mission_autopilot(request: pytest.FixtureRequest) -> FlavourName | None:
    """Return the one of several that the script lists, None where there are not several."""
    return getattr(request, "param", None)


@pytest.fixture
def mission_result(
    request: pytest.FixtureRequest, _mission_autopilot: FlavourName | None
) -> MissionResult:
    """Return the flight of the test's `@pytest.mark.mission("script.yaml")`, passed or not."""
    markers = list(request.node.iter_markers_with_node(MARKER))
    if not markers:
        pytest.fail('mission_result needs @pytest.mark.mission("script.yaml")', pytrace=False)
    closest, marker = markers[0]
    if sum(node is closest for node, _ in markers) > 1:
        pytest.fail("mission: a test flies one script; write another test", pytrace=False)
    result = fly_marked(marker, request.path.parent, _mission_autopilot)
    request.node.stash[FLIGHT] = result
    return result


@pytest.fixture(autouse=True)
def _marked_mission(
    request: pytest.FixtureRequest,
    _mission_autopilot: FlavourName | None,  # so that pytest knows it for every test
) -> None:
    """Fly the mission of a marked test, whether or not it uses the result."""
    if request.node.get_closest_marker(MARKER) is not None:
        request.getfixturevalue("mission_result")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Fail a marked test with the names of the unmet expectations."""
    result = item.stash.get(FLIGHT, None)
    if result is not None and not result.is_passed:
        lines = [f"{verdict.name}: {verdict.found}" for verdict in result.failed]
        pytest.fail("\n".join([result.title, *lines]), pytrace=False)


def fly_marked(
    marker: pytest.Mark, folder: Path, flavour: FlavourName | None = None
) -> MissionResult:
    """Return the flight of a marker, of one of its autopilots; a wrong marker fails the test."""
    from sim_link.lab.mission.in_memory import fly_in_memory

    mission, seed, path = _or_fail(lambda: _wanted(marker, folder, flavour))
    return fly_in_memory(mission, seed, str(path))


def _or_fail(find: Callable[[], T]) -> T:
    """Return the result of `find`; its error fails the test with one line."""
    from companion.errors import CompanionError

    try:
        return find()
    except (CompanionError, TypeError, ValueError) as error:
        problem = str(error).rpartition(".<locals>.")[2]
    pytest.fail(problem, pytrace=False)  # outside of `except`, or pytest shows more than the line


def _listed(marker: pytest.Mark, folder: Path) -> tuple[FlavourName, ...]:
    """Return the autopilots that a marker leaves to its script; none if it is wrong."""
    from companion.errors import CompanionError
    from sim_link.lab.mission.batch import flavours_of
    from sim_link.lab.mission.script_file import load_mission

    try:
        script, _, autopilot = _arguments_of(marker)
        path = folder / str(script)
        return flavours_of(load_mission(path), str(path)) if autopilot is None else ()
    except (CompanionError, TypeError, ValueError):
        return ()


def _arguments_of(marker: pytest.Mark) -> tuple[str, object, object]:
    """Return the script, seed and autopilot of a marker; `TypeError`: its arguments are wrong."""

    def mission(
        script: str, seed: object = 0, autopilot: object = None
    ) -> tuple[str, object, object]:
        return script, seed, autopilot

    mission.__qualname__ = MARKER  # what Python calls it where arguments are missing
    return mission(*marker.args, **marker.kwargs)


def _wanted(
    marker: pytest.Mark, folder: Path, flavour: FlavourName | None
) -> tuple[Mission, int, Path]:
    """Parse a mission marker; a wrong one raises `CompanionError`, `TypeError` or `ValueError`."""
    from sim_link.autopilot.scenario import FlavourName
    from sim_link.lab.mission.batch import check_flyable, flavours_of, with_autopilot
    from sim_link.lab.mission.script_file import load_mission

    script, seed, autopilot = _arguments_of(marker)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"mission: seed {seed!r} is not a whole number from 0 up")
    if autopilot not in (None, *get_args(FlavourName)):
        known = " or ".join(get_args(FlavourName))
        raise ValueError(f"mission: autopilot {autopilot!r} is not {known}")
    path = folder / str(script)
    mission = load_mission(path)
    flavours = flavours_of(mission, str(path))
    wanted = cast("FlavourName | None", autopilot) or flavour
    if wanted is None and len(flavours) > 1:
        raise ValueError(f"mission: {script} lists {', '.join(flavours)}: give one autopilot")
    mission = with_autopilot(mission, wanted or flavours[0])
    check_flyable(mission, str(path))
    return mission, seed, path


@pytest.fixture
def faulty_link() -> FaultyLink:
    """Return a wire without faults yet; `add(fault, began_s)` gives it some."""
    from sim_link.lab.faults.fault_models import Schedule
    from sim_link.lab.faults.faulty_link import FaultyLink

    return FaultyLink(Schedule(), 0)


@pytest.fixture
def sim_vehicle(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Start a `sim-link` process; yield its link, for `--connect`.

    `@pytest.mark.sim_vehicle(scenario="calm.yaml", seed=3, autopilot="ardupilot", speed=4)` says
    what it flies; the scenario is looked for next to the test.
    """
    from companion.io.child_processes import HOST, ChildProcess, free_udp_port

    port = free_udp_port()
    arguments = ["-m", "sim_link", "--stop-on-eof", "--listen", f"{HOST}:{free_udp_port()}"]
    arguments += ["--send-to", f"{HOST}:{port}"]
    marker = request.node.get_closest_marker(VEHICLE)
    if marker is not None:
        arguments += _vehicle_options(marker, request.path.parent)
    child = ChildProcess("sim-link", arguments, tmp_path / "sim-link.log")
    child.start()
    try:
        deadline_s = time.monotonic() + START_S
        while child.is_alive and "listening on" not in child.first_words:
            if time.monotonic() > deadline_s:
                pytest.fail(f"sim_vehicle: no start within {START_S:g} s", pytrace=False)
            time.sleep(0.05)
        if not child.is_alive:
            pytest.fail(f"sim_vehicle: {child.last_words}", pytrace=False)
        yield f"udpin:{HOST}:{port}"
    finally:
        child.stop()


def _vehicle_options(marker: pytest.Mark, folder: Path) -> list[str]:
    """Convert a vehicle marker to options of `sim-link`, which checks the values."""

    def sim_vehicle(
        *,
        scenario: object = None,
        seed: object = None,
        autopilot: object = None,
        speed: object = None,
    ) -> dict[str, object]:
        path = None if scenario is None else folder / str(scenario)
        return {"scenario": path, "seed": seed, "autopilot": autopilot, "speed": speed}

    options = _or_fail(lambda: sim_vehicle(*marker.args, **marker.kwargs))
    given = [(name, value) for name, value in options.items() if value is not None]
    return [text for name, value in given for text in (f"--{name}", str(value))]


@pytest.fixture
def companion_process(tmp_path: Path) -> Iterator[StartCompanion]:
    """Yield a function that starts `companion`; by default its files are below `tmp_path`."""
    from companion.io.child_processes import ChildProcess

    started: list[ChildProcess] = []

    def start(*arguments: str) -> ChildProcess:
        if not any(text.startswith("--config") for text in arguments):
            arguments = ("--config", str(_default_config(tmp_path)), *arguments)
        log = tmp_path / f"companion{len(started) or ''}.log"
        module = "sim_link.lab.supervised_companion"
        child = ChildProcess("companion", ["-m", module, *arguments], log)
        child.start()
        started.append(child)
        return child

    try:
        yield start
    finally:
        for child in started:
            child.stop()


def _default_config(folder: Path) -> Path:
    """Return a configuration with the storage locations only."""
    kept = {
        "log": {"directory": str(folder / "flights")},
        "process": {"state_directory": str(folder / "state")},
    }
    path = folder / "companion.yaml"
    path.write_text(json.dumps(kept), encoding="utf-8")  # JSON is YAML, too
    return path
