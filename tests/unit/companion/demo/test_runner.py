from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from companion.cli import main
from companion.config.loader import CONFIG_FOLDERS
from companion.config.schema import CompanionConfig
from companion.demo.runner import (
    DemoResult,
    DemoWatch,
    _demo_config,
    busy_hint,
    scenario_named,
)
from companion.domain import PositionAccuracy
from companion.errors import ConfigError
from companion.guidance.phases import Phase
from companion.io.child_processes import Pacer

BLOCK = [[30.0, 30.0], [45.0, 30.0], [45.0, 60.0], [30.0, 60.0]]
EVERYWHERE = [[-500.0, -500.0], [500.0, -500.0], [500.0, 500.0], [-500.0, 500.0]]


def truth(corners: list[list[float]], height_m: float | None) -> dict[str, Any]:
    obstacle = {"name": "block", "corners_enu_m": corners, "height_m": height_m}
    return {"scenario": "test", "area_m": [100.0, 80.0], "obstacles": [obstacle]}


def test_it_engages_by_itself_inside_a_fence_around_the_area() -> None:
    config = _demo_config(CompanionConfig(), truth(BLOCK, 5.0), "state")
    assert config.mission.engage == "auto"
    assert config.limits.fence_enu_m[0] == (-10.0, -10.0)
    assert config.limits.fence_enu_m[2] == (110.0, 90.0)


@pytest.mark.parametrize(("height_m", "kept_out"), [(5.0, 0), (16.0, 1), (30.0, 1), (None, 1)])
def test_it_keeps_out_of_what_reaches_its_altitude(height_m: float | None, kept_out: int) -> None:
    config = _demo_config(CompanionConfig(), truth(BLOCK, height_m), "state")
    assert len(config.limits.keep_out_enu_m) == kept_out


def test_the_keep_outs_of_the_configuration_stay() -> None:
    config = CompanionConfig()
    mast = ((70.0, 70.0), (71.0, 70.0), (70.0, 71.0))
    limits = msgspec.structs.replace(config.limits, keep_out_enu_m=(mast,))
    config = _demo_config(
        msgspec.structs.replace(config, limits=limits), truth(BLOCK, None), "state"
    )
    assert config.limits.keep_out_enu_m == (mast, tuple((e, n) for e, n in BLOCK))


def test_a_scenario_without_room_to_fly_is_refused() -> None:
    with pytest.raises(ConfigError, match="scenario test"):
        _demo_config(CompanionConfig(), truth(EVERYWHERE, None), "state")


def test_a_scenario_may_be_named_and_brings_the_preset_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkout = CONFIG_FOLDERS[1]
    monkeypatch.chdir(tmp_path)
    file, preset = scenario_named(Path("field/rubble"))
    assert (file, preset) == (
        checkout / "scenarios/field/rubble.yaml",
        checkout / "companion/field/rubble.yaml",
    )
    assert scenario_named(Path("obstacle"))[1] is None
    assert scenario_named(file) == (file, None)


def test_a_scenario_that_there_is_not_is_reported_beside_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match=r"field/rubl: no such file.*field/rubble"):
        scenario_named(Path("field/rubl"))


@pytest.mark.parametrize(
    ("late_s", "hint"),
    [
        (1.2, "; this computer is too busy (a control tick was 1.2 s late): end other programs"),
        (0.4, ""),
    ],
)
def test_a_mode_that_a_busy_computer_lost_comes_with_what_to_do(late_s: float, hint: str) -> None:
    said = busy_hint(late_s)
    assert said.startswith(hint)
    assert bool(said) is bool(hint)


def test_a_computer_that_is_too_busy_is_announced_with_the_speed_that_it_keeps_up_with(
    tmp_path: Path,
) -> None:
    clock = Pacer(tmp_path / "clock", 4.0)
    simulator: Any = SimpleNamespace(is_alive=True)
    watch = DemoWatch(simulator, 240.0, clock)
    events: list[Any] = []
    endpoint: Any = SimpleNamespace(
        binding=SimpleNamespace(is_bound=False, heard_s=0.0),
        session=SimpleNamespace(phase=Phase.WAITING, has_finished=False),
        handle_event=events.append,
    )
    watch.update(endpoint, 1.0)
    clock.speed = 2.0  # as the pacer lowers it
    watch.update(endpoint, 2.0)
    watch.update(endpoint, 3.0)
    (event,) = events
    assert event.text == "this computer is too busy for 4x: continuing at 2x"


def test_the_end_says_both_radii_and_whose_error_the_absolute_one_has() -> None:
    own = PositionAccuracy(0.02, 0.04, is_reported=True)
    estimate = SimpleNamespace(
        position_enu_m=(52.0, 41.0), r95_m=0.33, absolute_r95_m=0.34, own=own, time_s=41.8
    )
    endpoint: Any = SimpleNamespace(
        session=SimpleNamespace(result=SimpleNamespace(estimate=estimate), estimate=None)
    )
    watch: Any = SimpleNamespace(ended="localised", wall_s=44.8, time_s=41.8, worst_gap_s=0.0)
    report = {"emitter": {"enu_m": [52.0, 41.5, 0.0]}, "distance_m": 153.0}
    options: Any = SimpleNamespace(speed=4.0)
    said = DemoResult(options, watch, endpoint, report).summary
    radii = "R95 0.34 m absolute, 0.33 m relative (GNSS 0.02 m)"
    assert f"{radii}, error against the truth 0.50 m" in said


@pytest.mark.parametrize("scenario", [(), ("--scenario", "field/phone_ftm")])
def test_without_the_simulator_it_says_what_to_install(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    scenario: tuple[str, ...],
) -> None:
    """An installation without it has no scenarios either: that is not what is missing."""

    def find(name: str) -> object:
        return None if name == "sim_link" else object()

    monkeypatch.setattr(importlib.util, "find_spec", find)
    monkeypatch.setattr("companion.demo.runner.CONFIG_FOLDERS", (tmp_path,))
    assert main(["demo", *scenario]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("companion: the simulator is not installed; in the checkout: ")
    assert line.endswith(f"--python {sys.executable} install ./sim_link")
