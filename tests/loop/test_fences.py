"""Fences of files and of the autopilot, over both endpoints: flown in, compared, refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig, with_fence
from companion.domain import FlightMode
from companion.geometry.polygons import Point, depth_m
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.dialect import mavlink
from companion.view.snapshot import picture_of
from sim_link.autopilot.scenario import AutopilotParams, OriginParams, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import LinkFaults, Loop
from tools.campaign.checkpointing import Checkpointing

FENCE = mavlink.MAV_MISSION_TYPE_FENCE
IN, OUT = 5001, 5002
SITE = ((-5.0, -5.0), (60.0, -5.0), (60.0, 60.0), (-5.0, 60.0))
WIDER = ((-5.0, -5.0), (75.0, -5.0), (75.0, 60.0), (-5.0, 60.0))
HOUSE = ((20.0, 25.0), (30.0, 25.0), (30.0, 32.0), (20.0, 32.0))
AUTO = SessionParams(engage="auto")
AT_THE_BORDER = EmitterParams(position_enu_m=(58.0, 50.0))
Flavour = Literal["px4", "ardupilot"]


def scenario(flavour: Flavour = "px4") -> Scenario:
    return Scenario(emitter=AT_THE_BORDER, autopilot=AutopilotParams(flavour=flavour))


def geodetic_deg(loop: Loop, corners: tuple[Point, ...]) -> list[tuple[float, float]]:
    origin = loop.sim.vehicle.origin
    return [origin.geodetic_from_enu((east, north, 0.0))[:2] for east, north in corners]


def upload(loop: Loop, *areas: tuple[int, tuple[Point, ...]]) -> None:
    """A ground station gives the autopilot a fence."""
    items = [
        (command, float(len(corners)), position)
        for command, corners in areas
        for position in geodetic_deg(loop, corners)
    ]
    loop.send_to_vehicle(mavlink.MAVLink_mission_count_message(1, 1, len(items), FENCE))
    for seq, (command, vertices, (lat, lon)) in enumerate(items):
        loop.send_to_vehicle(
            mavlink.MAVLink_mission_item_int_message(
                *(1, 1, seq, 0, command, 0, 1, vertices, 0.0, 0.0, 0.0),
                *(round(lat * 1e7), round(lon * 1e7), 0.0, FENCE),
            )
        )


def with_limits(limits: LimitsConfig) -> CompanionConfig:
    return CompanionConfig(mission=AUTO, limits=limits)


def plan_file(folder: Path) -> Path:
    origin = OriginParams()
    frame = Loop(scenario=Scenario(origin=origin))
    polygons = [
        {"inclusion": inclusion, "polygon": geodetic_deg(frame, corners), "version": 1}
        for inclusion, corners in ((True, SITE), (False, HOUSE))
    ]
    fence = {"circles": [], "polygons": polygons, "version": 2}
    path = folder / "site.plan"
    path.write_text(json.dumps({"fileType": "Plan", "geoFence": fence, "version": 1}))
    return path


def assert_kept(loop: Loop, *keep_outs: tuple[Point, ...]) -> None:
    """Setpoints keep a margin of 3 m, the vehicle stays inside, and was near the border."""
    for sent in loop.setpoints:
        assert depth_m(SITE, sent.position_enu_m[:2]) >= 3.0 - 1e-3
    for position in loop.true_positions:
        assert depth_m(SITE, position[:2]) > 0.0
        assert all(depth_m(keep_out, position[:2]) < 0.0 for keep_out in keep_outs)
    assert max(position[0] for position in loop.true_positions) > 50.0


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_plan_of_qgroundcontrol_is_flown_in(tmp_path: Path, flavour: Flavour) -> None:
    config = with_fence(CompanionConfig(mission=AUTO), plan_file(tmp_path))
    loop = Loop(config, scenario(flavour))
    upload(loop, (OUT, HOUSE), (IN, SITE))
    loop.run(90.0)
    assert loop.said("fence: 4 corners, 1 keep-outs, margin 3.6 m")
    assert_kept(loop, HOUSE)


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize("faults", [LinkFaults(), LinkFaults(loss=0.3)], ids=["clean", "lossy"])
def test_the_autopilots_own_fence_is_flown_in(flavour: Flavour, faults: LinkFaults) -> None:
    config = with_limits(LimitsConfig(autopilot_fence="use"))
    loop = Loop(config, scenario(flavour), faults=faults)
    upload(loop, (IN, SITE))
    loop.run(120.0)
    assert loop.said("fence: 4 corners, 0 keep-outs, margin 3.6 m")
    assert_kept(loop)


def shown_fence(loop: Loop) -> dict[str, Any]:
    """The fence as views draw it now."""
    picture: dict[str, Any] = picture_of(loop.companion, loop.flight.now_s)
    fence: dict[str, Any] = picture["fence"]
    return fence


@pytest.mark.slow
def test_views_show_the_fence_that_the_guard_keeps_and_why_there_is_none() -> None:
    loop = Loop(with_limits(LimitsConfig(autopilot_fence="use")), scenario())
    fence = shown_fence(loop)
    assert (fence["polygon"], fence["refusal"]) == (None, None)
    assert fence["missing"] == ["the autopilot's fence"]
    loop.run(10.0)
    assert shown_fence(loop)["refusal"] == "the autopilot has no fence to use"
    upload(loop, (OUT, HOUSE), (IN, SITE))
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    fence = shown_fence(loop)
    assert (fence["refusal"], fence["missing"]) == (None, [])
    assert fence["text"] == "4 corners, 1 keep-outs, margin 3.6 m"
    assert [len(corners) for corners in fence["keep_out"]] == [4]
    for shown, true in zip(sorted(fence["polygon"]), sorted(SITE), strict=True):
        assert math.dist(shown, true) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_another_fence_is_refused_until_it_is_mended(flavour: Flavour) -> None:
    loop = Loop(with_limits(LimitsConfig(fence_enu_m=SITE)), scenario(flavour))
    upload(loop, (IN, WIDER))
    loop.run(20.0)
    assert loop.said("no control without a fence: the autopilot's fence differs: borders")
    assert loop.said("up to 15.0 m apart")
    assert loop.phase is Phase.WAITING
    assert loop.setpoints == []
    upload(loop, (IN, SITE))
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)


def test_a_fence_to_be_used_that_is_not_there_is_refused() -> None:
    loop = Loop(with_limits(LimitsConfig(autopilot_fence="use")), scenario())
    loop.run(10.0)
    assert loop.said("no control without a fence: the autopilot has no fence to use")
    assert loop.setpoints == []


@pytest.mark.slow
def test_without_a_fence_on_the_autopilot_it_flies_and_says_so() -> None:
    loop = Loop(with_limits(LimitsConfig(fence_enu_m=SITE)), scenario())
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 30.0)
    assert loop.said("autopilot has no fence")
    assert loop.mode is FlightMode.OFFBOARD


@pytest.mark.slow
def test_a_fence_in_local_metres_stays_where_it_was_when_the_origin_moves() -> None:
    """The target stands by the border, and the local frame moves the vehicle away from it."""
    loop = Loop(with_limits(LimitsConfig(fence_enu_m=SITE)), scenario())
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.sim.vehicle.aircraft.shift_origin((12.0, 9.0, 0.0))
    loop.run(35.0)
    assert loop.said("local origin moved 15 m: fence kept in place")
    assert all(depth_m(SITE, position[:2]) > 0.0 for position in loop.true_positions)
    assert max(position[0] for position in loop.true_positions) > 50.0


@pytest.mark.slow
def test_a_companion_that_is_killed_remembers_where_its_fence_was() -> None:
    loop = Loop(with_limits(LimitsConfig(fence_enu_m=SITE)), scenario())
    Checkpointing(loop.flight)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.sim.vehicle.aircraft.shift_origin((12.0, 9.0, 0.0))
    loop.run(2.0)
    loop.flight.kill_companion()
    loop.flight.start_companion()
    loop.run(5.0)
    fence = loop.companion.session.fencing.guard.limits.fence
    assert fence is not None
    assert fence.polygon_enu_m[0] == pytest.approx((-17.0, -14.0), abs=0.01)
