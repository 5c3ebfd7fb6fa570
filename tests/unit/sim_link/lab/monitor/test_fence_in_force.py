"""The fence of another ground station is in force once the companion was given it."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.guidance.commands import SessionParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.incidents import StationFence
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.lockstep import MakeCompanion
from sim_link.lab.monitor.independent_checks import FencesInForce, FlownFence
from sim_link.lab.observer import Frame, Lane
from sim_link.world.environment import EmitterParams
from tests.planted_companions import KeepsItsFence, NeverReadsAgain, maker
from tools.campaign.flights import Monitored, monitored_flight

SQUARE = ((-150.0, -150.0), (150.0, -150.0), (150.0, 150.0), (-150.0, 150.0))
SMALL = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
FENCE = mavlink.MAV_MISSION_TYPE_FENCE


def given(*messages: Message) -> FencesInForce:
    """Return the fences in force after these messages, one a second; a degree is a metre."""
    fences, codec = FencesInForce(), MavCodec(1, 1)
    for now_s, message in enumerate(messages):
        frame = Frame(float(now_s), codec.encode(message), Lane.TO_COMPANION)
        fences.take(frame, lambda north, east: (round(east, 6), round(north, 6)))
    return fences


def count(items: int, kind: int = FENCE) -> Message:
    return mavlink.MAVLink_mission_count_message(255, 191, items, kind)


def item(seq: int, command: int, first: float, east: float, north: float) -> Message:
    what = (255, 191, seq, 0, command, 0, 1, first, 0.0, 0.0, 0.0)
    at = (round(1e7 * north), round(1e7 * east), 0.0)
    return mavlink.MAVLink_mission_item_int_message(*what, *at, FENCE)


def corners(*positions: tuple[float, float], is_in: bool = True) -> list[Message]:
    command = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION + (not is_in)
    return [item(n, command, len(positions), *position) for n, position in enumerate(positions)]


def test_a_fence_is_in_force_from_its_last_item_on() -> None:
    messages = [count(4), *corners(*SMALL)]
    assert given(*messages[:-1]).fences == []
    assert given(*messages).fences == [(4.0, FlownFence((SMALL,)))]
    assert given(*messages).known(4.0) == []
    assert given(*messages).known(4.1) == [FlownFence((SMALL,))]


def test_items_out_of_order_of_a_mission_and_of_two_readings_make_none() -> None:
    first, second, *rest = corners(*SMALL)
    assert given(count(4), first, *rest, second).fences == []
    assert given(count(4, 0), first, second, *rest).fences == []
    assert given(count(4), first, second, count(4), *rest).fences == []


def test_the_same_fence_read_again_is_one_and_an_empty_one_is_none() -> None:
    messages = [count(4), *corners(*SMALL)]
    fences = given(*messages, *messages, count(0))
    assert len(fences.fences) == 1
    assert fences.read_s == 10.0


def test_on_the_ground_only_the_newest_counts() -> None:
    circle = item(0, mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, 20.0, 3.0, 4.0)
    fences = given(count(4), *corners(*SMALL), count(1), circle)
    assert len(fences.fences) == 2
    fences.land()
    assert fences.known(99.0) == [FlownFence(circles_in=(((3.0, 4.0), 20.0),))]


@pytest.mark.parametrize(
    ("fence", "depth_m", "is_clear"),
    [
        (FlownFence((SMALL,)), -9.0, False),
        (FlownFence((), (SMALL,)), 9.0, False),
        (FlownFence((SQUARE,)), 140.0, True),
        (FlownFence((), (), (((0.0, 0.0), 30.0),)), 20.0, True),
        (FlownFence((), (), (), (((0.0, 0.0), 3.0),)), 7.0, False),
        (FlownFence((), (), (), (((0.0, 9.0), 3.0),)), 10.45, True),
        (FlownFence((SMALL, SQUARE)), 140.0, False),
    ],
)
def test_depth_and_ways_of_a_fence(fence: FlownFence, depth_m: float, *, is_clear: bool) -> None:
    assert fence.depth_m((10.0, 0.0)) == pytest.approx(depth_m, abs=0.01)
    assert fence.is_way_clear((10.0, 0.0), (-10.0, 0.0)) is is_clear


def searched(
    flavour: FlavourName, make: MakeCompanion | None, fence: StationFence, *, policy: str
) -> Monitored:
    """A search whose fence another station changes after it has begun."""
    limits = LimitsConfig(fence_enu_m=SQUARE, autopilot_fence=policy)  # type: ignore[arg-type]
    config = CompanionConfig(mission=SessionParams(engage="auto"), limits=limits)
    scenario = Scenario(
        emitter=EmitterParams(position_enu_m=(90.0, 60.0)),
        autopilot=AutopilotParams(flavour=flavour),
    )
    around = monitored_flight(config, scenario, 5, make_companion=make)
    around.flight.run(1.0)
    around.injector.add(StationFence(half_side_m=150.0))
    around.flight.run(18.0)
    around.injector.add(fence)
    around.flight.run(32.0)
    return around


HALF_M = 40.0


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize(
    "fence",
    [
        StationFence(half_side_m=HALF_M),
        StationFence(half_side_m=HALF_M, is_circle=True),
        StationFence(half_side_m=15.0),
    ],
)
def test_the_genuine_companion_keeps_to_it(flavour: FlavourName, fence: StationFence) -> None:
    around = searched(flavour, None, fence, policy="compare")
    assert around.monitor.violations == []
    assert len(around.monitor.scene.in_force.fences) == 2


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_who_reads_it_and_keeps_to_the_old_one_is_found(flavour: FlavourName) -> None:
    fence = StationFence(half_side_m=HALF_M)
    around = searched(flavour, maker(KeepsItsFence), fence, policy="compare")
    found = {(v.invariant, v.what) for v in around.monitor.violations}
    assert ("I1", "setpoint too near to a border or beyond it") in found


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_who_never_reads_it_again_is_found(flavour: FlavourName) -> None:
    fence = StationFence(half_side_m=100.0)  # so wide that no autopilot acts by it
    around = searched(flavour, maker(NeverReadsAgain), fence, policy="compare")
    found = {(v.invariant, v.what) for v in around.monitor.violations}
    assert found == {("I1", "a fence of another station is not requested")}


@pytest.mark.slow
def test_where_the_autopilots_fence_is_ignored_it_is_not_in_force() -> None:
    around = searched("ardupilot", None, StationFence(half_side_m=HALF_M), policy="ignore")
    assert around.monitor.violations == []
