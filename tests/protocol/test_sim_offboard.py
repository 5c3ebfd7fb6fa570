"""Setpoints of the simulated PX4: validation, proof of life, loss and return."""

from __future__ import annotations

import math
import struct

import pytest

from companion.domain import FlightMode
from companion.geometry.coordinates import LocalOrigin
from companion.mav import dialect
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.scenario import AutopilotParams, LossAction, Scenario
from tests.protocol.sim_helpers import (
    ACCEPTED,
    NAN,
    TEMPORARILY_REJECTED,
    GroundStation,
    local_setpoint,
)

CRITICAL, ACTIVE = mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_ACTIVE
ORIGIN = LocalOrigin(47.397742, 8.545594, 488.0)
VELOCITY_ONLY = 0x0DC7


def global_setpoint(
    enu_m: tuple[float, float, float],
    frame: int = mavlink.MAV_FRAME_GLOBAL_INT,
    altitude_m: float | None = None,
) -> Message:
    lat, lon, alt = ORIGIN.geodetic_from_enu(enu_m)
    return mavlink.MAVLink_set_position_target_global_int_message(
        0,
        1,
        1,
        frame,
        dialect.POSITION_ONLY,
        round(lat * 1e7),
        round(lon * 1e7),
        alt if altitude_m is None else altitude_m,
        *[0.0] * 8,
    )


@pytest.fixture
def station() -> GroundStation:
    station = GroundStation()
    station.fly_offboard()
    return station


def test_flies_to_a_local_position_without_much_overshoot(station: GroundStation) -> None:
    station.inbox.clear()
    station.stream = lambda: local_setpoint(40.0, 70.0, -20.0)
    station.run(30.0)
    assert station.position == pytest.approx((40.0, 70.0, -20.0), abs=0.1)
    easts = [m.y for m in station.all(mavlink.MAVLink_local_position_ned_message)]
    assert max(easts) < 71.5


