"""Files of earlier schemas are read, and what cannot be is refused with what to do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from companion.cli import main
from companion.config import versions
from companion.config.schema import CompanionConfig, load_config
from companion.config.versions import REMOVED_KEYS, SCHEMA_VERSION, Removed, renew
from companion.errors import ConfigError
from companion.flight_setup import build_session
from companion.io.log_files import FAMILY, FORMAT
from companion.io.radio_recording import VERSION as RECORDING_VERSION
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
)


def test_the_former_defaults_of_the_printed_planner_are_read_and_its_choice_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "site.yaml"
    former = "{step_m: 5.0, crossing_distance_m: 20.0, stop_distance_m: 0.0}"
    path.write_text(f"planner: {{reactive_crossing: {former}}}\n")
    assert load_config(path) == load_config(None)
    path.write_text("planner: {reactive_crossing: {step_m: 4.0}}\n")
    with pytest.raises(ConfigError, match=r"flights use latched_crossing"):
        load_config(path)
    path.write_text("planner: {kind: reactive_crossing}\n")
    with pytest.raises(ConfigError, match=r"planner\.kind"):
        load_config(path)


def test_a_section_that_is_gone_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text("estimation: {adaptation: null}\n")
    assert load_config(path) == load_config(None)
    path.write_text("estimation: {adaptation: {}}\n")
    with pytest.raises(
        ConfigError, match=r"estimation\.adaptation: removed in schema 2; delete it"
    ):
        load_config(path)


RC1: dict[str, dict[str, Any]] = yaml.safe_load(
    (Path(__file__).parents[4] / "tests/data/configs_1.0.0rc1.yaml").read_text()
)


@pytest.mark.parametrize("preset", RC1)
def test_every_file_of_the_first_candidate_is_read_and_shown(
    preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, again = tmp_path / "rc1.yaml", tmp_path / "now.yaml"
    path.write_text(yaml.safe_dump(RC1[preset]))
    config = load_config(path)
    build_session(config)
    assert main(["config", "show", "--config", str(path)]) == 0
    again.write_text(capsys.readouterr().out)
    assert load_config(again) == config


def test_the_defaults_of_the_first_candidate_are_those_of_now(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rc1.yaml"
    path.write_text(yaml.safe_dump(RC1["companion/default"]))
    assert load_config(path) == CompanionConfig()
    assert main(["config", "show", "--changed", "--config", str(path)]) == 0
    assert "# $.limits.step_m was removed in schema 2: delete it\n" in capsys.readouterr().out


MERGED = (
    ("emitter_id: 7", "emitters: {listed: [7]}"),
    ("process: {checkpoint: false}", "process: {resume_max_age_s: null}"),
    ("process: {checkpoint: true, resume_max_age_s: 60}", "process: {resume_max_age_s: 60}"),
    (
        "planner: {search: sector, sector: {radius_m: 45, heading_deg: 0, arrival_radius_m: 1.5}}",
        "planner: {search: sector, pattern: {radius_m: 45.0}}",
    ),
    (
        "planner: {kind: lawnmower, lawnmower: {spacing_m: 30.0, lane_heading_deg: 10.0}}",
        "planner: {kind: survey, search: lawnmower, pattern: {spacing_m: 30.0, heading_deg: 10.0}}",
    ),
)


@pytest.mark.parametrize(("earlier", "now"), MERGED)
def test_keys_that_were_merged_are_carried_over(tmp_path: Path, earlier: str, now: str) -> None:
    old, new = tmp_path / "rc1.yaml", tmp_path / "now.yaml"
    old.write_text(earlier)
    new.write_text(f"schema_version: {SCHEMA_VERSION}\n{now}")
    assert load_config(old) == load_config(new) != CompanionConfig()


def test_the_layout_of_a_pattern_that_is_not_flown_is_dropped() -> None:
    raw = {"planner": {"search": "lawnmower", "sector": {"radius_m": 45.0}}}
    assert renew(raw, "site") == ["planner.sector.radius_m"]
    assert raw["planner"] == {"search": "lawnmower"}


FIXED = [(path, gone) for path, gone in REMOVED_KEYS.items() if path != "estimation.adaptation"]


@pytest.mark.parametrize(("path", "gone"), FIXED)
def test_a_key_that_is_gone_is_refused_with_another_value(path: str, gone: Removed) -> None:
    for value, is_refused in ((gone.default, False), ("other", True)):
        *sections, key = path.split(".")
        raw: dict[str, Any] = {key: value}
        for section in reversed(sections):
            raw = {section: raw}
        if is_refused:
            with pytest.raises(ConfigError, match=rf"^site: \$\.{re.escape(path)}: removed in"):
                renew(raw, "site")
        else:
            assert renew(raw, "site") == [path]
            assert raw == {"schema_version": SCHEMA_VERSION}


def test_a_file_of_the_present_schema_keeps_what_it_has() -> None:
    raw = {"schema_version": SCHEMA_VERSION, "emitter_id": 7}
    assert renew(raw, "site") == []
    assert raw == {"schema_version": SCHEMA_VERSION, "emitter_id": 7}


def test_the_next_schema_migrates_files_of_this_one_by_its_own_step_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(versions, "SCHEMA_VERSION", 3)
    raw = {"schema_version": 2, "emitter_id": 7}
    assert renew(raw, "site") == []
    assert raw == {"schema_version": 3, "emitter_id": 7}
    with pytest.raises(ConfigError, match="removed in schema 2"):
        renew({"limits": {"step_m": 1.0}}, "site")


ONE_OF = f"expected a whole number from 1 to {SCHEMA_VERSION}"
NEXT = SCHEMA_VERSION + 1


@pytest.mark.parametrize(
    ("version", "complaint"),
    [
        (NEXT, f"the file is of schema {NEXT}, and this companion reads up to {SCHEMA_VERSION}; "),
        (0, ONE_OF),
        (True, ONE_OF),
        (f"{SCHEMA_VERSION}", ONE_OF),
    ],
)
def test_an_unknown_version_is_refused_in_one_line(version: object, complaint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        renew({"schema_version": version}, "site.yaml")
    assert str(refused.value).startswith(f"site.yaml: $.schema_version: {complaint}")


def test_a_file_of_a_schema_to_come_is_refused_before_its_keys_are(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(f"schema_version: {SCHEMA_VERSION + 1}\nnew_key: 1\n")
    with pytest.raises(ConfigError, match="install a newer companion-guidance") as refused:
        load_config(path)
    assert "new_key" not in str(refused.value)


def test_the_page_tells_the_versions_that_are() -> None:
    page = (Path(__file__).parents[4] / "docs/versions.md").read_text()
    inputs = FORMAT.removeprefix(FAMILY).decode()
    assert f"| schema {SCHEMA_VERSION} |" in page
    assert f"`flight.inputs` {inputs}, radio recordings {RECORDING_VERSION} |" in page
    assert f"RADIO_RANGING {MAVLink_radio_ranging_message.id} " in page
    assert f"TARGET_ESTIMATE {MAVLink_target_estimate_message.id} " in page
