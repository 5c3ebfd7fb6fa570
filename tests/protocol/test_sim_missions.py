"""Uploaded missions and fences are flown and kept, by both autopilots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from companion.domain import FlightMode
from companion.geometry.coordinates import LocalOrigin
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from tests.protocol.sim_helpers import ACCEPTED, ARM, FAILED, NAN, SET_MODE, GroundStation

ORIGIN = LocalOrigin(47.397742, 8.545594, 488.0)
WAYPOINT, TAKEOFF, LAND, RTL = 16, 22, 21, 20
CHANGE_SPEED, JUMP = 178, 177
Item = tuple[int, tuple[float, float, float] | None, tuple[float, float, float, float]]
"""Command, east-north-up position above home, parameters 1 to 4."""
OUT: list[Item] = [
    (TAKEOFF, (10.0, 10.0, 10.0), (0.0, 0.0, 0.0, NAN)),
    (WAYPOINT, (40.0, 10.0, 10.0), (0.0, 0.0, 0.0, NAN)),
    (WAYPOINT, (40.0, 40.0, 15.0), (1.0, 0.0, 0.0, NAN)),
]
HOME: Item = (WAYPOINT, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, NAN))


def message_of(item: Item, seq: int, mission_type: int = 0) -> Message:
    command, position, params = item
    frame, x, y, z = 2, 0, 0, 0.0
    if position is not None:
        lat, lon, _ = ORIGIN.geodetic_from_enu(position)
        frame, x, y, z = 6, round(lat * 1e7), round(lon * 1e7), position[2]
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, int(seq == 0), 1, *params, x, y, z, mission_type
    )


def upload(station: GroundStation, items: Sequence[Item], mission_type: int = 0) -> None:
    station.send(mavlink.MAVLink_mission_count_message(1, 1, len(items), mission_type))
    for seq, item in enumerate(items):
        station.send(message_of(item, seq, mission_type))
    assert station.last(mavlink.MAVLink_mission_ack_message).type == 0


def station_of(flavour: FlavourName, items: Sequence[Item]) -> GroundStation:
    """Booted, with a mission; ArduPilot's has its home in front."""
    station = GroundStation(Scenario(autopilot=AutopilotParams(flavour=flavour)))
    station.run(2.5)
    for number in (32, 33, 42):
        interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        assert station.command(interval, float(number), 1e5) == ACCEPTED
    upload(station, [HOME, *items] if flavour == "ardupilot" else items)
    return station


def start(station: GroundStation, flavour: FlavourName) -> None:
    if flavour == "ardupilot":
        assert station.command(SET_MODE, 1.0, 4.0) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(mavlink.MAV_CMD_MISSION_START, 0.0, 0.0) == ACCEPTED


def reached(station: GroundStation) -> list[int]:
    return [m.seq for m in station.all(mavlink.MAVLink_mission_item_reached_message)]


def state(station: GroundStation) -> int:
    return int(station.last(mavlink.MAVLink_mission_current_message).mission_state)


