"""`companion config`: a configuration as it comes to be, and the schema that editors read."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from companion.cli import main
from companion.config.schema import CompanionConfig, load_config
from companion.errors import EXIT_BAD_INPUT

ROOT = Path(__file__).parents[4]
PRESETS = sorted([*ROOT.glob("configs/companion/**/*.yaml"), *ROOT.glob("configs/radios/*.yaml")])


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["config", *arguments]) == 0
    return capsys.readouterr().out


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text("mission: {altitude_m: 25}\nlimits: {speed_mps: 5.0}\n")
    return path


def test_what_is_shown_is_a_file_that_comes_to_the_same(
    capsys: pytest.CaptureFixture[str], site: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.yaml"
    again.write_text(printed(capsys, "show", "--config", str(site)))
    assert load_config(again) == load_config(site) != CompanionConfig()


def test_each_value_has_its_origin(capsys: pytest.CaptureFixture[str], site: Path) -> None:
    radio, key = "nlink@/dev/ttyUSB0", "signing.key"
    text = printed(
        capsys, "show", "--config", str(site), "--radio", radio, "--signing-key", key, "--json"
    )
    origins = {each["path"]: each["origin"] for each in json.loads(text)}
    assert origins["mission.altitude_m"] == str(site)
    assert origins["limits.speed_mps"] == str(site), "even where it is what the default is"
    assert origins["radios"] == f"--radio {radio}"
    assert origins["link.signing_key_file"] == f"--signing-key {key}"
    rest = {path: origin for path, origin in origins.items() if origin == "default"}
    assert len(rest) == len(origins) - 4
    assert "schema_version" in rest


def test_only_what_is_no_default_is_shown_on_request(
    capsys: pytest.CaptureFixture[str], site: Path
) -> None:
    lines = printed(capsys, "show", "--config", str(site), "--changed").splitlines()
    assert [line.split("#")[0].strip() for line in lines] == [
        "mission:",
        "altitude_m: 25.0",
        "limits:",
        "speed_mps: 5.0",
    ]
    assert printed(capsys, "show", "--changed") == ""


def test_a_file_that_is_wrong_is_refused(capsys: pytest.CaptureFixture[str], site: Path) -> None:
    site.write_text("mission: {altitud_m: 3}")
    assert main(["config", "show", "--config", str(site)]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == (
        f"companion: {site}: $.mission.altitud_m: unknown key; did you mean altitude_m?\n"
    )


@pytest.mark.parametrize(
    ("radio", "complaint"),
    [
        ("name: nlnk", "radios[0] (nlnk): radio nlnk: no such radio; did you mean nlink?"),
        (
            "name: makerfabs_at, options: {hiden: tag}",
            "radios[0] (makerfabs_at): options.hiden: unknown key; did you mean hidden?",
        ),
        (
            "name: makerfabs_at, options: {hidden: tga}",
            "radios[0] (makerfabs_at): options.hidden: tga is none of anchor, tag",
        ),
    ],
)
def test_a_radio_that_a_flight_refuses_is_refused(
    capsys: pytest.CaptureFixture[str], site: Path, radio: str, complaint: str
) -> None:
    site.write_text(f"radios: [{{{radio}}}]")
    assert main(["config", "show", "--config", str(site)]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err.startswith(f"companion: {site}: $.{complaint}")


@pytest.fixture
def jsonschema() -> ModuleType:
    """Return jsonschema, which is not imported at collection: it takes two seconds a worker."""
    return importlib.import_module("jsonschema")


@pytest.fixture
def schema(capsys: pytest.CaptureFixture[str], jsonschema: ModuleType) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(printed(capsys, "schema"))
    jsonschema.Draft202012Validator.check_schema(value)
    return value


def test_every_preset_is_valid_by_the_schema(
    schema: dict[str, Any], jsonschema: ModuleType
) -> None:
    validator = jsonschema.Draft202012Validator(schema)
    for preset in PRESETS:
        validator.validate(yaml.load(preset.read_text(), yaml.CSafeLoader))


@pytest.mark.parametrize(
    "text",
    [
        "mission: {altitud_m: 3}",
        "limits: {speed_mps: 0}",
        "planner: {kind: magic}",
        "radios: [{name: nlink, settings: {bearing_sign: left}}]",
        "schema_version: 99",
    ],
)
def test_what_a_flight_refuses_the_schema_refuses(
    schema: dict[str, Any], jsonschema: ModuleType, text: str
) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(yaml.safe_load(text), schema)


def test_the_schema_says_what_keys_mean(schema: dict[str, Any]) -> None:
    fence = schema["$defs"]["LimitsConfig"]["properties"]["fence_file"]
    assert fence["description"].startswith("File with the fence instead")
