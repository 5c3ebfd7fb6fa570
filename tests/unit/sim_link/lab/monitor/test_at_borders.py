"""A vehicle at a border, or beyond it: its next setpoints, and their judgement."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.monitor.authority_invariants import OnlyWithAuthority
from sim_link.lab.monitor.fence_invariants import SafeToFreeze, SetpointsInside
from sim_link.lab.monitor.independent_checks import Point, depth_m, is_moved_inwards
from sim_link.lab.monitor.message_invariants import WithinEnvelope
from sim_link.lab.monitor.scene import SentSetpoint
from tests.loop.loop_helpers import AUTO
from tools.campaign.flights import Monitored, monitored_flight

FENCE = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0))
BORDER_NORTH_M = -150.0
"""North coordinate of the default fence's south edge."""
TICK_S = 0.05


SETPOINT = mavlink.MAVLink_set_position_target_local_ned_message(
    0, 1, 1, 1, 0xDF8, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)


def sent_beside(
    invariant_type: type[WithinEnvelope | OnlyWithAuthority | SetpointsInside],
    vehicles: list[Point],
    setpoints: list[Point],
    *,
    is_ours: bool,
    is_lied_to: bool = False,
    up_m: float = 15.0,
) -> list[str]:
    """Return the violations of setpoints, tick by tick, for these reported vehicle positions."""
    around = monitored_flight(AUTO, Scenario(), 1)
    scene = around.monitor.scene
    scene.observed.is_ours, scene.is_lied_to = is_ours, is_lied_to
    invariant = invariant_type(scene)
    for tick, (vehicle, position) in enumerate(zip(vehicles, setpoints, strict=True)):
        scene.now_s = tick * TICK_S
        scene.observed.position_enu_m, scene.observed.position_s = (*vehicle, up_m), scene.now_s
        invariant.setpoint(SentSetpoint(scene.now_s, (*position, up_m), SETPOINT))
    return [violation.what for violation in around.monitor.violations]


def line(north_m: float, steps_m: list[float]) -> list[Point]:
    """Return positions along a line from west to east."""
    east_m, positions = 10.0, []
    for step_m in steps_m:
        east_m += step_m
        positions.append((east_m, north_m))
    return positions


@pytest.mark.parametrize(
    ("vehicle", "position", "is_moved"),
    [
        ((50.0, 1.0), (50.0, 6.0), True),
        ((50.0, -3.0), (50.0, 4.0), True),
        ((50.0, -7.0), (50.0, 4.0), False),
        ((50.0, 1.0), (50.0, 12.0), False),
        ((50.0, 20.0), (50.0, 24.0), False),
    ],
)
def test_only_a_vehicle_at_a_border_is_moved_and_only_by_a_margin(
    vehicle: Point, position: Point, *, is_moved: bool
) -> None:
    assert is_moved_inwards(depth_m(FENCE, (), vehicle), vehicle, position) is is_moved


def test_what_moves_along_with_a_vehicle_beyond_a_border_is_not_accelerated() -> None:
    steps_m = [0.0, 0.05, 0.24, 0.24]
    vehicles = line(BORDER_NORTH_M - 1.0, steps_m)
    assert (
        sent_beside(WithinEnvelope, vehicles, line(BORDER_NORTH_M + 4.0, steps_m), is_ours=True)
        == []
    )


def test_what_moves_farther_than_that_is() -> None:
    vehicles = line(BORDER_NORTH_M - 1.0, [0.0, 0.05, 0.05, 0.05])
    setpoints = line(BORDER_NORTH_M + 4.0, [0.0, 0.05, 0.24, 0.24])
    found = sent_beside(WithinEnvelope, vehicles, setpoints, is_ours=True)
    assert found == ["setpoint accelerates too fast"]


def test_so_is_what_moves_along_with_a_vehicle_in_the_open() -> None:
    steps_m = [0.0, 0.05, 0.24, 0.24]
    found = sent_beside(WithinEnvelope, line(30.0, steps_m), line(30.0, steps_m), is_ours=True)
    assert found == ["setpoint accelerates too fast"]


def test_a_setpoint_may_begin_again_where_the_vehicle_is() -> None:
    vehicles = line(30.0, [0.0, 0.0, 0.0, 0.0])
    aside = [(10.07, 30.0), (10.07, 30.0)]
    assert sent_beside(WithinEnvelope, vehicles, [*aside, *vehicles[:2]], is_ours=True) == []
    elsewhere = [(9.96, 30.0), (9.96, 30.0)]
    found = sent_beside(WithinEnvelope, vehicles, [*aside, *elsewhere], is_ours=True)
    assert found == ["setpoint accelerates too fast"]


def test_in_standby_a_vehicle_beside_a_border_is_reported_the_nearest_place_inside() -> None:
    north_m = BORDER_NORTH_M + 0.5
    inside, far = (10.0, north_m + 4.0), (10.0, north_m + 12.0)
    vehicle = (10.0, north_m)
    assert sent_beside(OnlyWithAuthority, [vehicle], [inside], is_ours=False) == []
    found = sent_beside(OnlyWithAuthority, [vehicle], [far], is_ours=False)
    assert found == ["a setpoint that moves before control was given"]


STANDING = [(10.0, BORDER_NORTH_M + 0.5)] * 3


@pytest.mark.parametrize("north_m", [-0.5, 0.8, 1.4])
def test_what_stands_in_the_margin_may_stand_while_the_vehicle_is_pushed_about_there(
    north_m: float,
) -> None:
    vehicles = [*line(BORDER_NORTH_M + 0.5, [0.0, 0.1]), (10.2, BORDER_NORTH_M + north_m)]
    assert sent_beside(SetpointsInside, vehicles, STANDING, is_ours=True) == []


