"""A radio that follows a vehicle of others by its telemetry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.errors import ConfigError
from companion.geometry.coordinates import LocalOrigin
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.scenario import PayloadParams
from sim_link.lab.radio_follower import FOLLOW, SEND, GeodeticEmitter, RadioFollower, parse_emitter
from sim_link.world.environment import ChannelParams, Emitter, EmitterParams
from sim_link.world.radio_channel import AntennaModelParams

CLEAR = ChannelParams(
    range_offset_m=0.0, bearing_offset_deg=0.0, p_nlos=0.0, range_sigma_m=0.0, bearing_sigma_deg=0.0
)
EVERYTHING = PayloadParams()
PEER = ("127.0.0.1", 14580)
ORIGIN = LocalOrigin(47.4, 8.5, 488.0)


class Ridden:
    """A radio on a vehicle whose position is given."""

    def __init__(
        self,
        emitters: list[Emitter | GeodeticEmitter] | None = None,
        payload: PayloadParams = EVERYTHING,
        *,
        has_own_link: bool = False,
    ) -> None:
        known = [Emitter(EmitterParams(emitter_id=7))] if emitters is None else emitters
        self.radio = RadioFollower(
            payload, CLEAR, known, np.random.default_rng(1), has_own_link=has_own_link
        )
        self._vehicle = MavCodec(42, 1)
        self._station = MavCodec(255, 190)
        self._reader = MavCodec(0, 0)
        self.send(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), 0.0)

    def send(self, message: Message, now_s: float, codec: MavCodec | None = None) -> None:
        data = (codec or self._vehicle).encode(message)
        self.radio.receive(Chunk(FOLLOW, data, PEER), now_s)

    def move(self, east: float, north: float, up: float, stamp_s: float) -> None:
        stamp_ms = round(1e3 * stamp_s)
        moved = mavlink.MAVLink_local_position_ned_message(stamp_ms, north, east, -up, 0, 0, 0)
        self.send(moved, stamp_s)

    def sent(self) -> list[Message]:
        chunks = self.radio.take_output()
        return [message for chunk in chunks for message in self._reader.decode(chunk.data)]

    def asked(self) -> list[mavlink.MAVLink_command_long_message]:
        return [m for m in self.sent() if isinstance(m, mavlink.MAVLink_command_long_message)]

    def ranges(self) -> list[MAVLink_radio_ranging_message]:
        return [m for m in self.sent() if isinstance(m, MAVLink_radio_ranging_message)]


def test_it_measures_from_the_vehicles_place_at_the_vehicles_time_under_its_id() -> None:
    ridden = Ridden()
    ridden.move(50.0, 20.0, 40.0, 12.5)
    (ranging,) = ridden.ranges()
    assert ranging.range == pytest.approx(50.0)
    assert ranging.time_usec == 12_500_000
    assert (ranging.get_srcSystem(), ranging.emitter_id) == (42, 7)
    assert ranging.bearing == pytest.approx(0.0, abs=1e-6)


def test_it_measures_at_its_rate_whatever_the_streams_is() -> None:
    ridden = Ridden(payload=PayloadParams(rate_hz=5.0))
    for step in range(150):
        ridden.move(0.0, 0.0, 20.0, 1.0 + step / 30.0)
    assert len(ridden.ranges()) == pytest.approx(25, abs=1)
    assert ridden.radio.measurements == pytest.approx(25, abs=1)


def test_it_hears_nothing_from_the_ground_or_too_far_away() -> None:
    ridden = Ridden(payload=PayloadParams(max_range_m=60.0))
    ridden.move(50.0, 50.0, 1.0, 1.0)
    ridden.move(200.0, 50.0, 20.0, 2.0)
    assert ridden.ranges() == []
    ridden.move(60.0, 50.0, 20.0, 3.0)
    assert len(ridden.ranges()) == 1


def test_the_ground_is_where_home_is() -> None:
    ridden = Ridden()
    home = mavlink.MAVLink_home_position_message(0, 0, 0, 0, 0, -100.0, [1, 0, 0, 0], 0, 0, 0)
    ridden.send(home, 0.5)
    ridden.move(50.0, 50.0, 101.0, 1.0)
    assert ridden.ranges() == []
    ridden.move(50.0, 50.0, 104.0, 2.0)
    assert len(ridden.ranges()) == 1


def test_a_restarted_autopilot_is_followed_on() -> None:
    ridden = Ridden()
    ridden.move(50.0, 20.0, 40.0, 500.0)
    ridden.move(50.0, 20.0, 40.0, 3.0)
    assert [round(r.time_usec / 1e6) for r in ridden.ranges()] == [500, 3]


def test_an_array_feels_the_attitude_that_is_reported() -> None:
    ridden = Ridden(payload=PayloadParams(antenna=AntennaModelParams(kind="planar")))
    ridden.radio.handle_timer(0.5)
    assert [m.param1 for m in ridden.asked()].count(mavlink.MAVLINK_MSG_ID_ATTITUDE) == 1
    ridden.send(mavlink.MAVLink_attitude_message(900, 0.0, 0.0, 0.4, 0, 0, 0), 0.9)
    ridden.move(50.0, 20.0, 40.0, 1.0)
    (ranging,) = ridden.ranges()
    assert ranging.bearing == pytest.approx(-0.4)
    assert ranging.flags == 1


def test_what_lags_comes_later_and_tells_of_then() -> None:
    ridden = Ridden(payload=PayloadParams(lag_s=0.25))
    ridden.move(50.0, 20.0, 40.0, 1.0)
    assert ridden.ranges() == []
    ridden.move(50.0, 50.0, 40.0, 1.3)
    (ranging,) = ridden.ranges()
    assert ranging.time_usec == 1_250_000
    assert ranging.range == pytest.approx(50.0)


def test_an_emitter_on_earth_waits_for_the_origin_and_asks_for_it() -> None:
    latitude_deg, longitude_deg, _ = ORIGIN.geodetic_from_enu((30.0, 40.0, 0.0))
    ridden = Ridden([GeodeticEmitter(1, latitude_deg, longitude_deg, None)])
    ridden.move(0.0, 0.0, 20.0, 1.0)
    assert ridden.ranges() == []
    ridden.radio.handle_timer(1.0)
    asked = [
        m.command for m in ridden.sent() if isinstance(m, mavlink.MAVLink_command_long_message)
    ]
    assert asked == [mavlink.MAV_CMD_REQUEST_MESSAGE]
    ridden.send(mavlink.MAVLink_gps_global_origin_message(474_000_000, 85_000_000, 488_000), 1.5)
    ridden.move(0.0, 0.0, 20.0, 2.0)
    (ranging,) = ridden.ranges()
    assert ranging.range == pytest.approx(math.hypot(50.0, 20.0), abs=0.1)


def test_an_altitude_above_the_sea_counts() -> None:
    position = ORIGIN.geodetic_from_enu((0.0, 0.0, -12.0))
    emitter = GeodeticEmitter(1, *position).local(ORIGIN)
    assert emitter.position_enu_m == pytest.approx((0.0, 0.0, -12.0), abs=1e-3)


def test_it_asks_for_the_position_until_it_comes() -> None:
    ridden = Ridden()
    for second in range(5):
        ridden.radio.handle_timer(float(second))
        if second == 3:
            ridden.move(0.0, 0.0, 20.0, 3.0)
    assert [m.command for m in ridden.asked()] == [mavlink.MAV_CMD_SET_MESSAGE_INTERVAL] * 2
    assert ridden.radio.next_timer_s() == 5.0


def test_only_the_first_autopilot_counts() -> None:
    ridden = Ridden()
    stranger = MavCodec(7, 1)
    moved = mavlink.MAVLink_local_position_ned_message(1000, 0, 0, -20, 0, 0, 0)
    ridden.send(moved, 1.0, stranger)
    ridden.send(moved, 1.0, MavCodec(42, 191))
    assert ridden.ranges() == []
    assert ridden.radio.is_following


def test_measurements_may_go_elsewhere_and_requests_never_do() -> None:
    ridden = Ridden(has_own_link=True)
    ridden.move(0.0, 0.0, 20.0, 1.0)
    ridden.radio.handle_timer(9.0)
    chunks = ridden.radio.take_output()
    assert [chunk.link for chunk in chunks] == [SEND, SEND, FOLLOW]
    assert chunks[-1].peer == PEER


def test_it_ends_when_asked() -> None:
    radio = Ridden().radio
    assert not radio.is_finished
    radio.request_stop(1.0)
    assert radio.is_finished


def test_emitters_on_the_command_line() -> None:
    assert parse_emitter("47.4,8.5", 2) == GeodeticEmitter(2, 47.4, 8.5, None)
    assert parse_emitter("47.4,8.5,490", 1) == GeodeticEmitter(1, 47.4, 8.5, 490.0)
    for text in ("47.4", "47.4,8.5,1,2", "north,east", "95,8", "47,nan", ""):
        with pytest.raises(ConfigError, match="give LAT,LON"):
            parse_emitter(text, 1)
