"""Another ground station changes what the flight stands on: fence, parameters, rates, home."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.domain import FlightMode
from companion.geometry.polygons import Point, depth_m
from companion.guidance.commands import SessionParams
from companion.guidance.phases import IN_CONTROL, Phase
from companion.mav.dialect import mavlink
from companion.view.snapshot import picture_of
from sim_link.autopilot import incidents
from sim_link.autopilot.incidents import StationFence
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.faults.fault_models import StreamMute
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import SELDOM, Loop, flown_once
from tools.campaign.checkpointing import Checkpointing

Flavour = Literal["px4", "ardupilot"]
FLAVOURS: tuple[Flavour, ...] = ("px4", "ardupilot")
SLOW = partial(pytest.param, marks=pytest.mark.slow)
OFTEN_PX4 = ("px4", SLOW("ardupilot"))
"""Every day on one: reading and keeping of a fence is tried on both by the tests that shrink it."""
FAR = EmitterParams(position_enu_m=(90.0, 60.0))
MARGIN_M = 3.0
ACROSS_S = 25.0
"""At 5 m/s a vehicle that goes on to the emitter has left 40 m long before."""
REACTION_S = 12.0
"""A fence without an id is read every 10 s, and a fence of 4 items within a second."""


def square(half_m: float, east_m: float = 0.0, north_m: float = 0.0) -> tuple[Point, ...]:
    return tuple(
        (east_m + e * half_m, north_m + n * half_m) for e, n in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    )


@flown_once
def started(
    flavour: Flavour,
    policy: Literal["compare", "use", "require"] = "use",
    *,
    half_m: float = 150.0,
    engage: Literal["auto", "operator"] = "auto",
    seed: int = 5,
) -> Loop:
    """A loop whose vehicle was given a square fence by its operators."""
    limits = LimitsConfig(autopilot_fence="use")
    if policy != "use":
        limits = LimitsConfig(autopilot_fence=policy, fence_enu_m=square(half_m))
    config = CompanionConfig(mission=SessionParams(engage=engage), limits=limits)
    autopilot = AutopilotParams(flavour=flavour)
    loop = Loop(config, Scenario(emitter=FAR, autopilot=autopilot, payload=SELDOM), seed=seed)
    loop.run(1.0)
    loop.flight.apply_incident(StationFence(half_side_m=half_m))
    return loop


@flown_once
def searching(flavour: Flavour, policy: Literal["compare", "use", "require"] = "use") -> Loop:
    loop = started(flavour, policy)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    return loop


@flown_once
def remembered(flavour: Flavour, policy: Literal["compare", "use"]) -> Loop:
    """Return a flight in control in a small fence, with checkpoints that a restart finds."""
    loop = started(flavour, policy, half_m=45.0)
    Checkpointing(loop.flight)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(3.0)
    return loop


@flown_once
def hovering(flavour: Flavour, half_m: float = 150.0) -> Loop:
    """Return a flight by the pilot, with the companion in standby or waiting."""
    loop = started(flavour, half_m=half_m, engage="operator")
    if flavour == "px4":
        loop.take_off()
        return loop
    loop.run_until(lambda: loop.phase is Phase.STANDBY, 30.0)
    loop.choose(FlightMode.OFFBOARD)
    loop.run(1.0)
    loop.operator.arm()
    loop.run(1.0)
    loop.command(mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 10.0)
    loop.run_until(lambda: loop.true_positions[-1][2] > 9.5, 30.0)
    loop.choose(FlightMode.HOLD)
    loop.run(4.0)
    return loop


def change(loop: Loop, incident: incidents.StationRecord) -> None:
    loop.flight.apply_incident(incident)


def farthest_out_m(loop: Loop, border: tuple[Point, ...], since: int) -> float:
    """Return the largest distance of the true vehicle beyond a border; negative: inside."""
    return max(-depth_m(border, position[:2]) for position in loop.true_positions[since:])


@pytest.mark.parametrize("shares_line", [False, SLOW(True)], ids=["own line", "our line"])
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_fence_that_shrinks_before_control_is_the_one_that_is_kept(
    flavour: Flavour, shares_line: bool
) -> None:
    """Read once, 150 m: the vehicle ended at (89, 61), outside of the 30 m in force."""
    loop = hovering(flavour)
    assert loop.said("fence: 4 corners")
    change(loop, StationFence(half_side_m=30.0, shares_line=shares_line))
    loop.run(2.0)
    loop.choose(FlightMode.OFFBOARD)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 20.0)
    loop.run(ACROSS_S)
    assert farthest_out_m(loop, square(30.0), 0) < 0.0
    assert loop.phase in IN_CONTROL


@pytest.mark.parametrize("policy", ["use", SLOW("compare")])
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_fence_that_shrinks_in_control_is_kept_once_it_can_be_known(
    flavour: Flavour, policy: Literal["compare", "use"]
) -> None:
    loop = searching(flavour, policy)
    change(loop, StationFence(half_side_m=40.0))
    loop.run(REACTION_S)
    since = len(loop.true_positions)
    loop.run(ACROSS_S)
    assert farthest_out_m(loop, square(40.0), since) < 0.0
    assert loop.phase in IN_CONTROL
    assert loop.said("the autopilot's fence changed in flight: keeping to 2 until landing")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_fence_that_shrinks_behind_the_vehicle_leads_back_inside(flavour: Flavour) -> None:
    loop = searching(flavour)
    loop.run_until(lambda: loop.true_positions[-1][0] > 30.0, 60.0)
    change(loop, StationFence(half_side_m=25.0))
    loop.run(REACTION_S + 15.0)
    depths = [depth_m(square(25.0), sent.position_enu_m[:2]) for sent in loop.setpoints[-200:]]
    assert loop.phase not in IN_CONTROL or min(depths) > 0.0


@pytest.mark.parametrize("policy", ["use", SLOW("compare"), SLOW("require")])
@pytest.mark.parametrize("flavour", OFTEN_PX4)
def test_a_fence_that_widens_or_goes_in_flight_widens_nothing(
    flavour: Flavour, policy: Literal["compare", "use", "require"]
) -> None:
    loop = started(flavour, policy, half_m=45.0)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    change(loop, StationFence(half_side_m=150.0))
    loop.run(15.0)
    change(loop, StationFence(half_side_m=None))
    loop.run(ACROSS_S)
    assert farthest_out_m(loop, square(45.0), 0) < 0.0
    assert loop.phase in IN_CONTROL


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_wider_fence_counts_after_the_landing(flavour: Flavour) -> None:
    loop = hovering(flavour, half_m=45.0)
    change(loop, StationFence(half_side_m=150.0))
    loop.run(REACTION_S)
    fence = loop.companion.session.fencing.guard.limits.fence
    assert fence is not None
    assert max(east for east, _ in fence.polygon_enu_m) == pytest.approx(45.0, abs=0.5)
    loop.choose(FlightMode.LAND)
    loop.run_until(lambda: not loop.sim.vehicle.is_armed, 60.0)
    loop.run(3.0)
    fence = loop.companion.session.fencing.guard.limits.fence
    assert fence is not None
    assert max(east for east, _ in fence.polygon_enu_m) == pytest.approx(150.0, abs=0.5)
    assert fence.also_inside_enu_m == ()


@pytest.mark.parametrize("flavour", OFTEN_PX4)
def test_fences_that_overlap_in_part_are_kept_together(flavour: Flavour) -> None:
    loop = searching(flavour)
    change(loop, StationFence(half_side_m=60.0, east_m=20.0))
    loop.run(REACTION_S)
    change(loop, StationFence(half_side_m=60.0, north_m=25.0, is_circle=True))
    loop.run(REACTION_S)
    since = len(loop.true_positions)
    loop.run(ACROSS_S)
    assert farthest_out_m(loop, square(60.0, 20.0), since) < 0.0
    reach_m = [((p[0]) ** 2 + (p[1] - 25.0) ** 2) ** 0.5 for p in loop.true_positions[since:]]
    assert max(reach_m) < 60.0


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_fences_without_anything_in_common_are_handed_back(flavour: Flavour) -> None:
    loop = searching(flavour)
    change(loop, StationFence(half_side_m=20.0, east_m=-100.0))
    loop.run(REACTION_S)
    change(loop, StationFence(half_side_m=20.0, east_m=100.0))
    loop.run_until(lambda: loop.phase not in IN_CONTROL, 45.0)
    assert loop.said("handing back: ") or loop.said("control lost: ")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_change_that_cannot_be_read_is_held_on_and_handed_back(flavour: Flavour) -> None:
    """The vehicle shows that its fence changed, and then says nothing about it."""
    loop = searching(flavour)
    loop.wire.add(StreamMute(message="MISSION_COUNT"), loop.now_s)
    change(loop, StationFence(half_side_m=40.0, shares_line=True))
    loop.run(2.0)
    assert loop.phase is Phase.HOLD
    loop.run_until(lambda: loop.phase not in IN_CONTROL, 30.0)
    assert loop.said("the autopilot's fence has not been read yet")


@pytest.mark.parametrize("flavour", OFTEN_PX4)
def test_the_same_fence_uploaded_again_changes_nothing(flavour: Flavour) -> None:
    loop = searching(flavour)
    before = loop.companion.session.fencing.guard.limits.fence
    change(loop, StationFence(half_side_m=150.0))
    loop.run(REACTION_S)
    assert loop.companion.session.fencing.guard.limits.fence == before
    assert not loop.said("changed in flight")
    loop.run_until(lambda: bool(loop.notes.results), 90.0)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_rates_that_another_station_changes_are_asked_for_again(flavour: Flavour) -> None:
    loop = searching(flavour)
    for message in ("LOCAL_POSITION_NED", "ATTITUDE", "EXTENDED_SYS_STATE", "SYS_STATUS"):
        change(loop, incidents.StationRates(message=message, rate_hz=0.2))
    loop.run(4.0)
    change(loop, incidents.StationRates(message="LOCAL_POSITION_NED", rate_hz=0.0))
    loop.run_until(lambda: bool(loop.notes.results), 120.0)
    assert loop.phase is not Phase.YIELD


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [0.0, 0.3])
@pytest.mark.parametrize(
    "message", ["ATTITUDE", "EXTENDED_SYS_STATE", "SYS_STATUS", "GPS_RAW_INT", "HOME_POSITION"]
)
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_stream_that_another_station_slows_or_stops_ends_no_search(
    flavour: Flavour, message: str, rate_hz: float
) -> None:
    loop = searching(flavour)
    for _ in range(3):
        change(loop, incidents.StationRates(message=message, rate_hz=rate_hz, shares_line=True))
        loop.run(3.0)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 8.0)
    assert not loop.said("control lost")
    assert not loop.said("handing back")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_home_that_another_station_moves_has_the_fence_read_again(flavour: Flavour) -> None:
    loop = searching(flavour)
    change(loop, StationFence(half_side_m=40.0))
    change(loop, incidents.StationHome(east_m=12.0, north_m=-5.0))
    loop.run(4.0)
    since = len(loop.true_positions)
    loop.run(20.0)
    assert loop.said("home moved")
    assert farthest_out_m(loop, square(40.0), since) < 0.0


@pytest.mark.parametrize(
    ("flavour", "name"), [("px4", "GF_MAX_HOR_DIST"), ("ardupilot", "FENCE_RADIUS")]
)
def test_a_fence_parameter_that_is_set_has_the_fence_read_again(
    flavour: Flavour, name: str
) -> None:
    loop = searching(flavour)
    asked = len(loop.companion_bytes)
    for value in (120.0, 90.0):
        change(loop, incidents.StationParameter(name=name, value=value))
        loop.run(3.0)
    assert loop.said("the autopilot's fence changed: reading it again")
    assert len(loop.companion_bytes) > asked
    assert loop.phase in IN_CONTROL


@pytest.mark.parametrize("flavour", OFTEN_PX4)
@pytest.mark.parametrize("down_s", [SLOW(1.0), 6.0])
def test_the_fences_of_a_flight_outlive_a_restart_of_the_companion(
    flavour: Flavour, down_s: float
) -> None:
    loop = started(flavour)
    Checkpointing(loop.flight)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    for half_m in (40.0, 150.0):
        change(loop, StationFence(half_side_m=half_m))
        loop.run(REACTION_S)
    before = loop.companion.session.fencing.guard.limits.fence
    assert before is not None
    assert len(before.also_inside_enu_m) == 1
    loop.flight.kill_companion()
    loop.run(down_s)
    loop.flight.start_companion()
    loop.run_until(lambda: loop.said("resumed after"), 20.0)
    loop.run(REACTION_S)
    after = loop.companion.session.fencing.guard.limits.fence
    assert after is not None
    assert max(max(map(abs, corner)) for corner in after.polygon_enu_m) < 41.0
    assert len(after.also_inside_enu_m) == 1
    shown: dict[str, Any] = picture_of(loop.companion, loop.now_s)
    assert shown["fence"]["polygon"] == after.polygon_enu_m
    assert shown["fence"]["also_inside"] == after.also_inside_enu_m


def reach_m(loop: Loop) -> float:
    """Return the farthest east of a setpoint that the guard allows; 0 without a fence."""
    fence = loop.companion.session.fencing.guard.limits.fence
    positions = [(0.5 * step, 0.0) for step in range(600)]
    return max(
        (position[0] for position in positions if fence and fence.allows(position)), default=0.0
    )


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("half_m", [25.0, SLOW(150.0), None], ids=["smaller", "wider", "none"])
@pytest.mark.parametrize("policy", ["use", SLOW("compare")])
def test_a_fence_that_is_uploaded_while_the_companion_is_down_widens_nothing(
    flavour: Flavour, policy: Literal["compare", "use"], half_m: float | None
) -> None:
    loop = remembered(flavour, policy)
    before_m = reach_m(loop)
    loop.flight.kill_companion()
    loop.run(2.0)
    change(loop, StationFence(half_side_m=half_m))
    loop.run(3.0)
    loop.choose(FlightMode.HOLD)
    loop.flight.start_companion()
    loop.run_until(lambda: loop.said("resumed after"), 20.0)
    loop.run(REACTION_S)
    limit_m = before_m if half_m is None else min(before_m, half_m - MARGIN_M)
    assert reach_m(loop) <= limit_m
    since = len(loop.true_positions)
    loop.choose(FlightMode.OFFBOARD)
    loop.run(30.0)
    assert farthest_out_m(loop, square(45.0), since) < 0.0


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_another_mission_after_a_restart_in_flight_keeps_its_fences(flavour: Flavour) -> None:
    loop = remembered(flavour, "use")
    before_m = reach_m(loop)
    loop.flight.kill_companion()
    change(loop, StationFence(half_side_m=150.0))
    limits = LimitsConfig(autopilot_fence="use", speed_mps=2.0)
    loop.flight.config = msgspec.structs.replace(loop.flight.config, limits=limits)
    loop.run(2.0)
    loop.flight.start_companion()
    loop.run(REACTION_S)
    assert loop.said("starting a new mission")
    assert not loop.said("resumed after")
    assert 0.0 < reach_m(loop) <= before_m


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_false_landing_in_the_hands_of_the_pilot_widens_nothing(flavour: Flavour) -> None:
    loop = hovering(flavour, half_m=45.0)
    before_m = reach_m(loop)
    loop.flight.apply_incident(incidents.FalseLanding(duration_s=3.0))
    change(loop, StationFence(half_side_m=150.0))
    loop.run(REACTION_S)
    assert 0.0 < reach_m(loop) <= before_m
