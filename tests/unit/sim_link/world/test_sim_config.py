"""Scenario files."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from sim_link.autopilot.incidents import GpsLoss, VehicleReboot
from sim_link.autopilot.scenario import Scenario
from sim_link.fleet import load_scenario
from sim_link.world.environment import ShadowParams
from sim_link.world.line_of_sight import is_blocked_in_space

SCENARIOS = Path(__file__).parents[4] / "configs" / "scenarios"
CANONICAL = SCENARIOS / "canonical.yaml"
GOOD = "obstacles:\n  - corners_enu_m: [[0, 0], [9, 0], [9, 9]]\n"


def test_the_canonical_file_spells_out_the_defaults() -> None:
    assert load_scenario(CANONICAL) == Scenario()


def test_the_canonical_file_names_every_key() -> None:
    text = CANONICAL.read_text(encoding="utf-8")
    for record in (Scenario(), *(getattr(Scenario(), name) for name in Scenario.__struct_fields__)):
        for name in getattr(type(record), "__struct_fields__", ()):
            assert f"{name}:" in text


def test_keys_left_out_keep_their_canonical_value(tmp_path: Path) -> None:
    path = tmp_path / "windy.yaml"
    path.write_text("name: windy\nwind:\n  east_mps: 5\n", encoding="utf-8")
    scenario = load_scenario(path)
    assert (scenario.name, scenario.wind.east_mps) == ("windy", 5.0)
    assert scenario.channel == Scenario().channel


@pytest.mark.parametrize("path", sorted(SCENARIOS.rglob("*.yaml")), ids=lambda path: path.name)
def test_every_scenario_is_read(path: Path) -> None:
    assert load_scenario(path).name


def test_the_obstacle_scenario_hides_the_emitter_from_the_start() -> None:
    scenario = load_scenario(SCENARIOS / "obstacle.yaml")
    assert [obstacle.name for obstacle in scenario.obstacles] == ["block", "hall"]
    assert scenario.shadow == ShadowParams()
    assert scenario.environment is not None
    start, target = (*scenario.start_enu_m, 20.0), (*scenario.emitter.position_enu_m, 0.0)
    assert is_blocked_in_space(*target, *start, scenario.environment.edges)


def test_without_obstacles_there_is_no_environment() -> None:
    assert Scenario().environment is None


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("channel:\n  p_nlos: 1.5\n", "$.channel.p_nlos"),
        ("channel:\n  p_nloss: 0.5\n", "$.channel.p_nloss"),
        ("channel:\n  range_sigma_m: -1\n", "$.channel.range_sigma_m"),
        ("autopilot:\n  offboard_loss_action: crash\n", "$.autopilot.offboard_loss_action"),
        ("system_id: 0\n", "$.system_id"),
        ("system_id: 256\n", "$.system_id"),
        ("start_enu_m: [1.0]\n", "$.start_enu_m"),
        ("start_enu_m: [1e9, 0]\n", "$.start_enu_m"),
        ("wind:\n  north_mps: .nan\n", "$.wind.north_mps"),
        ("vehicle:\n  max_speed_mps: 0\n", "$.vehicle.max_speed_mps"),
        ("vehicle:\n  max_speed_mps: fast\n", "$.vehicle.max_speed_mps"),
        ("origin:\n  latitude_deg: 95\n", "$.origin.latitude_deg"),
        ("emitter: 5\n", "$.emitter"),
        ("obstacles: block\n", "$.obstacles"),
        (GOOD + "  - name: b\n", "$.obstacles[1].corners_enu_m"),
        (GOOD + "  - corners_enu_m: [[0, 0], [9, 0]]\n", "$.obstacles[1].corners_enu_m"),
        (GOOD + "  - corners_enu_m: [[0, 0], [9, 0], [9]]\n", "$.obstacles[1].corners_enu_m[2]"),
        (GOOD + "  - corners_enu_m: [[0, 0], [9, 9], [9, 0], [0, 9]]\n", "$.obstacles[1]"),
        (GOOD + "  - corners_enu_m: [[0, 0], [9, 9], [4, 4]]\n", "$.obstacles[1]"),
        (GOOD + "  - corners_enu_m: [[0, 0], [9, .inf], [4, 4]]\n", "$.obstacles[1]"),
        (GOOD + "    height_m: 0\n", "$.obstacles[0].height_m"),
        (GOOD + "    hight_m: 9\n", "$.obstacles[0].hight_m"),
        ("shadow:\n  detour_share: 1.5\n", "$.shadow.detour_share"),
        ("shadow:\n  correlation_m: -1\n", "$.shadow.correlation_m"),
        ("- 1\n", "$"),
    ],
)
def test_errors_name_the_file_and_the_key_in_one_line(tmp_path: Path, text: str, key: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert str(path) in message
    assert key in message
    assert "\n" not in message


def test_incidents_may_be_spelled_as_version_0_1_did(tmp_path: Path) -> None:
    path = tmp_path / "old.yaml"
    path.write_text(
        "incidents:\n  - {kind: gps_loss, time_s: 30, for_s: 10}\n  - {kind: reboot, time_s: 40}\n",
        encoding="utf-8",
    )
    assert load_scenario(path).incidents == (
        GpsLoss(start_s=30.0, duration_s=10.0),
        VehicleReboot(start_s=40.0),
    )


def test_navigation_may_be_spelled_as_1_0_0rc1_did(tmp_path: Path) -> None:
    path = tmp_path / "navigation.yaml"
    path.write_text("navigation: {tells_accuracy: false, told_ratio: 0.6}\n", encoding="utf-8")
    navigation = load_scenario(path).navigation
    assert (navigation.reports_accuracy, navigation.reported_ratio) == (False, 0.6)


def test_both_spellings_at_once_are_a_mistake(tmp_path: Path) -> None:
    path = tmp_path / "both.yaml"
    path.write_text("incidents: [{kind: gps_loss, time_s: 3, start_s: 4}]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="time_s"):
        load_scenario(path)
