"""The pytest plugin: a marker that flies a mission, and fixtures to build tests of one's own.

Everything heavy is imported when it is used, because every pytest on a machine where the project is
installed loads the plugin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

import pytest

if TYPE_CHECKING:
    from sim_link.faults.faulty_link import FaultyLink
    from sim_link.mission.children import Child
    from sim_link.mission.result import MissionResult
    from sim_link.mission.script import Mission

MARKER = "mission"
FLIGHT = pytest.StashKey["MissionResult"]()
StartCompanion = Callable[..., "Child"]


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    text = "mission(script, seed=0, autopilot=None): fly a mission script in lockstep"
    config.addinivalue_line("markers", text)


@pytest.fixture
def mission_result(request: pytest.FixtureRequest) -> MissionResult:
    """The flight of the test's `@pytest.mark.mission("script.yaml")`, met or not.

    The script is looked for beside the test.
    """
    marker = request.node.get_closest_marker(MARKER)
    if marker is None:
        pytest.fail('mission_result needs @pytest.mark.mission("script.yaml")', pytrace=False)
    result = request.node.stash[FLIGHT] = flown(marker, request.path.parent)
    return result


@pytest.fixture(autouse=True)
def _marked_mission(request: pytest.FixtureRequest) -> None:
    """A marked test flies, whether or not it wants to see the result."""
    if request.node.get_closest_marker(MARKER) is not None:
        request.getfixturevalue("mission_result")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """A marked test fails by the names of the expectations that were not met."""
    result = item.stash.get(FLIGHT, None)
    if result is not None and not result.is_passed:
        lines = [f"{verdict.name}: {verdict.found}" for verdict in result.failed]
        pytest.fail("\n".join([result.title, *lines]), pytrace=False)


def flown(marker: pytest.Mark, folder: Path) -> MissionResult:
    """The flight that a marker asks for; a marker or script that is wrong fails the test.

    Args:
        marker: Of the test.
        folder: Where its script is.
    """
    from companion.errors import CompanionError
    from sim_link.mission.in_memory import fly_in_memory

    problem = ""
    try:
        mission, seed, path = _wanted(marker, folder)
    except (CompanionError, TypeError, ValueError) as error:
        problem = str(error)
    if problem:  # outside of `except`, so that pytest shows the one line only
        pytest.fail(problem, pytrace=False)
    return fly_in_memory(mission, seed, str(path))


def _wanted(marker: pytest.Mark, folder: Path) -> tuple[Mission, int, Path]:
    """Script, seed and place of the script that a marker names.

    Raises:
        CompanionError: The script is wrong.
        TypeError: An argument is missing, or there is no such argument.
        ValueError: An argument has no value that there could be.
    """
    from sim_link.autopilot.scenario import FlavourName
    from sim_link.mission.campaign import check_flyable, with_autopilot
    from sim_link.mission.script_file import load_mission

    def mission(
        script: str, seed: object = 0, autopilot: object = None
    ) -> tuple[Mission, int, Path]:
        """The arguments of the marker, checked."""
        if not isinstance(seed, int) or seed < 0:
            raise ValueError(f"mission: seed {seed!r} is not a whole number from 0 up")
        if autopilot not in (None, *get_args(FlavourName)):
            known = " or ".join(get_args(FlavourName))
            raise ValueError(f"mission: autopilot {autopilot!r} is not {known}")
        path = folder / str(script)
        loaded = load_mission(path)
        if autopilot is not None:
            loaded = with_autopilot(loaded, cast(FlavourName, autopilot))
        check_flyable(loaded, str(path))
        return loaded, seed, path

    mission.__qualname__ = MARKER  # what Python calls it where arguments are missing
    return mission(*marker.args, **marker.kwargs)


@pytest.fixture
def faulty_link() -> FaultyLink:
    """A wire without faults yet; `add(fault, began_s)` gives it some."""
    from sim_link.faults.faulty_link import FaultyLink
    from sim_link.faults.schedule import Schedule

    return FaultyLink(Schedule(), 0)


@pytest.fixture
def sim_vehicle(tmp_path: Path) -> Iterator[str]:
    """A `sim-link` process of its own; the link on which it is heard, for `--connect`."""
    from companion.demo.simulator import HOST, free_udp_port
    from sim_link.mission.children import Child

    port = free_udp_port()
    arguments = ["-m", "sim_link", "--stop-on-eof", "--listen", f"{HOST}:{free_udp_port()}"]
    child = Child(
        "sim-link", [*arguments, "--send-to", f"{HOST}:{port}"], tmp_path / "sim-link.log"
    )
    child.start()
    try:
        yield f"udpin:{HOST}:{port}"
    finally:
        child.stop()


@pytest.fixture
def companion_process(tmp_path: Path) -> Iterator[StartCompanion]:
    """Starts `companion` with arguments of one's own; its output is in companion.log."""
    from sim_link.mission.children import Child

    started: list[Child] = []

    def start(*arguments: str) -> Child:
        """Start one more companion with these arguments."""
        log = tmp_path / f"companion{len(started) or ''}.log"
        child = Child("companion", ["-m", "sim_link.mission.leashed", *arguments], log)
        child.start()
        started.append(child)
        return child

    try:
        yield start
    finally:
        for child in started:
            child.stop()
