"""POSITION_TARGET_*: the target that is flown, as each autopilot reports it."""

from __future__ import annotations

import math

import pytest

from companion.domain import FlightMode
from companion.mav import dialect
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from tests.protocol.sim_helpers import ACCEPTED, ARM, FAILED, TAKEOFF, GroundStation, local_setpoint

LOCAL, GLOBAL = 85.0, 87.0
LocalEcho = mavlink.MAVLink_position_target_local_ned_message
VELOCITY_ONLY = 0xDC7
ACCELERATION_ONLY = 0xC3F


@pytest.fixture(scope="module")
def px4() -> GroundStation:
    station = GroundStation()
    station.fly_offboard()
    return station


@pytest.fixture(scope="module")
def copter() -> GroundStation:
    station = GroundStation(Scenario(autopilot=AutopilotParams(flavour="ardupilot")))
    station.run(3.0)
    assert station.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(TAKEOFF, *[0.0] * 6, 10.0) == ACCEPTED
    station.run(9.0)
    return station


def fly(station: GroundStation, setpoint: Message) -> LocalEcho:
    """Stream a setpoint for a second; return the echoed target."""
    station.stream = lambda: setpoint
    station.run(1.0)
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, LOCAL) == ACCEPTED
    return station.last(LocalEcho)


def test_px4_tells_the_place_and_the_velocity_that_follows_from_it(px4: GroundStation) -> None:
    echo = fly(px4, local_setpoint(30.0, 10.0, -12.0))
    assert (echo.coordinate_frame, echo.type_mask) == (mavlink.MAV_FRAME_LOCAL_NED, 0)
    assert (echo.x, echo.y, echo.z) == (30.0, 10.0, -12.0)
    assert echo.vx > 3.0
    assert echo.vz < -0.5
    assert echo.yaw == pytest.approx(px4.sim.vehicle.aircraft.heading_ned_rad)


def test_px4_tells_a_velocity_with_no_place_and_nan_for_it(px4: GroundStation) -> None:
    echo = fly(px4, local_setpoint(vx=1.0, vy=-2.0, mask=VELOCITY_ONLY))
    assert echo.type_mask == dialect.POSITION_IGNORE
    assert (echo.vx, echo.vy, echo.vz) == pytest.approx((1.0, -2.0, 0.0))
    assert all(math.isnan(value) for value in (echo.x, echo.y, echo.z))


def test_px4_tells_who_of_two_senders_was_heard_last(px4: GroundStation) -> None:
    ours, theirs = local_setpoint(20.0, 20.0, -10.0), local_setpoint(0.0, 0.0, -10.0)
    fly(px4, ours)
    px4.stream = None
    px4.inbox.clear()
    for _ in range(10):
        px4.send(ours)
        px4.run(0.1)
        px4.send(theirs)
        px4.run(0.1)
    assert {echo.x for echo in px4.all(LocalEcho)} == {20.0, 0.0}


def test_px4_tells_where_it_holds_and_nothing_once_disarmed(px4: GroundStation) -> None:
    held = fly(px4, local_setpoint(15.0, 15.0, -10.0))
    px4.run(9.0)
    assert px4.set_mode(FlightMode.HOLD) == ACCEPTED
    px4.stream = None
    px4.run(0.5)
    echo = px4.last(LocalEcho)
    assert (echo.x, echo.y, echo.z) == pytest.approx((held.x, held.y, held.z), abs=0.2)
    assert px4.command(ARM, 0.0, 21196.0) == ACCEPTED
    px4.run(0.2)
    px4.inbox.clear()
    px4.run(1.0)
    assert not px4.all(LocalEcho)


@pytest.mark.parametrize(
    ("setpoint", "ignored"),
    [
        (local_setpoint(20.0, 10.0, -10.0), ~dialect.POSITION_IGNORE & 0xDFF),
        (local_setpoint(vx=1.0, mask=VELOCITY_ONLY), dialect.POSITION_IGNORE | 0xC00),
        (local_setpoint(20.0, 10.0, -10.0, vx=1.0, mask=0xDC0), 0xC00),
        (local_setpoint(mask=ACCELERATION_ONLY), 0xC3F),
    ],
)
def test_arducopter_tells_what_it_was_sent_and_zeros(
    copter: GroundStation, setpoint: Message, ignored: int
) -> None:
    echo = fly(copter, setpoint)
    assert echo.type_mask == ignored
    if not ignored & dialect.POSITION_IGNORE:
        moved_m = 0.0 if ignored & dialect.VELOCITY_IGNORE else 0.1  # it runs on
        position = (20.0 + moved_m, 10.0, -10.0)
        assert (echo.x, echo.y, echo.z) == pytest.approx(position)
    else:
        assert (echo.x, echo.y, echo.z) == (0.0, 0.0, 0.0)
    assert (echo.yaw, echo.yaw_rate) == (0.0, 0.0)


def test_arducopter_tells_a_velocity_of_zero_after_its_timeout(copter: GroundStation) -> None:
    assert fly(copter, local_setpoint(vx=1.0, mask=VELOCITY_ONLY)).vx == 1.0
    copter.stream = None
    copter.run(3.2)
    assert copter.command(mavlink.MAV_CMD_REQUEST_MESSAGE, LOCAL) == ACCEPTED
    echo = copter.last(LocalEcho)
    assert (echo.type_mask, echo.vx) == (dialect.POSITION_IGNORE | 0xC00, 0.0)


def test_arducopter_tells_a_global_target_only_where_there_is_a_place(
    copter: GroundStation,
) -> None:
    fly(copter, local_setpoint(20.0, 10.0, -10.0))
    assert copter.command(mavlink.MAV_CMD_REQUEST_MESSAGE, GLOBAL) == ACCEPTED
    echo = copter.last(mavlink.MAVLink_position_target_global_int_message)
    assert echo.alt == pytest.approx(498.0, abs=0.01)
    fly(copter, local_setpoint(vx=1.0, mask=VELOCITY_ONLY))
    assert copter.command(mavlink.MAV_CMD_REQUEST_MESSAGE, GLOBAL) == FAILED


def test_arducopter_tells_nothing_outside_guided(copter: GroundStation) -> None:
    copter.stream = None
    assert copter.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 17.0) == ACCEPTED
    assert copter.command(mavlink.MAV_CMD_REQUEST_MESSAGE, LOCAL) == FAILED