@pytest.mark.slow
def test_yaw_follows_when_it_is_not_masked(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(yaw=-1.5, mask=dialect.POSITION_AND_YAW)
    station.run(5.0)
    assert station.last(mavlink.MAVLink_attitude_message).yaw == pytest.approx(-1.5, abs=0.01)
    station.stream = local_setpoint
    station.run(2.0)
    assert station.last(mavlink.MAVLink_attitude_message).yaw == pytest.approx(-1.5, abs=0.01)


def test_turns_clockwise_at_a_yaw_rate(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(yaw_rate=0.2, mask=0x05F8)
    station.run(5.0)
    assert station.last(mavlink.MAVLink_attitude_message).yaw == pytest.approx(1.0, abs=0.05)


def test_flies_a_velocity_in_north_east_down(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(
        NAN, NAN, NAN, vx=2.0, vy=-1.0, vz=-0.5, mask=VELOCITY_ONLY
    )
    station.run(5.0)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert (report.vx, report.vy, report.vz) == pytest.approx((2.0, -1.0, -0.5), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "setpoint",
    [
        global_setpoint((30.0, 20.0, 12.0)),
        global_setpoint((30.0, 20.0, 12.0), mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, 12.0),
        global_setpoint((30.0, 20.0, 12.0), mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT, 12.0),
    ],
    ids=["above sea level", "above home", "above the terrain"],
)
def test_flies_to_a_global_position(station: GroundStation, setpoint: Message) -> None:
    station.stream = lambda: setpoint
    station.run(20.0)
    assert station.position == pytest.approx((20.0, 30.0, -12.0), abs=0.1)


def test_flies_an_acceleration_as_px4_does(station: GroundStation) -> None:
    fields = [0.0] * 6 + [0.5] + [0.0] * 4
    station.stream = lambda: mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, 0x0C3F, *fields
    )
    station.run(4.0)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert report.vx == pytest.approx(2.0, abs=0.3)
    assert station.mode is FlightMode.OFFBOARD


def attitude_setpoint(
    pitch_rad: float = 0.0, thrust: float = 0.5, yaw_rad: float = 0.0, mask: int = 0x07
) -> Message:
    cp, sp = math.cos(pitch_rad / 2.0), math.sin(pitch_rad / 2.0)
    cy, sy = math.cos(yaw_rad / 2.0), math.sin(yaw_rad / 2.0)
    q = [cp * cy, -sp * sy, sp * cy, cp * sy]
    return mavlink.MAVLink_set_attitude_target_message(0, 1, 1, mask, q, 0.0, 0.0, 0.0, thrust)


@pytest.mark.parametrize(
    ("setpoint", "acceleration_mps2"),
    [
        (attitude_setpoint(), (0.0, 0.0, 0.0)),
        (attitude_setpoint(thrust=0.55), (0.0, 0.0, -0.98)),
        (attitude_setpoint(pitch_rad=-0.1), (0.98, 0.0, 0.05)),
        (attitude_setpoint(pitch_rad=-0.1, yaw_rad=math.pi / 2.0), (0.0, 0.98, 0.05)),
    ],
    ids=["level", "more thrust", "nose down to the north", "nose down to the east"],
)
def test_flies_the_acceleration_of_an_attitude_and_its_thrust(
    station: GroundStation, setpoint: Message, acceleration_mps2: tuple[float, float, float]
) -> None:
    station.stream = lambda: setpoint
    station.run(1.5)
    first = station.last(mavlink.MAVLink_local_position_ned_message)
    station.run(1.0)
    then = station.last(mavlink.MAVLink_local_position_ned_message)
    gained_mps = (then.vx - first.vx, then.vy - first.vy, then.vz - first.vz)
    assert gained_mps == pytest.approx(acceleration_mps2, abs=0.1)
    assert station.mode is FlightMode.OFFBOARD


def test_flies_a_velocity_along_the_nose_in_the_body_frame(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(yaw=1.5, mask=dialect.POSITION_AND_YAW)
    station.run(4.0)
    frame = mavlink.MAV_FRAME_BODY_NED
    station.stream = lambda: local_setpoint(vx=2.0, mask=VELOCITY_ONLY, frame=frame)
    station.run(4.0)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert (report.vx, report.vy) == pytest.approx((0.14, 2.0), abs=0.05)


def test_losing_the_stream_is_a_failsafe_one_second_after_the_last_setpoint(
    station: GroundStation,
) -> None:
    station.run(0.1)
    station.send(local_setpoint())
    station.stream = None
    lost_s = station.run_until(lambda: station.mode is not FlightMode.OFFBOARD, 3.0)
    assert 1.0 <= lost_s <= 1.06
    assert station.mode is FlightMode.POSITION
    assert station.status == CRITICAL


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "mode"),
    [
        ("hold", FlightMode.HOLD),
        ("position", FlightMode.POSITION),
        ("return", FlightMode.RETURN),
        ("land", FlightMode.LAND),
    ],
)
def test_comes_back_to_offboard_by_itself_from_every_reaction(
    action: LossAction, mode: FlightMode
) -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(offboard_loss_action=action)))
    station.fly_offboard()
    station.stream = None
    station.run(2.0)
    assert (station.mode, station.status) == (mode, CRITICAL)
    station.stream = local_setpoint
    station.run(0.2)
    assert (station.mode, station.status) == (FlightMode.OFFBOARD, ACTIVE)


def test_does_not_come_back_if_the_operator_chose_another_mode(station: GroundStation) -> None:
    station.stream = None
    station.run(2.0)
    assert station.set_mode(FlightMode.OFFBOARD) == TEMPORARILY_REJECTED
    assert station.set_mode(FlightMode.LAND) == ACCEPTED
    assert station.status == ACTIVE
    station.stream = local_setpoint
    station.run(1.0)
    assert station.mode is FlightMode.LAND


def test_choosing_the_mode_of_the_failsafe_itself_ends_it_too() -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(offboard_loss_action="hold")))
    station.fly_offboard()
    station.stream = None
    station.run(2.0)
    assert station.set_mode(FlightMode.HOLD) == ACCEPTED
    assert station.status == ACTIVE
    station.stream = local_setpoint
    station.run(1.0)
    assert station.mode is FlightMode.HOLD


