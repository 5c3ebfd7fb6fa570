from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from companion.link.ranging_sources import UINT32_MAX, ranging_from_message
from companion.mav.codec import MavCodec
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
    Message,
    estimate_in,
    mavlink,
    message_from_ranging,
    tunnelled,
)


def over_the_wire(message: Message) -> Message:
    (received,) = MavCodec(9, 9).decode(MavCodec(1, 191).encode(message))
    return received


def _maybe(strategy: st.SearchStrategy[float]) -> st.SearchStrategy[float | None]:
    return st.one_of(st.none(), strategy)


_metres = st.floats(0.0, 5000.0, width=32)
_sigmas = st.floats(0.0009765625, 100.0, width=32)
_angles = st.floats(-3.140625, 3.140625, width=32)


@st.composite
def measurements(draw: st.DrawFn) -> RangingMeasurement:
    is_body = draw(st.booleans())
    bearing = draw(_maybe(_angles))
    return RangingMeasurement(
        emitter_id=draw(st.integers(0, 65535)),
        measured_at_s=draw(st.floats(0.0, 1e6)),
        range_m=draw(_maybe(_metres)),
        range_sigma_m=draw(_maybe(_sigmas)),
        bearing_enu_rad=None if is_body else bearing,
        bearing_body_rad=bearing if is_body else None,
        bearing_sigma_rad=draw(_maybe(_sigmas)),
        elevation_rad=draw(_maybe(_angles)),
        elevation_sigma_rad=draw(_maybe(_sigmas)),
        power_dbm=draw(_maybe(st.floats(-174.0, -0.5, width=32))),
        is_array_angle=is_body and draw(st.booleans()),
        quality=draw(_maybe(st.integers(0, 100).map(lambda percent: percent / 100.0))),
        line_of_sight=draw(st.sampled_from([None, True, False])),
        stamp_us=draw(st.integers(0, 2**64 - 1)),
    )


@given(measurements())
def test_a_measurement_survives_the_wire(sent: RangingMeasurement) -> None:
    assert sent.stamp_us is not None
    message = over_the_wire(message_from_ranging(sent, sent.stamp_us))
    received = ranging_from_message(message, sent.measured_at_s)
    assert received is not None
    for name in RangingMeasurement.__slots__:
        before, after = getattr(sent, name), getattr(received, name)
        if name == "bearing_enu_rad" and before is not None:
            assert abs(wrap_pi(after - before)) < 1e-6
        else:
            assert after == before, name


@pytest.mark.parametrize("sent_dbm", [0.0, -0.0])
def test_a_measured_milliwatt_is_no_missing_extension(sent_dbm: float) -> None:
    sent = RangingMeasurement(emitter_id=1, measured_at_s=0.0, power_dbm=sent_dbm)
    received = ranging_from_message(over_the_wire(message_from_ranging(sent, 0)), 0.0)
    assert received is not None
    assert received.power_dbm == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("power", [None, 0.0, math.nan])
def test_a_sender_without_power_measured_none(power: float | None) -> None:
    old = (1, 42.5, 1.5, math.nan, math.nan, math.nan, math.nan, 7, 255, 0)
    message = MAVLink_radio_ranging_message(*old, *(() if power is None else (power,)))
    frame = MavCodec(1, 158).encode(message)
    assert power is math.nan or len(frame) <= 12 + 36
    received = ranging_from_message(over_the_wire(message), 0.0)
    assert received is not None
    assert (received.range_m, received.power_dbm) == (42.5, None)


def test_a_bearing_is_clockwise_from_north_on_the_wire() -> None:
    east = RangingMeasurement(emitter_id=1, measured_at_s=0.0, bearing_enu_rad=0.0)
    assert message_from_ranging(east, 0).to_dict()["bearing"] == pytest.approx(math.pi / 2)


def test_the_angles_of_an_array_are_flagged() -> None:
    seen = RangingMeasurement(1, 0.0, bearing_body_rad=0.3, elevation_rad=0.1, is_array_angle=True)
    assert message_from_ranging(seen, 0).to_dict()["flags"] == 1 + 8


@pytest.mark.parametrize("flags", [8, 8 + 1])
def test_the_angle_of_an_array_is_never_one_by_north(flags: int) -> None:
    seen = ranging_from_message(radio_ranging(bearing=0.3, flags=flags), 0.0)
    assert seen is not None
    assert seen.bearing_enu_rad is None
    assert seen.bearing_body_rad == pytest.approx(0.3)
    assert seen.is_array_angle