def test_a_changed_mission_is_announced_once() -> None:
    station = GroundStation(Scenario())
    station.run(2.5)
    interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    assert station.command(interval, 42.0, -1.0) == ACCEPTED
    before = len(station.all(mavlink.MAVLink_mission_current_message))
    upload(station, OUT)
    station.run(1.5)
    (announced,) = station.all(mavlink.MAVLink_mission_current_message)[before:]
    assert announced.total == len(OUT)


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_every_waypoint_is_reached_in_order_and_reported(flavour: FlavourName) -> None:
    station = station_of(flavour, OUT)
    assert state(station) == 2
    start(station, flavour)
    first = 1 if flavour == "ardupilot" else 0
    station.run_until(lambda: len(reached(station)) == 3, 90.0)
    assert reached(station) == [first, first + 1, first + 2]
    station.run(5.0)
    assert state(station) == 5
    assert station.position == pytest.approx((40.0, 40.0, -15.0), abs=0.5)
    assert station.sim.vehicle.flavour.mode is (
        FlightMode.HOLD if flavour == "px4" else FlightMode.MISSION
    )


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize("ending", [LAND, RTL])
def test_a_mission_ends_on_the_ground_disarmed(flavour: FlavourName, ending: int) -> None:
    last: Item = (ending, (40.0, 20.0, 0.0) if ending == LAND else None, (0.0, 0.0, 0.0, 0.0))
    station = station_of(flavour, [*OUT, last])
    start(station, flavour)
    station.run_until(lambda: not station.sim.vehicle.is_armed, 180.0)
    east, north, up = station.sim.vehicle.body.position_enu_m
    goal = (40.0, 20.0) if ending == LAND else (10.0, 10.0)
    assert math.dist((east, north), goal) < 2.0
    assert up == pytest.approx(0.0, abs=1e-3)


@pytest.mark.slow
def test_a_speed_and_a_jump_are_obeyed() -> None:
    items: list[Item] = [
        OUT[0],
        (CHANGE_SPEED, None, (1.0, 2.0, -1.0, 0.0)),
        OUT[1],
        (WAYPOINT, (10.0, 10.0, 10.0), (0.0, 0.0, 0.0, NAN)),
        (JUMP, None, (2.0, 1.0, 0.0, 0.0)),
    ]
    station = station_of("px4", items)
    start(station, "px4")
    station.run_until(lambda: state(station) == 5, 200.0)
    assert reached(station) == [0, 1, 2, 3, 4, 2, 3, 4]
    speeds = [
        math.hypot(m.vx, m.vy) for m in station.all(mavlink.MAVLink_local_position_ned_message)
    ]
    assert max(speeds) < 2.2


@pytest.mark.slow
def test_a_pause_keeps_the_place_in_the_mission() -> None:
    station = station_of("px4", OUT)
    start(station, "px4")
    station.run_until(lambda: reached(station) == [0], 30.0)
    station.run(2.0)
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    station.run(5.0)
    assert state(station) == 4
    rest = station.position
    station.run(3.0)
    assert station.position == pytest.approx(rest, abs=0.05)
    assert station.set_mode(FlightMode.MISSION) == ACCEPTED
    station.run_until(lambda: reached(station) == [0, 1, 2], 60.0)


def test_ardupilot_wants_a_take_off_first() -> None:
    station = station_of("ardupilot", OUT[1:])
    assert station.command(SET_MODE, 1.0, 4.0) == ACCEPTED
    assert station.command(ARM, 1.0) == ACCEPTED
    assert station.command(mavlink.MAV_CMD_MISSION_START, 0.0, 0.0) == FAILED
    texts = [m.text for m in station.all(mavlink.MAVLink_statustext_message)]
    assert "Mode change to AUTO failed: missing takeoff cmd" in texts


def test_an_uploaded_fence_is_kept_to() -> None:
    station = GroundStation()
    station.run(2.5)
    corners = [(-5.0, -5.0), (25.0, -5.0), (25.0, 25.0), (-5.0, 25.0)]
    vertices: list[Item] = [(5001, (*c, 0.0), (4.0, 0.0, 0.0, 0.0)) for c in corners]
    upload(station, vertices, mission_type=1)
    upload(station, OUT)
    start(station, "px4")
    station.run_until(lambda: station.status == mavlink.MAV_STATE_CRITICAL, 60.0)
    assert station.mode is FlightMode.HOLD
    assert station.position[1] == pytest.approx(25.0, abs=2.0)


def test_a_mission_survives_nothing_but_its_clearing() -> None:
    station = station_of("px4", OUT)
    start(station, "px4")
    station.run_until(lambda: reached(station) == [0], 30.0)
    station.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))
    station.run(1.0)
    assert state(station) == 1
    assert station.mode is FlightMode.HOLD