def test_a_failsafe_landing_ends_the_wish_for_offboard() -> None:
    station = GroundStation(Scenario(autopilot=AutopilotParams(offboard_loss_action="land")))
    station.fly_offboard()
    station.stream = None
    station.run_until(lambda: not station.is_armed, 40.0)
    station.stream = local_setpoint
    station.run(1.0)
    assert station.mode is FlightMode.HOLD
    assert station.status == mavlink.MAV_STATE_STANDBY


def test_without_sticks_position_mode_sinks() -> None:
    station = GroundStation()
    station.fly_offboard()
    station.stream = None
    station.run(2.0)
    down = station.position[2]
    station.run(3.0)
    assert 0.6 <= (station.position[2] - down) / 3.0 <= 0.9


@pytest.mark.parametrize(
    ("gap_s", "holds"), [(0.3, True), (0.6, True), (0.9, True), (1.1, False), (1.5, False)]
)
def test_gaps_in_the_stream(station: GroundStation, gap_s: float, holds: bool) -> None:
    station.stream = None
    station.send(local_setpoint())
    station.inbox.clear()
    station.run(gap_s)
    assert (station.mode is FlightMode.OFFBOARD) == holds
    station.send(local_setpoint())
    station.run(0.02)
    assert station.mode is FlightMode.OFFBOARD