def test_what_was_not_measured_is_nan_on_the_wire() -> None:
    fields = message_from_ranging(RangingMeasurement(emitter_id=1, measured_at_s=0.0), 0).to_dict()
    assert all(math.isnan(float(fields[name])) for name in ("range", "bearing", "elevation_std"))
    assert fields["quality"] == 255
    assert fields["flags"] == 0


def radio_ranging(**changes: float) -> Message:
    values: dict[str, float] = {
        "time_usec": 1,
        "range": 80.0,
        "range_std": 3.0,
        "bearing": 0.0,
        "bearing_std": 0.1,
        "elevation": 0.0,
        "elevation_std": 0.1,
        "emitter_id": 7,
        "quality": 100,
        "flags": 0,
    }
    return over_the_wire(MAVLink_radio_ranging_message(**(values | changes)))  # type: ignore[arg-type]


def test_a_bearing_in_degrees_is_shown_as_sent() -> None:
    measurement = ranging_from_message(radio_ranging(bearing=270.0), 0.0)
    assert measurement is not None
    assert measurement.bearing_enu_rad == 270.0


def test_a_bearing_past_half_a_turn_is_shown_as_sent() -> None:
    half = ranging_from_message(radio_ranging(bearing=3.1415927410125732), 0.0)
    more = ranging_from_message(radio_ranging(bearing=3.15), 0.0)
    assert half is not None
    assert half.bearing_enu_rad == pytest.approx(-0.5 * math.pi)
    assert more is not None
    assert more.bearing_enu_rad == pytest.approx(3.15)


def test_an_infinite_bearing_reaches_the_screen() -> None:
    measurement = ranging_from_message(radio_ranging(bearing=math.inf), 0.0)
    assert measurement is not None
    assert measurement.bearing_enu_rad == math.inf


def test_flag_bits_that_mean_nothing_are_ignored() -> None:
    measurement = ranging_from_message(radio_ranging(flags=0xF0 | 2), 0.0)
    assert measurement is not None
    assert measurement.line_of_sight is True
    assert measurement.bearing_body_rad is None


def landing_target(kind: int, distance: float, angle_x: float = 0.25) -> Message:
    return over_the_wire(
        mavlink.MAVLink_landing_target_message(
            1, 9, 12, angle_x, 0.0, distance, 0.0, 0.0, type=kind
        )
    )


def test_a_radio_beacon_landing_target_is_a_range_and_a_bearing_from_the_nose() -> None:
    message = landing_target(mavlink.LANDING_TARGET_TYPE_RADIO_BEACON, 80.5)
    assert ranging_from_message(message, 3.0) == RangingMeasurement(
        emitter_id=9, measured_at_s=3.0, range_m=80.5, bearing_body_rad=0.25, stamp_us=1
    )


def test_a_landing_target_at_no_distance_has_no_range() -> None:
    message = landing_target(mavlink.LANDING_TARGET_TYPE_RADIO_BEACON, 0.0)
    measurement = ranging_from_message(message, 3.0)
    assert measurement is not None
    assert measurement.range_m is None


@pytest.mark.parametrize("kind", [0, 2, 3])
def test_a_landing_target_of_another_kind_is_no_ranging(kind: int) -> None:
    assert ranging_from_message(landing_target(kind, 80.0), 0.0) is None


def ranging_beacon(range_mm: int, accuracy_mm: int) -> Message:
    fields = dict.fromkeys(mavlink.MAVLink_ranging_beacon_message.fieldnames, 0)
    fields |= {"beacon_id": 4, "range": range_mm, "range_accuracy": accuracy_mm}
    return over_the_wire(mavlink.MAVLink_ranging_beacon_message(**fields))


def test_a_ranging_beacon_is_in_millimetres() -> None:
    assert ranging_from_message(ranging_beacon(80_500, 3_000), 3.0) == RangingMeasurement(
        emitter_id=4, measured_at_s=3.0, range_m=80.5, range_sigma_m=3.0, stamp_us=0
    )


