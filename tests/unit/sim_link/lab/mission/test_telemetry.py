"""The operator's telemetry, read from a vehicle's frames."""

from __future__ import annotations

import math

import pytest

from companion.domain import Autopilot, FlightMode
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.flight_modes import px4_custom_mode
from sim_link.lab.mission.flight_readers import TelemetryReader
from sim_link.lab.mission.results import FlightRecord


class Heard:
    """A reader that hears system 9."""

    def __init__(self) -> None:
        self.record = FlightRecord()
        self.situation = self.record.situation
        self.reader = TelemetryReader(self.record)
        self._codec = MavCodec(9, 1)
        self.beat(FlightMode.HOLD, is_armed=False)

    def say(self, message: Message, now_s: float = 0.0, codec: MavCodec | None = None) -> None:
        self.reader.take((codec or self._codec).encode(message), now_s)

    def beat(self, mode: FlightMode, *, is_armed: bool) -> None:
        base = 1 | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if is_armed else 0)
        self.say(mavlink.MAVLink_heartbeat_message(2, 12, base, px4_custom_mode(mode), 4, 3))

    def move(self, east: float, north: float, up: float, now_s: float = 0.0) -> None:
        stamp_ms = round(1e3 * now_s)
        self.say(
            mavlink.MAVLink_local_position_ned_message(stamp_ms, north, east, -up, 3.0, 4.0, -1.0),
            now_s,
        )


@pytest.fixture
def heard() -> Heard:
    return Heard()


def test_mode_arming_and_whose_it_is(heard: Heard) -> None:
    vehicle = heard.situation.vehicle
    assert (vehicle.mode, vehicle.is_armed) == ("hold", False)
    heard.beat(FlightMode.OFFBOARD, is_armed=True)
    assert (vehicle.mode, vehicle.is_armed) == ("offboard", True)
    assert heard.reader.heartbeat is not None
    assert heard.reader.heartbeat.autopilot is Autopilot.PX4
    assert heard.reader.system_id == 9


def test_the_throttle_stick_is_channel_3_of_a_transmitter_that_is_heard(heard: Heard) -> None:
    channels = [1500, 1500, 1000, *[1500] * 15, 255]
    heard.say(mavlink.MAVLink_rc_channels_message(0, 0, *channels))
    assert heard.reader.throttle_us == 0
    heard.say(mavlink.MAVLink_rc_channels_message(0, 16, *channels))
    assert heard.reader.throttle_us == 1000


def test_heights_and_distances_count_from_home(heard: Heard) -> None:
    vehicle = heard.situation.vehicle
    heard.move(13.0, 14.0, 20.0)
    assert (vehicle.east_m, vehicle.height_m) == (13.0, None)
    home = mavlink.MAVLink_home_position_message(0, 0, 0, 10.0, 10.0, -1.0, [1, 0, 0, 0], 0, 0, 0)
    heard.say(home)
    heard.move(13.0, 14.0, 20.0, 0.1)
    assert vehicle.height_m == pytest.approx(19.0)
    assert vehicle.home_distance_m == pytest.approx(5.0)
    assert vehicle.speed_mps == pytest.approx(5.0)
    assert vehicle.climb_mps == pytest.approx(1.0)


def test_the_way_is_counted_while_armed_and_noise_is_not(heard: Heard) -> None:
    heard.move(100.0, 0.0, 0.0)
    heard.move(0.0, 0.0, 0.0, 0.1)
    heard.beat(FlightMode.OFFBOARD, is_armed=True)
    for step in range(101):
        heard.move(step / 10.0, 0.05 * (-1) ** step, 5.0, 0.2 + step / 50)
    assert heard.record.distance_m == pytest.approx(15.0, abs=1.0)
    assert heard.situation.vehicle.distance_m == heard.record.distance_m
    assert 8 <= len(heard.record.track) <= 14


def test_positions_that_are_no_numbers_are_not_believed(heard: Heard) -> None:
    heard.move(1.0, 2.0, 3.0)
    heard.move(math.nan, 2.0, 3.0, 0.1)
    assert heard.situation.vehicle.east_m == 1.0


def test_battery_fix_and_landing(heard: Heard) -> None:
    vehicle = heard.situation.vehicle
    status = [0, 0, 0, 0, 12000, 100, 73, 0, 0, 0, 0, 0, 0]
    heard.say(mavlink.MAVLink_sys_status_message(*status))
    assert vehicle.battery == pytest.approx(0.73)
    heard.say(mavlink.MAVLink_sys_status_message(*[*status[:6], -1, *status[7:]]))
    assert vehicle.battery is None
    heard.say(mavlink.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9))
    assert vehicle.has_fix
    heard.say(mavlink.MAVLink_extended_sys_state_message(0, 2))
    assert vehicle.landed == "in_air"


def test_texts_are_heard_from_the_autopilot_and_put_together(heard: Heard) -> None:
    heard.say(mavlink.MAVLink_statustext_message(6, b"Armed"))
    long = b"x" * 50
    heard.say(mavlink.MAVLink_statustext_message(6, long, 5, 0))
    heard.say(mavlink.MAVLink_statustext_message(6, b"end", 5, 1))
    heard.say(mavlink.MAVLink_statustext_message(6, b"mine"), codec=MavCodec(9, 191))
    assert heard.situation.autopilot_texts == ["Armed", "x" * 50 + "end"]


def test_messages_are_counted_by_sender_and_strangers_are_not(heard: Heard) -> None:
    number = mavlink.MAVLINK_MSG_ID_HEARTBEAT
    assert heard.record.messages["autopilot", number] == 1
    heard.say(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), codec=MavCodec(8, 1))
    assert heard.record.messages["autopilot", number] == 1
    frame = MavCodec(9, 191).encode(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    heard.reader.take_companion(frame)
    heard.reader.take_companion(b"nonsense")
    assert heard.record.messages["companion", number] == 1
