"""Faults while the companion launches by itself, and the control of the vehicle then."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import BatteryCharge, EkfPoor, PilotSticks, VehicleFault
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.loop.loop_helpers import Loop, flown_once
from tests.loop.test_authority import ENDLESS, SET_MODE, TICK_S, inject

pytestmark = pytest.mark.slow

FRUGAL = CompanionConfig(
    mission=SessionParams(
        engage="auto", stop_radius_m=0.3, battery_low_pct=5.0, battery_critical_pct=3.0
    )
)
"""A charge that is a failsafe to the autopilot is nothing to the companion."""


@flown_once
def climbing(flavour: FlavourName, config: CompanionConfig = ENDLESS) -> Loop:
    """Launched by itself, and half way up."""
    loop = Loop(config, Scenario(autopilot=AutopilotParams(flavour=flavour)), 1)
    loop.run(6.5)
    assert 8.0 < loop.true_positions[-1][2] < 12.0
    assert loop.phase is Phase.LAUNCHING
    return loop


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_nothing_is_armed_before_there_is_a_position(flavour: FlavourName) -> None:
    """ArduCopter's prearm bit is good in STABILIZE long before its estimator has a position."""
    autopilot = AutopilotParams(flavour=flavour, ready_after_s=20.0)
    loop = Loop(ENDLESS, Scenario(autopilot=autopilot), 1)
    loop.run(18.0)
    asked = {number for _, number in loop.commands}
    assert not asked & {SET_MODE, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF}
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 40.0)


def assert_left_alone(loop: Loop, since_s: float) -> None:
    """Nothing that moves the vehicle was sent, nor asked for, since a time."""
    assert loop.setpoints_since(since_s) == []
    assert [n for time_s, n in loop.commands if n == SET_MODE and time_s > since_s] == []


@pytest.mark.parametrize(
    ("flavour", "share", "config"),
    [("px4", 0.05, ENDLESS), ("ardupilot", 0.05, ENDLESS), ("ardupilot", 0.09, FRUGAL)],
)
def test_a_vehicle_whose_launch_a_failsafe_ended_is_not_taken(
    flavour: FlavourName, share: float, config: CompanionConfig
) -> None:
    loop = climbing(flavour, config)
    inject(loop, BatteryCharge(share=share))
    loop.run_until(lambda: loop.phase is Phase.YIELD, 3.0)
    assert loop.said("takeoff aborted: failsafe")
    ended_s = loop.now_s
    loop.run(15.0)
    assert_left_alone(loop, ended_s)
    assert not loop.said("in control")


def test_guided_after_a_failed_launch_needs_a_grant() -> None:
    loop = climbing("ardupilot", FRUGAL)
    inject(loop, BatteryCharge(share=0.09), BatteryCharge(start_s=3.0, share=0.8))
    loop.run_until(lambda: loop.phase is Phase.YIELD, 3.0)
    loop.run(12.0)
    loop.operator.choose(FlightMode.HOLD)
    loop.run(4.0)
    assert loop.phase is Phase.YIELD
    loop.operator.choose(FlightMode.OFFBOARD)
    loop.run(3.0)
    assert loop.phase is Phase.YIELD
    assert loop.said("GUIDED ignored: takeoff aborted")
    loop.operator.grant()
    loop.run(3.0)
    assert loop.phase in (Phase.NORMAL, Phase.HOLD)


@pytest.mark.parametrize("climbed_s", [6.5, 9.0, 9.8])
def test_a_pilot_who_holds_a_px4_during_its_climb_keeps_it(climbed_s: float) -> None:
    """Also if the vehicle then comes to where its takeoff would have ended."""
    loop = Loop(ENDLESS, Scenario(), 1)
    loop.run(climbed_s)
    assert loop.mode is FlightMode.TAKEOFF
    loop.choose(FlightMode.HOLD, is_reported_at_once=True)
    loop.run(2 * TICK_S)
    assert loop.phase is Phase.YIELD
    assert loop.said("takeoff aborted: mode is hold")
    held_s = loop.now_s
    loop.run(2.0)
    reposition(loop, 19.5)
    loop.run(10.0)
    assert loop.true_positions[-1][2] > 18.5
    assert_left_alone(loop, held_s)


def reposition(loop: Loop, height_m: float) -> None:
    """The operator moves a vehicle that holds."""
    origin = loop.flight.scenario.origin
    frame, number = mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION
    north, east = round(origin.latitude_deg * 1e7), round(origin.longitude_deg * 1e7)
    up_m = origin.altitude_m + height_m
    loop.send_to_vehicle(
        mavlink.MAVLink_command_int_message(
            1, 1, frame, number, 0, 0, -1.0, 1.0, 0.0, math.nan, north, east, up_m
        )
    )


@pytest.mark.parametrize(
    ("flavour", "fault", "words"),
    [
        ("px4", EkfPoor(duration_s=30.0), "autopilot's position estimate is poor"),
        ("ardupilot", PilotSticks(forward=0.8, duration_s=6.0), "pilot moves the sticks"),
    ],
)
def test_what_is_wrong_during_the_climb_ends_the_launch(
    flavour: FlavourName, fault: VehicleFault, words: str
) -> None:
    loop = climbing(flavour)
    inject(loop, fault)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 2.0)
    assert loop.said(f"takeoff aborted: {words}")
    ended_s = loop.now_s
    loop.run(10.0)
    assert_left_alone(loop, ended_s)
