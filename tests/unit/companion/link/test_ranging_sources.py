"""MAVLink as a source of ranging, and another radio that is one class and one row of a table."""

from __future__ import annotations

import math

import pytest

from companion.config.radios import RadioConfig
from companion.config.schema import CompanionConfig
from companion.domain import RangingMeasurement
from companion.errors import ConfigError
from companion.flight_setup import FlightFacts, build_endpoint, facts_as_json, facts_of_json
from companion.io.links.transports import check_exposure, radio_link
from companion.link.conversion.clock_sync import ClockSync
from companion.link.conversion.sender_clock import VehicleClock
from companion.link.interface import VEHICLE_ONLY, LinkRole, LinkSpec, RadioSettings, RadioSetup
from companion.link.ranging_sources import MavlinkRanging
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message
from companion.mav.endpoint import Chunk
from companion.radios.decoder import LineDecoder, RadioKind, RadioReading
from tests.unit.companion.link.wire import HOLD, Wire, heartbeat, link_specs, local_position, origin

NAN = math.nan


class Radio:
    """A MAVLink radio on a link."""

    def __init__(self, vehicle_offset_s: float | None = None) -> None:
        clock = VehicleClock(ClockSync())
        if vehicle_offset_s is not None:
            clock.read(-vehicle_offset_s, 0.0)
        self.source = MavlinkRanging(MavCodec(1, 191), clock)

    def says(self, time_usec: int, now_s: float, flags: int = 0) -> RangingMeasurement:
        message = MAVLink_radio_ranging_message(
            time_usec, 80.0, 1.0, 0.5, 0.1, NAN, NAN, 7, 255, flags
        )
        (measurement,) = self.source.receive(MavCodec(1, 158).encode(message), now_s)
        return measurement


def test_a_body_frame_bearing_stays_one_until_the_yaw_is_known() -> None:
    measurement = Radio().says(1_000_000, 5.0, flags=1)
    assert measurement.bearing_enu_rad is None
    assert measurement.bearing_body_rad == 0.5
    assert measurement.measured_at_s == 5.0


@pytest.mark.parametrize("stamp_us", [2_000_000, 1_795_000_000_000_000])
def test_every_sender_has_its_own_clock(stamp_us: int) -> None:
    radio = Radio()
    radio.says(stamp_us, 5.0)
    assert radio.says(stamp_us + 100_000, 5.3).measured_at_s == pytest.approx(5.1, abs=1e-3)


def test_a_sender_without_a_clock_is_dated_by_arrival_and_never_a_duplicate() -> None:
    radio = Radio()
    for now_s in (5.0, 9.0):
        measurement = radio.says(0, now_s)
        assert measurement.measured_at_s == now_s
        assert measurement.stamp_us is None


def test_a_radio_that_restarted_in_silence_is_heard_again() -> None:
    radio = Radio()
    radio.says(14_000_000, 14.0)
    for tick in range(20):
        now_s = 50.0 + 0.1 * tick
        measurement = radio.says(20_000_000 + 100_000 * tick, now_s)
    assert measurement.measured_at_s == pytest.approx(now_s, abs=1e-3)


@pytest.mark.parametrize(
    ("clock_lag_s", "measured_at_s"),
    [
        (0.3, 9.7),  # a link that takes 0.3 s, on the autopilot's clock: read on that
        (0.0, 10.0),
        (-5.0, 10.0),  # a clock of its own: the shortest delay is all that is known
        (700.0, 10.0),
    ],
)
def test_a_stamp_that_agrees_with_the_autopilots_clock_is_read_on_it(
    clock_lag_s: float, measured_at_s: float
) -> None:
    stamp_us = round(1e6 * (10.0 + 1000.0 - clock_lag_s))
    measurement = Radio(vehicle_offset_s=-1000.0).says(stamp_us, 10.0)
    assert measurement.measured_at_s == pytest.approx(measured_at_s, abs=1e-6)


# Another radio


class TextLines(LineDecoder):
    """An invented serial radio: `RANGE 7 81.25`, one line per answer, metres, no clock."""

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        del received_s
        match line.split():
            case ["RANGE", emitter, metres]:
                return [RadioReading(emitter, range_m=float(metres))]
        return []


KIND = RadioKind("text", TextLines, "an invented one", "range", "its tag", "serial:115200")
TEXT_RADIO = LinkSpec(LinkRole.RANGING, RadioSetup(KIND, RadioSettings()))


@pytest.mark.slow
def test_another_radio_localises_the_emitter_through_the_endpoint() -> None:
    """Rings around an emitter at 40 m east, 30 m north, in halves of lines over a serial port."""
    wire = Wire().ready()
    wire.endpoint = build_endpoint(CompanionConfig(), wire.journal, (*VEHICLE_ONLY, TEXT_RADIO))
    wire.say(origin())
    for step in range(240):
        wire.wait(0.25)
        east_m, north_m = 0.25 * step, 20.0 * math.sin(0.1 * step)
        boot_ms = round(1e3 * wire.now_s)
        wire.say(local_position(boot_ms, north_m, east_m, -20.0, 0.0, 0.0, 0.0))
        if step % 4 == 0:
            wire.say(heartbeat(custom_mode=HOLD, is_armed=True, status=4))
        range_m = math.dist((east_m, north_m, 20.0), (40.0, 30.0, 0.0))
        line = f"noise\nRANGE 7 {range_m:.2f}\n".encode()
        for piece in (line[:9], line[9:]):
            chunk = Chunk(1, piece, is_datagram=False)
            wire.endpoint.receive(chunk, wire.now_s)
    (emitter,) = wire.endpoint.session.emitters(wire.now_s)
    assert emitter.estimate is not None
    assert math.dist(emitter.estimate.position_enu_m, (40.0, 30.0)) < 3.0


def test_a_radio_that_cannot_sign_is_not_heard_from_the_network() -> None:
    assert TEXT_RADIO.radio is not None
    exposed = radio_link(TEXT_RADIO.radio, "udp:0.0.0.0:9000")
    with pytest.raises(ConfigError, match="anyone in the network"):
        check_exposure([exposed], has_key=True)
    check_exposure([radio_link(TEXT_RADIO.radio, "udp:127.0.0.1:9000")], has_key=False)


def test_the_recorded_flight_knows_what_its_links_spoke() -> None:
    config = CompanionConfig(radios=(RadioConfig(name="ndjson", settings={"lag_s": 0.1}),))
    facts = FlightFacts(started_unix_s=0.0, config=config, links=4, gcs_links=1)
    read = facts_of_json(facts_as_json(facts))
    roles = [link.role for link in read.link_specs()]
    ranging = LinkRole.RANGING
    assert roles == [LinkRole.VEHICLE, ranging, ranging, LinkRole.GCS]
    settings = [link.radio and link.radio.settings.lag_s for link in read.link_specs()]
    assert settings == [None, None, 0.1, None]


def test_the_links_of_older_records_are_counted() -> None:
    facts = FlightFacts(started_unix_s=0.0, config=CompanionConfig(), links=4, gcs_links=1)
    assert facts.link_specs() == link_specs(ranging=2, gcs=1)
