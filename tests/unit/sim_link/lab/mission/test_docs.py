"""docs/missions.md names everything that a script may say, as the records have it."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from sim_link.autopilot.scenario import Scenario
from sim_link.lab.mission.conditions import FIELDS
from sim_link.lab.mission.script import STEP_KINDS, Expectation, Mission
from sim_link.lab.mission.script_file import load_mission, parse_mission

ROOT = Path(__file__).parents[5]
PAGE = (ROOT / "docs" / "missions.md").read_text(encoding="utf-8")


def row(name: str) -> str:
    """The line of a table that begins with a name."""
    found = re.search(rf"^\| `{re.escape(name)}`.*$", PAGE, re.MULTILINE)
    assert found, name
    return found[0]


@pytest.mark.parametrize("name", STEP_KINDS)
def test_every_step_is_reported_with_its_keys_and_defaults(name: str) -> None:
    for field in msgspec.structs.fields(STEP_KINDS[name]):
        if field.default is msgspec.NODEFAULT:
            assert f"`{field.encode_name}`" in row(name)
        else:
            default = "null" if field.default is None else field.default
            assert f"`{field.encode_name}` ({default})" in row(name)


def test_every_expectation_field_and_key_is_reported() -> None:
    own = {field.encode_name for field in msgspec.structs.fields(Mission)}
    scenario = {field.encode_name for field in msgspec.structs.fields(Scenario)}
    kinds = {field.encode_name for field in msgspec.structs.fields(Expectation)} - {"name"}
    for name in (own - scenario) | kinds | FIELDS.keys():
        assert f"`{name}`" in PAGE, name
    for name, info in FIELDS.items():
        for word in info.words:
            assert word in row(name)


def test_the_example_is_a_mission() -> None:
    example = re.search(r"```yaml\n# hello\.yaml\n(.*?)```", PAGE, re.DOTALL)
    assert example
    assert parse_mission(example[1], "hello.yaml").name == "hello"


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "missions").glob("*.yaml")), ids=str)
def test_every_mission_of_the_library_is_one_and_watches_the_invariants(path: Path) -> None:
    mission = load_mission(path)
    assert mission.about
    assert any(each.kind == "violations" for each in mission.expectations)
