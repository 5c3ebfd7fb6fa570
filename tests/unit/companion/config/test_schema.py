"""The companion's configuration: presets, defaults and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

from companion.config.loader import load_yaml, parse_yaml
from companion.config.schema import (
    CompanionConfig,
    CrossingKind,
    PatternKind,
    inconsistency,
    load_config,
)
from companion.errors import ConfigError
from companion.estimation.filters.kalman import FilterKind
from companion.flight_setup import build_planner, build_session
from companion.link.interface import LinkParams
from companion.planning.crossing import LatchedCrossing
from companion.planning.fim import FimPlanner
from companion.planning.search import SearchPlanner, SearchThenCross

ROOT = Path(__file__).parents[4]
PRESETS = sorted((ROOT / "configs/companion").rglob("*.yaml"))


def test_default_preset_spells_out_the_defaults() -> None:
    assert load_yaml(ROOT / "configs/companion/default.yaml", CompanionConfig) == CompanionConfig()
    assert load_config(None) == CompanionConfig()


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/pilot")
    file = tmp_path / "flight.yaml"
    file.write_text("log: {directory: ~/logs}\nlink: {signing_key_file: '~/key'}\n")
    config = load_config(file)
    assert config.log.directory == "/home/pilot/logs"
    assert config.link.signing_key_file == "/home/pilot/key"
    file.write_text("limits: {fence_file: ~/fence.kml}\n")
    with pytest.raises(ConfigError, match=r"fence_file: /home/pilot/fence.kml: no such file"):
        load_config(file)


def test_a_tilde_without_a_home_folder_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text("log: {directory: ~no_such_user/it}\n", encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"flight.yaml: \$.log.directory: there is no home folder"
    ):
        load_config(file)


def test_default_preset_names_every_key() -> None:
    text = (ROOT / "configs/companion/default.yaml").read_text()
    for record in _records(CompanionConfig()):
        for name in record.__struct_encode_fields__:
            assert f"{name}:" in text, f"{type(record).__name__}.{name} is not in default.yaml"


def test_the_page_of_the_configuration_names_every_key_of_the_link_with_its_default() -> None:
    page = (ROOT / "docs/configuration.md").read_text()
    link = LinkParams()
    for name in link.__struct_fields__:
        value = getattr(link, name)
        default = {None: "null", True: "true", False: "false"}.get(value, value)
        shown = f"{default:g}" if isinstance(default, float) else default
        assert f"| `{name}` | {shown} |" in page, name


PAGE_OF = (
    (CrossingKind, "docs/flying.md"),
    (PatternKind, "docs/flying.md"),
    (FilterKind, "docs/estimation.md"),
)


@pytest.mark.parametrize(("kinds", "page"), PAGE_OF)
def test_every_planner_and_filter_is_on_its_page_and_in_the_default_preset(
    kinds: object, page: str
) -> None:
    page_text, preset = (
        (ROOT / page).read_text(),
        (ROOT / "configs/companion/default.yaml").read_text(),
    )
    for kind in get_args(kinds):
        assert f"`{kind}`" in page_text, f"{kind} is not in {page}"
        assert re.search(rf"\b{kind}\b", preset), f"{kind} is not in default.yaml"


def _records(record: object) -> list:  # type: ignore[type-arg]
    fields = getattr(record, "__struct_fields__", ())
    nested = [_records(getattr(record, name)) for name in fields]
    return ([record] if fields else []) + [r for group in nested for r in group]


KINDS = (
    ("latched_crossing", None, LatchedCrossing),
    ("fim", None, FimPlanner),
    ("survey", "lawnmower", SearchPlanner),
    ("survey", "expanding_square", SearchPlanner),
    ("survey", "sector", SearchPlanner),
    ("latched_crossing", "lawnmower", SearchThenCross),
    ("fim", "expanding_square", SearchThenCross),
    ("latched_crossing", "sector", SearchThenCross),
)


@pytest.mark.parametrize(("kind", "search", "built"), KINDS)
def test_every_planner_can_be_chosen(kind: str, search: str | None, built: type) -> None:
    text = f"planner: {{kind: {kind}, search: {search or 'null'}}}"
    assert isinstance(build_planner(parse_yaml(text, CompanionConfig, "site.yaml")), built)


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_every_preset_is_valid_and_flies(preset: Path) -> None:
    build_session(load_config(preset))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("mission: {altitud_m: 20}", r"\$\.mission.*altitud_m"),
        ("frobnicate: 1", "frobnicate"),
        ("mission: {altitude_m: high}", r"\$\.mission\.altitude_m"),
        ("mission: {altitude_m: -3}", r"\$\.mission\.altitude_m"),
        ("mission: {engage: always}", r"\$\.mission\.engage"),
        ("limits: {speed_mps: 0}", r"\$\.limits\.speed_mps"),
        ("limits: {speed_mps: .nan}", r"\$\.limits\.speed_mps"),
        ("limits: {altitude_min_m: 50, altitude_max_m: 10}", r"\$\.limits"),
        ("limits: {fence_enu_m: [[0, 0], [1, 1]]}", r"\$\.limits"),
        ("limits: {fence_enu_m: [[0, 0], [50, 50], [50, 0], [0, 50]]}", r"\$\.limits.*cross"),
        ("limits: {fence_enu_m: [[0, 0], [4, 0], [4, 4], [0, 4]]}", r"\$\.limits.*margin"),
        ("estimation: {filter: {range_sigma_m: 0}}", r"\$\.estimation\.filter\.range_sigma_m"),
        (
            "estimation: {filter: {range_offset_min_m: 2, range_offset_max_m: 1}}",
            r"\$\.estimation\.filter",
        ),
        (
            "planner: {latched_crossing: {overshoot_min_m: 9, overshoot_max_m: 3}}",
            r"\$\.planner\.latched_crossing",
        ),
        ("planner: {kind: magic}", r"\$\.planner\.kind"),
        ("planner: {search: latched_crossing}", r"\$\.planner\.search"),
        ("planner: {kind: survey}", r"\$\.planner\.kind: survey flies a pattern"),
        ("planner: {lost_after_s: 0}", r"\$\.planner\.lost_after_s"),
        ("planner: {pattern: {spacing_m: 0.1}}", r"\$\.planner\.pattern\.spacing_m"),
        ("planner: {pattern: {area_enu_m: [[0, 0]]}}", r"\$\.planner\.pattern.*3 corners"),
        ("planner: {pattern: {heading_deg: 400}}", r"\$\.planner\.pattern\.heading_deg"),
        (
            "planner: {search: expanding_square, pattern: {radius_m: 5}}",
            r"\$\.planner\.pattern: radius_m must not be less",
        ),
        ("limits: {keep_out_enu_m: [[[0, 0], [9, 9]]]}", r"\$\.limits.*keep-out needs"),
        (
            "limits: {keep_out_enu_m: [[[0, 0], [9, 9], [9, 0], [0, 9]]]}",
            r"\$\.limits.*keep-out.*cross",
        ),
        (
            "limits: {keep_out_enu_m: [[[-200, -200], [200, -200], [200, 200], [-200, 200]]]}",
            r"\$\.limits.*leave nothing",
        ),
        ("emitters: {listed: [70000]}", r"\$\.emitters\.listed"),
        ("emitters: {listed: [1, 2]}", r"\$\.emitters\.order: first searches for one"),
        ("emitters: {order: nearest, listed: [3]}", r"\$\.emitters\.order: listed needs ids"),
        ("emitters: {order: listed}", r"\$\.emitters\.order: listed needs ids"),
        ("vehicle: {system_id: 0}", r"\$\.vehicle\.system_id"),
        ("[1, 2]", "expected"),
    ],
)
def test_wrong_value_is_named_by_its_path(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as refused:
        parse_yaml(text, CompanionConfig, "site.yaml")
    assert str(refused.value).startswith("site.yaml")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("mission: {altitude_m: 100}", "$.mission.altitude_m"),
        ("mission: {stop_radius_m: 0.1}", "$.mission.stop_radius_m"),
        ("mission: {stop_radius_m: 9}", "$.mission.stop_radius_m"),
        (
            "planner: {latched_crossing: {altitude_swing_m: 16}}",
            "$.planner.latched_crossing.altitude_swing_m",
        ),
        (
            "planner: {search: lawnmower, pattern: {area_enu_m: [[200, 0], [300, 0], [300, 9]]}}",
            "$.planner.pattern.area_enu_m",
        ),
        ("{mission: {continue: true}, planner: {search: sector}}", "$.mission.continue"),
        ("search: {detection: {}}", "$.search.detection.reach_m"),
        ("{mission: {continue: true}, emitters: {order: nearest}}", "$.mission.continue"),
    ],
)
def test_contradiction_between_sections_is_named(text: str, path: str, tmp_path: Path) -> None:
    file = tmp_path / "site.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_config(file)
    assert path in str(refused.value)
    assert inconsistency(CompanionConfig()) is None


@pytest.mark.parametrize(
    ("search", "reach_m", "sigma_db"),
    [("{}", 20.0, 6.0), ("{reach_m: 50}", 50.0, 4.0), ("{reach_sigma_db: 3}", 20.0, 3.0)],
)
def test_a_search_without_a_reach_takes_that_of_the_preset(
    search: str, reach_m: float, sigma_db: float
) -> None:
    preset = (ROOT / "configs/companion/wifi_rtt.yaml").read_text()
    config = parse_yaml(f"{preset}\nsearch: {{detection: {search}}}\n", CompanionConfig, "it")
    assert config.detection is not None
    assert (config.detection.reach_m, config.detection.reach_sigma_db) == (reach_m, sigma_db)
    assert inconsistency(config) is None
