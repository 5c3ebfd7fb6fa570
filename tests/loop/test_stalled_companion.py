"""The companion's process stands still for seconds in control, as by SIGSTOP, and wakes up."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import IN_CONTROL, Phase
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import VehicleReboot
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import Loop, flown_once

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
FAR = EmitterParams(position_enu_m=(90.0, 60.0))
STALL_S = 3.0
NEAR_M = 2.0
"""A setpoint this near holds the vehicle where it is; plans lead 8 m ahead."""
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE


@flown_once
def searching(flavour: FlavourName, *, bears_silence: bool = False) -> Loop:
    """Return a flight in control at its full speed."""
    autopilot = AutopilotParams(
        flavour=flavour, offboard_loss_timeout_s=10.0 if bears_silence else 1.0
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    loop = Loop(config, Scenario(emitter=FAR, autopilot=autopilot), seed=3)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(4.0)
    return loop


def stall(loop: Loop, duration_s: float = STALL_S) -> float:
    """Stand still from now on; the time of waking up."""
    loop.flight.suspend_companion(duration_s)
    return loop.now_s + duration_s


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("duration_s", [1.2, pytest.param(3.0, marks=pytest.mark.slow), 8.0])
def test_the_first_setpoints_after_it_stay_where_the_vehicle_is_and_the_search_goes_on(
    flavour: FlavourName, duration_s: float
) -> None:
    loop = searching(flavour, bears_silence=True)
    woken_s = stall(loop, duration_s)
    commands = len(loop.commands)
    loop.run(duration_s + 1.0)
    assert loop.said(f"control loop stalled {duration_s:.1f} s: reacquiring state")
    early = [sent for sent in loop.setpoints_since(woken_s - 0.01) if sent.time_s < woken_s + 0.5]
    for sent in early:
        assert math.dist(sent.position_enu_m, sent.vehicle_enu_m) < NEAR_M, sent
    loop.run(5.0)
    assert loop.mode is FlightMode.OFFBOARD
    assert loop.phase is Phase.NORMAL
    assert loop.setpoints_since(woken_s + 4.0)
    assert SET_MODE not in {number for _, number in loop.commands[commands:]}


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND])
def test_a_mode_that_was_left_meanwhile_gets_no_setpoint_although_older_heartbeats_wait(
    flavour: FlavourName, mode: FlightMode
) -> None:
    """The socket is full of what came first: HEARTBEATs in OFFBOARD or GUIDED."""
    loop = searching(flavour)
    woken_s = stall(loop)
    loop.run(0.5 * STALL_S)
    loop.choose(mode)
    loop.run(0.5 * STALL_S + 4.0)
    assert loop.setpoints_since(woken_s - 0.01) == []
    assert loop.phase not in IN_CONTROL
    assert loop.mode is mode or not loop.sim.vehicle.is_armed


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_px4_that_ended_the_mode_meanwhile_is_not_asked_for_it(flavour: FlavourName) -> None:
    loop = searching(flavour)
    commands = len(loop.commands)
    stall(loop)
    loop.run(STALL_S + 6.0)
    asked = {number for _, number in loop.commands[commands:]}
    assert not asked & {SET_MODE, mavlink.MAV_CMD_COMPONENT_ARM_DISARM}
    assert (loop.phase in IN_CONTROL) is (loop.mode is FlightMode.OFFBOARD)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_an_autopilot_that_restarted_meanwhile_is_not_flown_on_the_frame_of_before(
    flavour: FlavourName,
) -> None:
    loop = searching(flavour)
    woken_s = stall(loop, 6.0)
    loop.run(1.0)
    loop.flight.apply_incident(VehicleReboot(down_s=1.0))
    loop.run(12.0)
    for sent in loop.setpoints_since(woken_s - 0.01):  # PX4 gets "stay here" in standby
        assert math.dist(sent.position_enu_m[:2], sent.vehicle_enu_m[:2]) < NEAR_M, sent
    assert loop.phase not in IN_CONTROL
    assert not loop.sim.vehicle.is_armed


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_several_in_a_row_never_move_it_by_old_data(flavour: FlavourName) -> None:
    loop = searching(flavour, bears_silence=True)
    for _ in range(4):
        woken_s = stall(loop, 1.5)
        loop.run(1.5 + 0.4)
        for sent in loop.setpoints_since(woken_s - 0.01):
            assert math.dist(sent.position_enu_m, sent.vehicle_enu_m) < NEAR_M, sent
