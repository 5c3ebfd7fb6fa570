"""Parameters that a ground station changed outlive the process, where the rules allow."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.config.tunables import TUNABLES, Tunables
from companion.errors import ConfigError
from companion.flight_setup import build_planner
from companion.persistence import ParameterKeeper

INDEX = {tunable.name: index for index, tunable in enumerate(TUNABLES)}


def tunables(speed_mps: float = 5.0) -> Tunables:
    config = CompanionConfig(limits=LimitsConfig(speed_mps=speed_mps))
    return Tunables(config, build_planner)


def keep(path: Path, **values: float) -> None:
    """A run in which values are changed."""
    first = tunables()
    keeper = ParameterKeeper(first, path)
    for name, value in values.items():
        first.change(INDEX[name], value)
    keeper.run(0.0)
    keeper.close(5.0)


def test_a_change_is_there_at_the_next_start(tmp_path: Path) -> None:
    path = tmp_path / "state" / "vehicle.parameters.json"
    keep(path, CMP_SPEED=3.0, CMP_ON_FOUND=1)
    second = tunables()
    ParameterKeeper(second, path)
    assert second.config.limits.speed_mps == 3.0
    assert second.config.mission.on_localised == "return"
    assert second.changed == {"CMP_SPEED": 3.0, "CMP_ON_FOUND": 1}
    assert second.file == CompanionConfig()


def test_a_change_after_the_last_control_tick_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.parameters.json"
    first = tunables()
    keeper = ParameterKeeper(first, path)
    first.change(INDEX["CMP_SPEED"], 3.0)
    keeper.run(0.0)
    first.change(INDEX["CMP_ALTITUDE"], 25.0)
    keeper.close(5.0)
    second = tunables()
    ParameterKeeper(second, path)
    assert second.changed == {"CMP_SPEED": 3.0, "CMP_ALTITUDE": 25.0}


def test_what_is_as_in_the_file_again_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.parameters.json"
    keep(path, CMP_SPEED=3.0)
    keep(path, CMP_SPEED=5.0)
    assert path.read_text().split() == ["{}"]


def test_a_file_with_a_lower_limit_wins(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "vehicle.parameters.json"
    keep(path, CMP_SPEED=4.0)
    second = tunables(speed_mps=2.0)
    with caplog.at_level(logging.WARNING, "companion.run"):
        ParameterKeeper(second, path)
    assert second.config.limits.speed_mps == 2.0
    assert "CMP_SPEED: 4 is above the configuration's 2" in caplog.text


def test_changes_that_need_each_other_are_taken_up_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.parameters.json"
    path.write_text('{"CMP_BAT_CRIT": 30.0, "CMP_OVER_MIN": 25.0, "CMP_BAT_LOW": 40.0}')
    second = tunables()
    assert second.restore({"CMP_BAT_CRIT": 50.0}) != []
    ParameterKeeper(second, path)
    assert second.changed == {"CMP_BAT_CRIT": 30.0, "CMP_BAT_LOW": 40.0}


@pytest.mark.parametrize("content", [b"", b"[1]", b'{"CMP_SPEED": "fast"}', b"\xff\xfe", b"{"])
def test_a_spoilt_file_means_nothing(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "vehicle.parameters.json"
    path.write_bytes(content)
    second = tunables()
    with caplog.at_level(logging.WARNING, "companion.run"):
        ParameterKeeper(second, path)
    assert second.config == second.file
    assert str(path) in caplog.text


@pytest.mark.parametrize("value", ["1e30", "1e308", "-1.0", "1e-300", "1.5e1"])
@pytest.mark.parametrize("name", ["CMP_CLIMB", "CMP_ON_FOUND", "CMP_SPEED"])
def test_a_kept_value_out_of_its_range_is_refused_with_a_line(
    tmp_path: Path, name: str, value: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "vehicle.parameters.json"
    path.write_text(f'{{"{name}": {value}}}')
    second = tunables()
    with caplog.at_level(logging.WARNING, "companion.run"):
        ParameterKeeper(second, path)
    assert second.config == second.file
    assert second.changed == {}
    assert f"{name}: " in caplog.text


@pytest.mark.parametrize("name", ["CMP_FENCE_MARGIN", "CMP_NOTHING"])
def test_read_only_parameters_are_not_taken_from_a_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / "vehicle.parameters.json"
    path.write_text(f'{{"{name}": 1.0, "CMP_SPEED": 2.0}}')
    second = tunables()
    ParameterKeeper(second, path)
    assert second.changed == {"CMP_SPEED": 2.0}


def test_a_refused_change_changes_nothing() -> None:
    first = tunables()
    with pytest.raises(ConfigError, match="above the configuration's 5"):
        first.change(INDEX["CMP_SPEED"], 5.1)
    with pytest.raises(ConfigError, match="overshoot_min_m must not exceed"):
        first.change(INDEX["CMP_OVER_MIN"], 21.0)
    assert first.config == first.file
    assert first.changed == {}