def test_what_moves_farther_into_the_margin_than_the_vehicle_may_not() -> None:
    vehicles = line(BORDER_NORTH_M + 0.5, [0.0, 0.1, 0.1])
    setpoints = [*STANDING[:2], (10.0, BORDER_NORTH_M + 0.4)]
    found = sent_beside(SetpointsInside, vehicles, setpoints, is_ours=True)
    assert found == ["setpoint too near to a border or beyond it"]


def test_what_stands_in_the_margin_is_no_place_for_a_vehicle_that_is_well_inside() -> None:
    vehicles = [(10.0, BORDER_NORTH_M + 30.0)] * 3
    found = sent_beside(SetpointsInside, vehicles, STANDING, is_ours=True)
    assert found == ["setpoint too near to a border or beyond it"] * 3


@pytest.mark.parametrize("is_ours", [False, True])
def test_where_a_stranger_says_that_the_vehicle_is_counts_only_without_control(
    *, is_ours: bool
) -> None:
    outside = [(10.0, BORDER_NORTH_M - 6.0)] * 3
    found = sent_beside(SetpointsInside, outside, outside, is_ours=is_ours, is_lied_to=True)
    assert found == ["setpoint too near to a border or beyond it"] * (3 if is_ours else 0)


@pytest.mark.parametrize("is_ours", [False, True])
def test_the_altitude_band_holds_whichever_position_is_right(*, is_ours: bool) -> None:
    inside = [(10.0, 30.0)]
    found = sent_beside(
        SetpointsInside, inside, inside, is_ours=is_ours, is_lied_to=True, up_m=500.0
    )
    assert found == ["setpoint above the altitude band"]


@pytest.mark.parametrize(
    ("is_dragged", "ahead_m", "found"),
    [
        (True, 0.0, []),
        (False, 0.0, ["a setpoint that freezes leads out of the fence"]),
        (True, -20.0, ["a setpoint that freezes leads out of the fence"]),
    ],
)
def test_a_vehicle_that_another_system_made_too_fast_can_only_be_stopped(
    found: list[str], ahead_m: float, *, is_dragged: bool
) -> None:
    around = monitored_flight(AUTO, Scenario(), 1)
    scene, position = around.monitor.scene, (10.0, BORDER_NORTH_M + 2.0, 15.0)
    scene.observed.is_ours = True
    body = scene.vehicle.body
    body.position_enu_m, body.velocity_enu_mps = position, (0.0, -8.0, 0.0)
    invariant = SafeToFreeze(scene, lambda: is_dragged)
    invariant.setpoint(SentSetpoint(0.0, (10.0, position[1] + ahead_m, 15.0), SETPOINT))
    assert [violation.what for violation in around.monitor.violations] == found


def taken_over(*modes: FlightMode) -> Monitored:
    """A flight over whose vehicle others chose these modes, and that then is beyond the fence."""
    around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour="ardupilot")), 1)
    around.flight.run(18.0)
    for mode in modes:
        around.operator.choose(mode)
        around.flight.run(0.5)
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(0.5)
    return around


@pytest.mark.slow
def test_what_the_first_mode_after_ours_has_to_brake_is_our_doing() -> None:
    assert taken_over(FlightMode.HOLD).monitor.fence.breaches == 1


@pytest.mark.slow
def test_where_it_drifts_to_in_the_modes_after_that_is_not() -> None:
    assert taken_over(FlightMode.HOLD, FlightMode.LAND).monitor.fence.breaches == 0


def test_what_creeps_through_the_margin_does_not_stand_there() -> None:
    vehicles = line(BORDER_NORTH_M + 0.5, [0.0] * 12)
    setpoints = [(10.0, BORDER_NORTH_M + 0.8 - 0.0015 * tick) for tick in range(12)]
    assert sent_beside(SetpointsInside, vehicles[:2], setpoints[:2], is_ours=True) == []
    deep = line(BORDER_NORTH_M + 2.0, [0.0] * 12)
    found = sent_beside(SetpointsInside, [*vehicles[:1], *deep[1:]], setpoints, is_ours=True)
    assert "setpoint too near to a border or beyond it" in found


def test_motion_of_before_control_was_given_is_excused_for_stopping_only() -> None:
    around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour="ardupilot")), 1)
    fence = around.monitor.fence
    fence.stepped()
    around.monitor.scene.observed.is_ours = True
    excused = []
    for now_s in (1.0, 4.9, 5.1):
        around.monitor.scene.now_s = now_s
        fence.stepped()
        excused.append((fence.is_moved_by_others, fence.is_excused))
    assert excused == [(True, False), (True, False), (False, False)]


@pytest.mark.parametrize(("begins_m", "breaches"), [(1.0, 0), (30.0, 1)])
def test_control_that_came_too_late_to_stop_is_no_breach(
    begins_m: float, breaches: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is one where the vehicle could still have been stopped when control was given."""
    around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour="ardupilot")), 1)
    scene, fence = around.monitor.scene, around.monitor.fence
    body = scene.vehicle.body
    scene.vehicle.aircraft.is_armed = True
    mode = property(lambda _: FlightMode.OFFBOARD)
    monkeypatch.setattr(type(scene.vehicle.flavour), "mode", mode)
    for tick, north_m in enumerate((begins_m, begins_m - 0.4, -0.5)):
        scene.now_s = 20.0 + 0.05 * tick
        scene.observed.is_ours = tick > 0
        body.position_enu_m = (10.0, BORDER_NORTH_M + north_m, 15.0)
        body.velocity_enu_mps = (0.0, -8.0, 0.0)
        fence.stepped()
    assert fence.breaches == breaches
