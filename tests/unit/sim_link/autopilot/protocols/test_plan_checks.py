from __future__ import annotations

import math

import pytest

from companion.mav.dialect import mavlink
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.protocols.plan_items import NO_VALUE, PlanItem, PlanResult, PlanType
from sim_link.autopilot.protocols.plan_rules import (
    PlanChecks,
    plan_problem,
)
from sim_link.autopilot.px4 import firmware_profile as px4_firmware
from tests.unit.sim_link.autopilot.protocols.plan_client import (
    FENCE,
    MISSION,
    NAN,
    RALLY,
    waypoint,
)

PX4_RULES = px4_firmware.FIRMWARE.plans
ARDUPILOT_RULES = ardupilot_firmware.FIRMWARE.plans

PX4, ARDUPILOT = PX4_RULES.checks, ARDUPILOT_RULES.checks
BOTH = pytest.mark.parametrize("checks", [PX4, ARDUPILOT])
INF = math.inf
TAKEOFF, LAND, RTL = 22, 21, 20
JUMP = mavlink.MAV_CMD_DO_JUMP
VERTEX, HOLE, CIRCLE = 5001, 5002, 5003


def vertices(count: int, stated: float, command: int = VERTEX) -> list[PlanItem]:
    return [waypoint(n, command=command, params=(stated, 0.0, 0.0, 0.0)) for n in range(count)]


@BOTH
@pytest.mark.parametrize("frame", [0, 3, 5, 6])
def test_global_frames_are_taken_by_either_name(checks: PlanChecks, frame: int) -> None:
    assert checks.problem_with(waypoint(frame=frame), MISSION) is None


@BOTH
@pytest.mark.parametrize("frame", [1, 2, 4, 7, 8, 9, 10, 11, 20, 255])
def test_any_other_frame_of_a_position_is_unsupported(checks: PlanChecks, frame: int) -> None:
    problem = checks.problem_with(waypoint(frame=frame), MISSION)
    assert problem is PlanResult.UNSUPPORTED_FRAME


@BOTH
@pytest.mark.parametrize("command", [RTL, 178, 93, 1000, 2000])
def test_what_has_no_position_may_have_the_mission_frame(checks: PlanChecks, command: int) -> None:
    item = waypoint(command=command, frame=2, x=0, y=0, z=NAN)
    assert checks.problem_with(item, MISSION) is None


@BOTH
@pytest.mark.parametrize(
    ("command", "plan_type"),
    [(31_000, MISSION), (0, MISSION), (5001, MISSION), (16, FENCE), (5100, FENCE), (16, RALLY)],
)
def test_a_command_that_does_not_belong_there_is_unsupported(
    checks: PlanChecks, command: int, plan_type: PlanType
) -> None:
    problem = checks.problem_with(waypoint(command=command), plan_type)
    assert problem is PlanResult.UNSUPPORTED


@BOTH
@pytest.mark.parametrize("index", range(4))
def test_an_infinite_parameter_is_named(checks: PlanChecks, index: int) -> None:
    params = [0.0, 0.0, 0.0, 0.0]
    params[index] = INF
    problem = checks.problem_with(waypoint(params=tuple(params)), MISSION)
    assert problem == PlanResult.INVALID_PARAM1 + index


@BOTH
def test_a_nan_yaw_is_taken(checks: PlanChecks) -> None:
    assert checks.problem_with(waypoint(params=(0.0, 0.0, 0.0, NAN)), MISSION) is None


@pytest.mark.parametrize(("command", "index"), [(16, 0), (16, 1), (16, 2), (RTL, 3), (31_000, 3)])
def test_any_other_nan_is_named_on_ardupilot_and_taken_on_px4(command: int, index: int) -> None:
    params = [0.0, 0.0, 0.0, 0.0]
    params[index] = NAN
    item = waypoint(command=command, params=tuple(params))
    assert ARDUPILOT.problem_with(item, MISSION) == PlanResult.INVALID_PARAM1 + index
    assert PX4.problem_with(item, MISSION) in (None, PlanResult.UNSUPPORTED)