@pytest.mark.parametrize("accuracy_mm", [0, UINT32_MAX])
def test_a_ranging_beacon_of_unknown_accuracy_has_no_sigma(accuracy_mm: int) -> None:
    measurement = ranging_from_message(ranging_beacon(80_500, accuracy_mm), 0.0)
    assert measurement is not None
    assert measurement.range_sigma_m is None


def test_a_ranging_beacon_of_unknown_range_has_none() -> None:
    measurement = ranging_from_message(ranging_beacon(UINT32_MAX, 10), 0.0)
    assert measurement is not None
    assert measurement.range_m is None


def test_other_messages_are_no_ranging() -> None:
    assert ranging_from_message(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), 0.0) is None


def test_three_messages_are_read_as_ranging() -> None:
    messages = (
        radio_ranging(),
        landing_target(mavlink.LANDING_TARGET_TYPE_RADIO_BEACON, 1.0),
        ranging_beacon(1, 1),
    )
    assert all(ranging_from_message(message, 0.0) is not None for message in messages)


ESTIMATE = MAVLink_target_estimate_message(
    *(1000, 473977420, 85455940, -40.0, 30.0, 9.0, 0.5, 4.0, 6.5),
    *(math.nan, math.nan, 3.0, 1.5, 12.0, -0.125, 55, 7, 2),
    *(16.0, 6.0, math.nan),
)
CORE = struct.Struct(str(ESTIMATE.unpacker.format).removesuffix("fff"))
"""A TARGET_ESTIMATE as it was before its extensions."""


def test_an_estimate_goes_through_a_tunnel_unchanged() -> None:
    carried = over_the_wire(tunnelled(ESTIMATE))
    assert isinstance(carried, mavlink.MAVLink_tunnel_message)
    assert (carried.target_system, carried.target_component) == (0, 0)
    received = estimate_in(carried)
    assert received is not None
    codec = MavCodec(1, 191)
    assert codec.encode(received)[10:-2] == MavCodec(1, 191).encode(ESTIMATE)[10:-2]
    assert (received.absolute_r95, received.own_std) == (16.0, 6.0)
    direct = over_the_wire(ESTIMATE)
    assert estimate_in(direct) is direct


@pytest.mark.parametrize(("kind", "length"), [(45011, 66), (45010, 67), (0, 67)])
def test_another_tunnel_carries_no_estimate(kind: int, length: int) -> None:
    other = mavlink.MAVLink_tunnel_message(0, 0, kind, length, [0] * 128)
    assert estimate_in(over_the_wire(other)) is None
    assert estimate_in(mavlink.MAVLink_ping_message(0, 0, 0, 0)) is None


def core_fields(estimate: MAVLink_target_estimate_message) -> bytes:
    return CORE.pack(*(getattr(estimate, name) for name in estimate.ordered_fieldnames[:-3]))


def test_a_receiver_without_extensions_reads_the_rest_of_a_tunnel() -> None:
    carried = over_the_wire(tunnelled(ESTIMATE))
    assert isinstance(carried, mavlink.MAVLink_tunnel_message)
    assert carried.payload_length == CORE.size == 67
    assert bytes(carried.payload[: CORE.size]) == core_fields(ESTIMATE)


@pytest.mark.parametrize("length", [67, 79, 128])
def test_a_tunnel_is_read_at_any_length_and_without_extensions_they_are_unknown(
    length: int,
) -> None:
    data = list(core_fields(ESTIMATE).ljust(128, b"\0"))
    received = estimate_in(over_the_wire(mavlink.MAVLink_tunnel_message(0, 0, 45011, length, data)))
    assert received is not None
    assert (received.r95, received.state) == (6.5, 2)
    assert (received.absolute_r95, received.own_std, received.own_height_std) == (0.0, 0.0, 0.0)


def test_an_estimate_without_extensions_is_read_and_they_are_unknown() -> None:
    """Zeros at the end are not sent: it is, to the byte, the frame of a sender from before them."""
    core = [getattr(ESTIMATE, name) for name in ESTIMATE.fieldnames[:-3]]
    older = MAVLink_target_estimate_message(*[*core, 0.0, 0.0, 0.0])
    frame = MavCodec(1, 191).encode(older)
    assert frame[10:-2] == core_fields(ESTIMATE)
    (received,) = MavCodec(9, 9).decode(frame)
    assert isinstance(received, MAVLink_target_estimate_message)
    assert (received.r95, received.state, received.absolute_r95) == (6.5, 2, 0.0)
