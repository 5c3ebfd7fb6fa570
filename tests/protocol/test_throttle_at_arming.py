"""Arming with a throttle that is not down, and the end of an override, as of the autopilots."""

from __future__ import annotations

import pytest

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import PilotSticks
from sim_link.autopilot.scenario import AutopilotParams, RcParams, Scenario
from tests.protocol.sim_helpers import (
    ACCEPTED,
    ARM,
    FAILED,
    SET_MODE,
    TEMPORARILY_REJECTED,
    GroundStation,
)

STABILIZE, GUIDED, LOITER = 0, 4, 5
FORCE = 21_196.0
PREARM = mavlink.MAV_SYS_STATUS_PREARM_CHECK
RC_CHANNELS = float(mavlink.MAVLINK_MSG_ID_RC_CHANNELS)


def copter(parameters: dict[str, float] | None = None) -> GroundStation:
    autopilot = AutopilotParams(flavour="ardupilot", parameters=parameters or {})
    station = GroundStation(Scenario(autopilot=autopilot))
    station.run(2.5)
    return station


def override(station: GroundStation, throttle_us: int) -> None:
    pulses = (1500, 1500, throttle_us, 1500, 0, 0, 0, 0)
    station.send(mavlink.MAVLink_rc_channels_override_message(1, 1, *pulses))


def throttle_us(station: GroundStation) -> int:
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, RC_CHANNELS) == ACCEPTED
    return int(station.last(mavlink.MAVLink_rc_channels_message).chan3_raw)


def texts(station: GroundStation) -> list[str]:
    return [each.text for each in station.all(mavlink.MAVLink_statustext_message)]


@pytest.mark.parametrize("mode", [STABILIZE, GUIDED, LOITER])
@pytest.mark.parametrize(
    ("pulse_us", "result"), [(1000, ACCEPTED), (1020, ACCEPTED), (1100, FAILED), (1500, FAILED)]
)
def test_arducopter_refuses_to_arm_in_any_mode_unless_the_throttle_is_down(
    mode: int, pulse_us: int, result: int
) -> None:
    station = copter()
    assert station.command(SET_MODE, 1.0, float(mode)) == ACCEPTED
    override(station, pulse_us)
    assert station.command(ARM, 1.0) == result
    assert ("Arm: Throttle (RC3) is not neutral" in texts(station)) is (result == FAILED)


def test_by_force_it_arms_with_any_throttle_and_the_prearm_bit_never_shows_it() -> None:
    station = copter()
    override(station, 1700)
    station.run(0.2)
    status = mavlink.MAVLINK_MSG_ID_SYS_STATUS
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, float(status)) == ACCEPTED
    health = station.last(mavlink.MAVLink_sys_status_message).onboard_control_sensors_health
    assert health & PREARM
    assert station.command(ARM, 1.0, FORCE) == ACCEPTED


@pytest.mark.parametrize(("seconds", "ends_s"), [(None, 3.0), (1.0, 1.0)])
def test_an_override_of_arducopter_ends_after_its_time_and_the_throttle_is_down_again(
    seconds: float | None, ends_s: float
) -> None:
    station = copter({} if seconds is None else {"RC_OVERRIDE_TIME": seconds})
    override(station, 1600)
    station.run(ends_s - 0.2)
    assert throttle_us(station) == 1600
    station.run(0.4)
    assert throttle_us(station) == 1000
    assert station.command(ARM, 1.0) == ACCEPTED


@pytest.mark.parametrize("seconds", [0.0, -1.0])
def test_an_override_of_arducopter_may_be_off_or_last_for_ever(seconds: float) -> None:
    station = copter({"RC_OVERRIDE_TIME": seconds})
    override(station, 1600)
    station.run(20.0)
    assert throttle_us(station) == (1000 if seconds == 0.0 else 1600)


@pytest.mark.parametrize(
    ("mode", "up", "refusal"),
    [
        (FlightMode.POSITION, 0.0, None),
        (FlightMode.POSITION, 0.5, "throttle above center"),
        (FlightMode.ALTITUDE, 0.5, "throttle above center"),
        (FlightMode.STABILIZED, 0.0, "high throttle"),
        (FlightMode.STABILIZED, -0.9, None),
        (FlightMode.HOLD, 0.9, None),
    ],
)
def test_px4_refuses_to_arm_by_the_throttle_in_modes_for_sticks(
    mode: FlightMode, up: float, refusal: str | None
) -> None:
    station = GroundStation(Scenario(rc=RcParams(is_present=True)))
    station.run(3.0)
    assert station.set_mode(mode) == ACCEPTED
    sticks = PilotSticks(forward=0.0, up=up, duration_s=5.0)
    station.sim.apply_incident(sticks, station.now_s)
    station.run(0.1)
    expected = ACCEPTED if refusal is None else TEMPORARILY_REJECTED
    assert station.command(ARM, 1.0) == expected
    assert any(f"Arming denied: {refusal}" in each for each in texts(station)) is (
        refusal is not None
    )