@BOTH
@pytest.mark.parametrize(
    ("x", "y", "z", "problem"),
    [
        (900_000_001, 0, 10.0, PlanResult.INVALID_PARAM5_X),
        (-900_000_001, 0, 10.0, PlanResult.INVALID_PARAM5_X),
        (NO_VALUE, 0, 10.0, PlanResult.INVALID_PARAM5_X),
        (0, 1_800_000_001, 10.0, PlanResult.INVALID_PARAM6_Y),
        (0, -(2**31), 10.0, PlanResult.INVALID_PARAM6_Y),
        (1, 1, NAN, PlanResult.INVALID_PARAM7),
        (1, 1, INF, PlanResult.INVALID_PARAM7),
        (1, 1, 83_001.0, PlanResult.INVALID_PARAM7),
        (900_000_000, -1_800_000_000, 83_000.0, None),
    ],
)
def test_a_position_must_be_on_the_globe(
    checks: PlanChecks, x: int, y: int, z: float, problem: PlanResult | None
) -> None:
    assert checks.problem_with(waypoint(x=x, y=y, z=z), MISSION) is problem


def test_zero_zero_is_here_on_ardupilot_and_refused_on_px4() -> None:
    item = waypoint(x=0, y=0)
    assert PX4.problem_with(item, MISSION) is PlanResult.INVALID_PARAM5_X
    assert ARDUPILOT.problem_with(item, MISSION) is None


@BOTH
@pytest.mark.parametrize("position", [(0, 0), (NO_VALUE, NO_VALUE)])
@pytest.mark.parametrize("command", [TAKEOFF, LAND, 17, 19])
def test_takeoff_landing_and_loitering_may_be_here(
    checks: PlanChecks, command: int, position: tuple[int, int]
) -> None:
    item = waypoint(command=command, x=position[0], y=position[1])
    assert checks.problem_with(item, MISSION) is None


@BOTH
def test_only_a_landing_may_leave_its_altitude_open(checks: PlanChecks) -> None:
    assert checks.problem_with(waypoint(command=LAND, z=NAN), MISSION) is None
    takeoff = checks.problem_with(waypoint(command=TAKEOFF, z=NAN), MISSION)
    assert takeoff is PlanResult.INVALID_PARAM7


@pytest.mark.parametrize(
    ("first", "second", "problem"),
    [
        (0.0, -1.0, None),
        (1.0, 3.0, None),
        (-1.0, 1.0, PlanResult.INVALID_PARAM1),
        (0.5, 1.0, PlanResult.INVALID_PARAM1),
        (NAN, 1.0, PlanResult.INVALID_PARAM1),
        (0.0, 0.5, PlanResult.INVALID_PARAM2),
        (0.0, NAN, PlanResult.INVALID_PARAM2),
    ],
)
def test_a_jump_needs_whole_numbers(
    first: float, second: float, problem: PlanResult | None
) -> None:
    item = waypoint(command=JUMP, frame=2, params=(first, second, 0.0, 0.0))
    assert PX4.problem_with(item, MISSION) is problem


def test_a_jump_beyond_the_mission_makes_no_plan() -> None:
    for target, problem in ((1.0, None), (2.0, PlanResult.INVALID_PARAM1)):
        items = [waypoint(), waypoint(command=JUMP, frame=2, params=(target, 1.0, 0.0, 0.0))]
        assert plan_problem(items, MISSION) is problem


@pytest.mark.parametrize("stated", [2.0, 0.0, -3.0, 3.5, NAN])
def test_a_polygon_has_at_least_three_vertices(stated: float) -> None:
    (item,) = vertices(1, stated)
    assert PX4.problem_with(item, FENCE) is PlanResult.INVALID_PARAM1


@pytest.mark.parametrize("radius", [0.0, -1.0, NAN])
def test_a_circle_has_a_radius(radius: float) -> None:
    item = waypoint(command=CIRCLE, params=(radius, 0.0, 0.0, 0.0))
    assert PX4.problem_with(item, FENCE) is PlanResult.INVALID_PARAM1


@pytest.mark.parametrize(
    ("items", "is_whole"),
    [
        ([], True),
        (vertices(3, 3.0), True),
        (vertices(3, 3.0) + vertices(4, 4.0, HOLE), True),
        (vertices(3, 3.0) + vertices(3, 3.0), True),
        (vertices(2, 3.0), False),
        (vertices(4, 3.0), False),
        (vertices(2, 3.0) + vertices(1, 3.0, HOLE), False),
        (vertices(2, 3.0) + vertices(1, 4.0), False),
        ([waypoint(command=CIRCLE), *vertices(3, 3.0), waypoint(command=5000)], True),
    ],
)
def test_the_vertices_of_a_polygon_follow_each_other(items: list[PlanItem], is_whole: bool) -> None:
    assert (plan_problem(items, FENCE) is None) is is_whole
