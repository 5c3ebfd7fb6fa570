"""Commands, streams, payload and robustness of the simulated PX4, over MAVLink bytes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import FlightMode
from companion.link.ranging_sources import ranging_from_message
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import PayloadParams, Scenario
from tests.protocol.sim_helpers import (
    ACCEPTED,
    ARM,
    DENIED,
    FAILED,
    NAN,
    TAKEOFF,
    UNSUPPORTED,
    GroundStation,
    local_setpoint,
)

REQUEST_MESSAGE = mavlink.MAV_CMD_REQUEST_MESSAGE
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
GET_INTERVAL = mavlink.MAV_CMD_GET_MESSAGE_INTERVAL
ATTITUDE = float(mavlink.MAVLINK_MSG_ID_ATTITUDE)
PAYLOAD = 158


@pytest.fixture
def station() -> GroundStation:
    station = GroundStation()
    station.run(2.5)
    return station


def rates_hz(station: GroundStation, duration_s: float) -> dict[str, float]:
    station.inbox.clear()
    station.run(duration_s)
    names = [m.get_type() for _, m in station.inbox if m.get_srcComponent() == 1]
    return {name: names.count(name) / duration_s for name in set(names)}


def test_default_rates(station: GroundStation) -> None:
    assert rates_hz(station, 20.0) == pytest.approx(
        {
            "HEARTBEAT": 1.0,
            "ATTITUDE": 50.0,
            "ATTITUDE_QUATERNION": 50.0,
            "GLOBAL_POSITION_INT": 50.0,
            "HIGHRES_IMU": 50.0,
            "LOCAL_POSITION_NED": 30.0,
            "ODOMETRY": 30.0,
            "ALTITUDE": 10.0,
            "ATTITUDE_TARGET": 10.0,
            "DISTANCE_SENSOR": 10.0,
            "SERVO_OUTPUT_RAW": 10.0,
            "TIMESYNC": 10.0,
            "VFR_HUD": 10.0,
            "GPS_RAW_INT": 8.0,
            "EXTENDED_SYS_STATE": 5.0,
            "SYS_STATUS": 5.0,
            "ESTIMATOR_STATUS": 1.0,
            "MISSION_CURRENT": 1.0,
            "PING": 1.0,
            "SYSTEM_TIME": 1.0,
            "BATTERY_STATUS": 0.5,
            "HOME_POSITION": 0.5,
        },
        abs=0.11,
    )


@pytest.mark.parametrize(
    ("interval_us", "rate_hz", "answer_us"),
    [
        (20_000.0, 50.0, 20_000),
        (200_000.0, 5.0, 200_000),
        (1_000.0, 50.0, 20_000),
        (-1.0, 0.0, 0),
        (0.0, 50.0, 20_000),
    ],
)
def test_message_interval_changes_the_measured_rate(
    station: GroundStation, interval_us: float, rate_hz: float, answer_us: int
) -> None:
    assert station.command(SET_INTERVAL, ATTITUDE, 333_333.0) == ACCEPTED
    assert station.command(SET_INTERVAL, ATTITUDE, interval_us) == ACCEPTED
    assert rates_hz(station, 10.0).get("ATTITUDE", 0.0) == pytest.approx(rate_hz, abs=0.11)
    assert station.command(GET_INTERVAL, ATTITUDE) == ACCEPTED
    assert station.last(mavlink.MAVLink_message_interval_message).interval_us == answer_us
    assert station.command(REQUEST_MESSAGE, 244.0, ATTITUDE) == ACCEPTED
    assert len(station.all(mavlink.MAVLink_message_interval_message)) == 2


@pytest.mark.parametrize(
    ("number", "interval_us", "result"),
    [
        (0.0, 1e6, FAILED),
        (9999.0, 1e6, FAILED),
        (NAN, 1e6, DENIED),
        (0.5, 1e6, DENIED),
        (ATTITUDE, NAN, DENIED),
        (ATTITUDE, -5.0, DENIED),
        (ATTITUDE, math.inf, DENIED),
    ],
)
def test_message_interval_refuses(
    station: GroundStation, number: float, interval_us: float, result: int
) -> None:
    assert station.command(SET_INTERVAL, number, interval_us) == result
    rates = rates_hz(station, 5.0)
    assert rates["HEARTBEAT"] == pytest.approx(1.0, abs=0.21)
    assert rates["ATTITUDE"] == pytest.approx(50.0, abs=0.21)


def test_interval_of_an_unknown_message_is_zero(station: GroundStation) -> None:
    assert station.command(GET_INTERVAL, 12345.0) == ACCEPTED
    assert station.last(mavlink.MAVLink_message_interval_message).interval_us == 0
    assert station.command(GET_INTERVAL, NAN) == DENIED


def test_requested_message_comes_before_its_ack(station: GroundStation) -> None:
    station.inbox.clear()
    number = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert station.command(REQUEST_MESSAGE, number) == ACCEPTED
    assert [m.get_type() for _, m in station.inbox] == ["AUTOPILOT_VERSION", "COMMAND_ACK"]
    capabilities = station.last(mavlink.MAVLink_autopilot_version_message).capabilities
    assert capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED


@pytest.mark.parametrize("number", [NAN, 0.5, 9999.0, -1.0, math.inf, 1e30, 45010.0])
def test_requesting_what_it_does_not_have_is_denied(station: GroundStation, number: float) -> None:
    assert station.command(REQUEST_MESSAGE, number) == DENIED


def test_origin_and_home_are_distinguished(station: GroundStation) -> None:
    assert station.all(mavlink.MAVLink_gps_global_origin_message)
    station.inbox.clear()
    assert station.command(REQUEST_MESSAGE, 49.0) == ACCEPTED
    assert station.command(mavlink.MAV_CMD_GET_HOME_POSITION, 1.0) == ACCEPTED
    origin = station.last(mavlink.MAVLink_gps_global_origin_message)
    assert (origin.latitude, origin.longitude) == (473977420, 85455940)
    home = station.last(mavlink.MAVLink_home_position_message)
    assert (home.x, home.y, home.z) == (10.0, 10.0, 0.0)
    assert home.latitude - origin.latitude == pytest.approx(900, abs=5)


def test_global_and_local_position_agree(station: GroundStation) -> None:
    station.take_off()
    report = station.last(mavlink.MAVLink_global_position_int_message)
    assert report.alt == pytest.approx(498_000, abs=100)
    assert report.relative_alt == pytest.approx(10_000, abs=100)
    east, north, up = station.sim.vehicle.origin.enu_from_geodetic(
        report.lat / 1e7, report.lon / 1e7, report.alt / 1e3
    )
    assert (north, east, -up) == pytest.approx(station.position, abs=0.03)


@pytest.mark.parametrize("number", [mavlink.MAV_CMD_DO_SET_SERVO, 193 + 1000, 31010, 65535])
def test_other_commands_are_unsupported(station: GroundStation, number: int) -> None:
    assert station.command(number) == UNSUPPORTED
    assert station.command_int(number, 6) == UNSUPPORTED


def test_the_payload_answers_that_it_knows_no_command(station: GroundStation) -> None:
    station.inbox.clear()
    station.send(mavlink.MAVLink_command_long_message(1, PAYLOAD, ARM, 0, 1.0, *[0.0] * 6))
    (ack,) = station.all(mavlink.MAVLink_command_ack_message, PAYLOAD)
    assert (ack.command, ack.result, ack.target_system) == (ARM, UNSUPPORTED, 255)
    assert station.all(mavlink.MAVLink_command_ack_message) == []
    assert not station.is_armed


@pytest.mark.parametrize(("system", "component"), [(2, 1), (1, 191), (0, 7), (0, 0)])
def test_commands_for_an_absent_target_are_answered_by_failed(
    station: GroundStation, system: int, component: int
) -> None:
    assert station.command(ARM, 1.0, system=system, component=component) == FAILED
    station.inbox.clear()
    station.send(mavlink.MAVLink_set_mode_message(2, 1, 4 << 16 | 6 << 24))
    assert station.inbox == []
    assert not station.is_armed


def test_a_command_for_a_system_that_was_heard_is_left_to_it(station: GroundStation) -> None:
    heartbeat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    station.sim.receive(Chunk(0, MavCodec(1, 191).encode(heartbeat), ("127.0.0.1", 2)), 2.5)
    station.run(0.1)
    station.inbox.clear()
    station.send(mavlink.MAVLink_command_long_message(1, 191, ARM, 0, 1.0, *[0.0] * 6))
    assert station.all(mavlink.MAVLink_command_ack_message) == []


@pytest.mark.parametrize(("system", "component"), [(1, 1), (1, 0)])
def test_commands_for_all_are_obeyed(station: GroundStation, system: int, component: int) -> None:
    assert station.command(ARM, 1.0, system=system, component=component) == ACCEPTED
    assert station.is_armed


def test_command_int_arms_whatever_its_frame(station: GroundStation) -> None:
    assert station.command_int(ARM, 0, 1.0) == ACCEPTED
    assert station.is_armed


def test_timesync_and_ping_requests_are_answered_and_answers_are_not(
    station: GroundStation,
) -> None:
    station.inbox.clear()
    station.send(mavlink.MAVLink_timesync_message(0, 777))
    station.send(mavlink.MAVLink_timesync_message(5, 778))
    station.send(mavlink.MAVLink_ping_message(123, 9, 0, 0))
    station.send(mavlink.MAVLink_ping_message(124, 10, 1, 1))
    (sync,) = station.all(mavlink.MAVLink_timesync_message)
    assert (sync.ts1, sync.tc1) == (777, 2_500_000_000)
    (ping,) = station.all(mavlink.MAVLink_ping_message)
    assert (ping.time_usec, ping.seq, ping.target_system) == (123, 9, 255)


def test_a_rangefinder_tells_the_height_above_the_ground() -> None:
    station = GroundStation()
    station.take_off(12.0)
    reported = station.last(mavlink.MAVLink_distance_sensor_message)
    assert reported.current_distance == pytest.approx(-100.0 * station.position[2], abs=15.0)
    assert reported.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270


def test_payload_has_a_heartbeat_of_its_own_and_is_no_autopilot(station: GroundStation) -> None:
    beats = station.all(mavlink.MAVLink_heartbeat_message, component=PAYLOAD)
    assert len(beats) == 3
    assert beats[0].autopilot == mavlink.MAV_AUTOPILOT_INVALID
    assert beats[0].type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER


def test_payload_measures_ten_times_a_second_above_three_metres_only() -> None:
    station = GroundStation()
    station.take_off(2.8)
    station.run(5.0)
    assert not station.all(MAVLink_radio_ranging_message, component=PAYLOAD)
    assert station.command(TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, 498.0) == ACCEPTED
    station.run(8.0)
    station.inbox.clear()
    station.run(10.0)
    reports = station.all(MAVLink_radio_ranging_message, component=PAYLOAD)
    assert len(reports) == 100
    assert reports[0].range_std == pytest.approx(1.5)
    assert reports[0].bearing_std == pytest.approx(math.radians(2.0))
    assert reports[0].emitter_id == 1
    assert reports[0].flags == 0
    stamps = [m.time_usec for m in reports]
    assert np.diff(stamps) == pytest.approx(100_000)
    assert stamps[-1] / 1e6 == pytest.approx(station.now_s, abs=0.1)


def test_payload_bearing_points_at_the_emitter_in_the_enu_sense() -> None:
    station = GroundStation()
    station.take_off()
    station.run(20.0)
    reports = station.all(MAVLink_radio_ranging_message, component=PAYLOAD)
    measurements = [ranging_from_message(report, 0.0) for report in reports]
    bearings = [m.bearing_enu_rad for m in measurements if m and m.bearing_enu_rad is not None]
    ranges = [m.range_m for m in measurements if m and m.range_m is not None]
    assert math.degrees(float(np.mean(bearings))) == pytest.approx(45.0 - 3.0, abs=2.0)
    truth_m = math.sqrt(40.0**2 + 40.0**2 + 10.0**2)
    assert float(np.mean(ranges)) == pytest.approx(truth_m + 1.5 + 0.9 * 8.0, abs=2.5)


@pytest.mark.slow
def test_payload_hears_nothing_beyond_its_reach() -> None:
    station = GroundStation(Scenario(payload=PayloadParams(max_range_m=40.0)))
    station.take_off()
    assert not station.all(MAVLink_radio_ranging_message, component=PAYLOAD)
    station.stream = lambda: local_setpoint(40.0, 40.0, -10.0)
    station.run(0.5)
    assert station.set_mode(FlightMode.OFFBOARD) == ACCEPTED
    station.run(15.0)
    assert station.all(MAVLink_radio_ranging_message, component=PAYLOAD)


def test_every_frame_counts_up_in_its_own_component(station: GroundStation) -> None:
    for component in (1, PAYLOAD):
        numbers = [m.get_seq() for _, m in station.inbox if m.get_srcComponent() == component]
        assert set(np.diff(numbers) % 256) == {1}


@pytest.mark.slow
def test_position_noise_shows_in_reports_only() -> None:
    station = GroundStation(Scenario(position_noise_m=0.5))
    station.run(60.0)
    norths = [m.x for m in station.all(mavlink.MAVLink_local_position_ned_message)]
    assert float(np.mean(norths)) == pytest.approx(10.0, abs=0.1)
    assert float(np.std(norths)) == pytest.approx(0.5, rel=0.1)
    assert station.sim.vehicle.body.position_enu_m == (10.0, 10.0, 0.0)


def test_random_and_truncated_datagrams_change_nothing() -> None:
    station = GroundStation()
    station.run(2.5)
    rng = np.random.default_rng(5)
    good = station.sender.encode(local_setpoint())
    for index in range(10_000):
        if index % 2:
            data = rng.bytes(int(rng.integers(0, 300)))
        else:
            broken = bytearray(good[: int(rng.integers(1, len(good)))])
            broken[int(rng.integers(0, len(broken)))] ^= 0xFF
            data = bytes(broken)
        station.send_bytes(data)
    assert station.sim.vehicle.setpoints.received == 0
    assert station.command(ARM, 1.0) == ACCEPTED


@pytest.mark.parametrize("seed", range(4))
def test_well_formed_messages_with_random_fields_never_raise(seed: int) -> None:
    station = GroundStation()
    station.run(2.5)
    rng = np.random.default_rng(seed)
    station.sim.receive(Chunk(0, b"", None), station.now_s)
    for _ in range(500):
        station.send(random_message(rng))
        station.run(0.02)
    assert station.all(mavlink.MAVLink_local_position_ned_message)


def random_message(rng: np.random.Generator) -> Message:
    values = [NAN, math.inf, -math.inf, 3e38, -3e38, 0.0, 1.0, -1.0, 4.0, 6.0, 0.5, 21196.0]

    def number() -> float:
        return float(rng.choice(values))

    known = [ARM, TAKEOFF, 21, 20, 176, 511, 510, 512, 520, 410, 9999]
    command = int(rng.choice(known))
    mask = int(rng.choice([0x0DF8, 0x0DC7, 0, 0x0FFF, int(rng.integers(0, 0x10000))]))
    integers = [int(v) for v in rng.integers(-(2**31), 2**31, 2)]
    match int(rng.integers(0, 4)):
        case 0:
            fields = [number() for _ in range(7)]
            return mavlink.MAVLink_command_long_message(1, 1, command, 0, *fields)
        case 1:
            fields = [number() for _ in range(4)]
            frame = int(rng.integers(0, 256))
            return mavlink.MAVLink_command_int_message(
                1,
                1,
                frame,
                command,
                0,
                0,
                fields[0],
                fields[1],
                fields[2],
                fields[3],
                integers[0],
                integers[1],
                number(),
            )
        case 2:
            fields = [number() for _ in range(11)]
            return mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, *fields)
    fields = [number() for _ in range(9)]
    frame = int(rng.choice([5, 6]))
    return mavlink.MAVLink_set_position_target_global_int_message(
        0, 1, 1, frame, mask, *integers, *fields
    )


def flight_bytes(seed: int, started_s: float = 0.0) -> bytes:
    """Everything that a vehicle says in a minute with a takeoff."""
    sim, sender = SimEndpoint(Scenario(position_noise_m=0.1), seed, started_s), MavCodec(255, 190)
    said = []
    for step in range(60 * 50 + 1):
        now_s = started_s + step * 0.02
        if step == 150:
            for number, first in ((ARM, 1.0), (TAKEOFF, NAN)):
                message = mavlink.MAVLink_command_long_message(
                    1, 1, number, 0, first, 0.0, NAN, NAN, NAN, NAN, 500.0
                )
                sim.receive(Chunk(0, sender.encode(message)), now_s)
        sim.handle_timer(now_s)
        said += [chunk.data for chunk in sim.take_output()]
    return b"".join(said)


@pytest.mark.slow
def test_the_same_seed_says_the_same_bytes() -> None:
    first = flight_bytes(3)
    assert len(first) > 100_000
    assert flight_bytes(3) == first
    assert flight_bytes(4) != first


def test_time_counts_from_boot() -> None:
    sim, receiver = SimEndpoint(Scenario(), 1, started_s=1000.0), MavCodec(255, 190)
    assert sim.next_timer_s() == 1000.0
    sim.handle_timer(1000.0)
    sim.take_output()
    sim.handle_timer(sim.next_timer_s() + 0.4)
    chunks = sim.take_output()
    messages = [m for chunk in chunks for m in receiver.decode(chunk.data)]
    stamps = [m.time_boot_ms for m in messages if hasattr(m, "time_boot_ms")]
    assert stamps == sorted(stamps)
    assert stamps[-1] == pytest.approx(420, abs=40)
    assert sim.next_timer_s() == pytest.approx(1000.44)


def test_a_late_timer_skips_ahead_without_a_burst() -> None:
    sim = SimEndpoint(Scenario(), 1)
    sim.handle_timer(0.0)
    sim.take_output()
    sim.handle_timer(30.0)
    assert 0 < len(sim.take_output()) < 30
    assert sim.next_timer_s() == pytest.approx(30.02)
    sim.handle_timer(31.0)
    assert len(sim.take_output()) < 30


def test_tells_the_operator_what_happened_once() -> None:
    station = GroundStation()
    station.fly_offboard()
    station.stream = None
    station.run(2.0)
    texts = [occurrence.text for occurrence in station.sim.take_occurrences()]
    assert texts == [
        "armed",
        "mode hold -> takeoff (commanded)",
        "in the air",
        "mode takeoff -> hold (takeoff complete)",
        "mode hold -> offboard (commanded)",
        "mode offboard -> position (failsafe: no setpoints)",
    ]
    assert station.sim.take_occurrences() == []
    modes = [change.mode for change in station.sim.recorder.mode_changes]
    assert modes == [FlightMode.TAKEOFF, FlightMode.HOLD, FlightMode.OFFBOARD, FlightMode.POSITION]


def test_stopping_finishes_at_once() -> None:
    sim = SimEndpoint(Scenario(), 1)
    assert not sim.is_finished
    sim.request_stop(0.0)
    assert sim.is_finished
