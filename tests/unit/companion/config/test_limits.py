from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from companion.config.loader import parse_yaml
from companion.config.schema import CompanionConfig, LimitsConfig, load_config, with_fence
from companion.errors import ConfigError
from companion.guidance.fencing import FencePolicy

CORNERS = [[47.0, 8.0], [47.0, 8.002], [47.002, 8.002], [47.002, 8.0]]


def plan_file(folder: Path, corners: list[list[float]] = CORNERS) -> Path:
    polygon = {"inclusion": True, "polygon": corners, "version": 1}
    fence = {"circles": [], "polygons": [polygon], "version": 2}
    path = folder / "site.plan"
    path.write_text(json.dumps({"fileType": "Plan", "geoFence": fence, "version": 1}))
    return path


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("altitude_min_m: 50, altitude_max_m: 10", r"\$\.limits\.altitude_min_m: must be above 0"),
        ("altitude_min_m: 59.0", r"\$\.limits\.altitude_min_m: nothing is left of 59 to 60 m"),
        ("fence_margin_m: 150", r"\$\.limits\.fence_margin_m: the margin of 150 m leaves nothing"),
        ("fence_margin_m: 0.8", r"\$\.limits\.fence_margin_m: 0.8 m is less than 0.9 m, 3 sigma"),
        ("autopilot_fence: use, fence_margin_m: 0.8", r"\$\.limits\.fence_margin_m: 0.8 m is less"),
        ("fence_enu_m: [[0, 0], [9, 9]]", r"\$\.limits\.fence_enu_m: a fence needs at least 3"),
        (
            "keep_out_enu_m: [[[-200, -200], [200, -200], [200, 200], [-200, 200]]]",
            r"\$\.limits\.keep_out_enu_m: the keep-outs leave nothing",
        ),
        ("latency_s: 1.5", r"\$\.limits\.latency_s"),
        ("acceleration_mps2: 0", r"\$\.limits\.acceleration_mps2"),
        ("distance_home_m: 0", r"\$\.limits\.distance_home_m"),
        ("battery_reserve_pct: 100", r"\$\.limits\.battery_reserve_pct"),
        ("battery_pct_per_km: 0", r"\$\.limits\.battery_pct_per_km"),
        ("autopilot_fence: maybe", r"\$\.limits\.autopilot_fence"),
        (
            "fence_file: a.plan, fence_enu_m: [[0, 0], [90, 0], [90, 90]]",
            r"\$\.limits\.fence_file: fence_enu_m is given, too",
        ),
        ("fence_file: a.plan, autopilot_fence: use", r"\$\.limits\.fence_file: autopilot_fence is"),
    ],
)
def test_limits_that_contradict_each_other_are_refused_with_their_path(
    text: str, problem: str
) -> None:
    with pytest.raises(ConfigError, match=rf"^it: {problem}"):
        parse_yaml(f"limits: {{{text}}}", CompanionConfig, "it")


def test_a_margin_need_not_hold_the_way_to_stop_at_full_speed() -> None:
    """Setpoints slow down near a border instead."""
    assert LimitsConfig(fence_margin_m=1.0, speed_mps=15.0).guard_limits().fence is not None


def test_the_defaults_keep_a_local_fence_that_the_autopilots_must_not_contradict() -> None:
    plan = LimitsConfig().fence_plan()
    assert plan.limits.fence is not None
    assert plan.site is None
    assert plan.policy is FencePolicy.COMPARE
    assert plan.limits.reserve is not None
    assert LimitsConfig(battery_pct_per_km=None).guard_limits().reserve is None


def test_battery_and_leash_are_handed_on() -> None:
    limits = LimitsConfig(
        battery_pct_per_km=15.0, battery_reserve_pct=30.0, distance_home_m=90.0
    ).guard_limits()
    assert limits.reserve is not None
    assert limits.reserve.reach_m(45.0) == pytest.approx(1000.0)
    assert limits.distance_home_m == 90.0


def test_a_file_beside_the_configuration_is_the_fence(tmp_path: Path) -> None:
    plan_file(tmp_path)
    config = tmp_path / "site.yaml"
    config.write_text("limits: {fence_file: site.plan, keep_out_enu_m: [[[0,0],[9,0],[9,9]]]}")
    plan = load_config(config).limits.fence_plan()
    assert plan.limits.fence is None
    assert plan.site is not None
    assert len(plan.site.inclusion.corners_deg) == 4
    assert len(plan.keep_out_enu_m) == 1


def test_more_corners_than_are_looked_at_in_time_are_refused(tmp_path: Path) -> None:
    ring = [[round(99 * math.cos(k / 30), 3), round(99 * math.sin(k / 30), 3)] for k in range(188)]
    config = tmp_path / "site.yaml"
    config.write_text(f"limits: {{fence_enu_m: {ring + ring[:13]}}}")
    with pytest.raises(ConfigError, match="fence_enu_m: 201 corners in all, with"):
        load_config(config)
    plan_file(tmp_path)
    config.write_text(f"limits: {{fence_file: site.plan, keep_out_enu_m: [{ring}, {ring[:9]}]}}")
    with pytest.raises(ConfigError, match=r"site\.plan: 201 corners in all, with"):
        load_config(config)


def test_a_fence_that_its_margin_closes_is_refused_by_its_file(tmp_path: Path) -> None:
    path = plan_file(tmp_path, [[47.0, 8.0], [47.0, 8.00005], [47.00005, 8.0]])
    config = tmp_path / "site.yaml"
    config.write_text("limits: {fence_file: site.plan}")
    with pytest.raises(ConfigError, match=r"site\.plan: the margin of 3 m leaves nothing"):
        load_config(config)
    with pytest.raises(ConfigError, match="the margin of 3 m leaves nothing"):
        with_fence(CompanionConfig(), path)


def test_a_file_of_the_command_line_replaces_what_the_configuration_says(tmp_path: Path) -> None:
    path = plan_file(tmp_path)
    elsewhere = ((0.0, 0.0), (90.0, 0.0), (90.0, 90.0))
    for limits, policy in (
        (LimitsConfig(fence_enu_m=elsewhere), FencePolicy.COMPARE),
        (LimitsConfig(autopilot_fence="use"), FencePolicy.COMPARE),
        (LimitsConfig(autopilot_fence="require"), FencePolicy.REQUIRE),
    ):
        plan = with_fence(CompanionConfig(limits=limits), path).limits.fence_plan()
        assert plan.site is not None
        assert plan.policy is policy