PARTLY_INVALID = {
    "x is NaN": local_setpoint(x=NAN),
    "z is infinite": local_setpoint(z=-math.inf),
    "yaw is NaN": local_setpoint(yaw=NAN, mask=dialect.POSITION_AND_YAW),
    "velocity is NaN": local_setpoint(vx=NAN, mask=VELOCITY_ONLY),
    "altitude is NaN": global_setpoint((30.0, 20.0, 12.0), altitude_m=NAN),
    "no altitude above the terrain": global_setpoint(
        (30.0, 20.0, 12.0), mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT, NAN
    ),
}
"""Setpoints that PX4 accepts, and holds its position by."""
INVALID = {
    "all masked": local_setpoint(mask=0xFDFF),
    "everything masked": local_setpoint(mask=0xFFFF),
    "force bit": local_setpoint(mask=dialect.POSITION_ONLY | dialect.FORCE_SET),
    "global frame": local_setpoint(frame=mavlink.MAV_FRAME_GLOBAL),
    "body frame": local_setpoint(frame=mavlink.MAV_FRAME_BODY_NED),
    "offset frame": local_setpoint(frame=mavlink.MAV_FRAME_LOCAL_OFFSET_NED),
    "other system": local_setpoint(system=2),
    "other component": local_setpoint(component=191),
    "attitude without thrust": attitude_setpoint(pitch_rad=-0.3, mask=0x47),
    "body rates": attitude_setpoint(pitch_rad=-0.3, mask=0x80),
    "attitude is NaN": attitude_setpoint(pitch_rad=NAN),
    "thrust is NaN": attitude_setpoint(thrust=NAN),
    "thrust is too much": attitude_setpoint(thrust=1.5),
    "not an INT frame": global_setpoint((30.0, 20.0, 12.0), mavlink.MAV_FRAME_GLOBAL),
    "no latitude": mavlink.MAVLink_set_position_target_global_int_message(
        0, 1, 1, 5, dialect.POSITION_ONLY, 2**31 - 1, 0, 500.0, *[0.0] * 8
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", INVALID)
def test_an_invalid_setpoint_is_no_proof_of_life_and_moves_nothing(
    station: GroundStation, name: str
) -> None:
    before = station.position
    station.stream = lambda: INVALID[name]
    station.run(2.0)
    assert station.mode is FlightMode.POSITION  # the default of COM_OBL_RC_ACT, 0
    assert station.status == CRITICAL
    assert station.position[:2] == pytest.approx(before[:2], abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTLY_INVALID)
def test_a_setpoint_with_a_part_that_is_no_number_holds_the_place(
    station: GroundStation, name: str
) -> None:
    before = station.position
    station.stream = lambda: PARTLY_INVALID[name]
    station.run(2.0)
    assert station.mode is FlightMode.OFFBOARD
    assert station.position == pytest.approx(before, abs=0.3)


@pytest.mark.parametrize("mask", [dialect.POSITION_ONLY | 4, dialect.POSITION_ONLY | 1])
def test_a_setpoint_without_all_axes_keeps_offboard_and_stays_in_place(
    station: GroundStation, mask: int
) -> None:
    before = station.position
    station.stream = lambda: local_setpoint(90.0, 90.0, -50.0, mask=mask)
    station.run(5.0)
    assert station.mode is FlightMode.OFFBOARD
    assert station.position == pytest.approx(before, abs=0.3)


@pytest.mark.parametrize("axis", [dialect.X_IGNORE, dialect.Y_IGNORE, dialect.Z_IGNORE])
def test_a_global_setpoint_without_all_axes_gives_no_position(
    station: GroundStation, axis: int
) -> None:
    before = station.position
    setpoint = global_setpoint((90.0, 90.0, 50.0))
    assert isinstance(setpoint, mavlink.MAVLink_set_position_target_global_int_message)
    setpoint.type_mask = 0x0DC0 | axis
    station.stream = lambda: setpoint
    station.run(5.0)
    assert station.mode is FlightMode.OFFBOARD
    assert station.position == pytest.approx(before, abs=0.3)


def test_a_broadcast_setpoint_is_obeyed(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(20.0, system=0, component=0)
    station.run(10.0)
    assert station.position[0] == pytest.approx(20.0, abs=0.1)


def test_setpoints_outside_offboard_move_nothing() -> None:
    station = GroundStation()
    station.take_off()
    before = station.position
    station.stream = lambda: local_setpoint(90.0, 90.0, -50.0)
    station.run(5.0)
    assert station.position == pytest.approx(before, abs=0.1)


@pytest.mark.slow
def test_a_setpoint_under_the_ground_neither_lands_nor_disarms(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(z=20.0)
    station.run(30.0)
    assert station.position[2] == 0.0
    assert station.is_armed
    assert station.mode is FlightMode.OFFBOARD


def test_nothing_protects_the_vehicle_from_a_setpoint_far_away(station: GroundStation) -> None:
    station.stream = lambda: local_setpoint(x=1e9)
    station.run(5.0)
    report = station.last(mavlink.MAVLink_local_position_ned_message)
    assert report.vx == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e9, -1e9])
def test_senseless_parameters_are_stored_and_harm_only_the_flight(value: float) -> None:
    station = GroundStation()
    station.fly_offboard()
    store = station.sim.vehicle.flavour.parameters
    for spec in store.specs:
        kind = int(spec.kind)
        if spec.kind.is_integer:
            whole = int(value) if math.isfinite(value) else -1
            raw = struct.unpack("<f", struct.pack("<i", whole))[0]
            station.send(mavlink.MAVLink_param_set_message(1, 1, spec.name.encode(), raw, kind))
        else:
            station.send(mavlink.MAVLink_param_set_message(1, 1, spec.name.encode(), value, kind))
    for mode in (FlightMode.RETURN, FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.OFFBOARD):
        station.set_mode(mode)
        station.run(3.0)
    station.stream = None
    station.run(3.0)
    assert all(map(math.isfinite, station.sim.vehicle.body.position_enu_m))
    assert station.sim.parameters_text.count("\n") > 50


def test_a_cut_frame_on_a_stream_link_is_completed_by_the_next_chunk() -> None:
    station = GroundStation()
    station.run(2.5)
    frame = station.sender.encode(local_setpoint())
    for part in (frame[:20], frame[20:]):
        station.sim.receive(Chunk(0, part, None, is_datagram=False), station.now_s)
    assert station.sim.vehicle.setpoints.received == 1
