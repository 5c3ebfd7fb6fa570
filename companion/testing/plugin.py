"""The pytest plugin: a marker that flies a mission, and fixtures to build tests of one's own.

Everything heavy is imported when it is used, because every pytest on a machine where the project is
installed loads the plugin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from sim_link.faults.faulty_link import FaultyLink
    from sim_link.mission.children import Child
    from sim_link.mission.result import MissionResult

MARKER = "mission"
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
    if marker is None or not marker.args:
        pytest.fail('mission_result needs @pytest.mark.mission("script.yaml")', pytrace=False)
    from companion.errors import CompanionError
    from sim_link.mission.campaign import with_autopilot
    from sim_link.mission.in_memory import fly_in_memory
    from sim_link.mission.script_file import load_mission

    path = request.path.parent / str(marker.args[0])
    try:
        mission = load_mission(path)
        if marker.kwargs.get("autopilot") is not None:
            mission = with_autopilot(mission, marker.kwargs["autopilot"])
        return fly_in_memory(mission, int(marker.kwargs.get("seed", 0)), str(path))
    except CompanionError as error:
        pytest.fail(str(error), pytrace=False)


@pytest.fixture(autouse=True)
def _marked_mission(request: pytest.FixtureRequest) -> None:
    """A marked test fails by the names of the expectations that were not met."""
    if request.node.get_closest_marker(MARKER) is None:
        return
    result = request.getfixturevalue("mission_result")
    lines = [f"{verdict.name}: {verdict.found}" for verdict in result.failed]
    if lines:
        pytest.fail("\n".join([result.title, *lines]), pytrace=False)


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
