from __future__ import annotations

import math

import pytest

from companion.errors import LocalProtocolError
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink


def heartbeat(mark: int = 0) -> Message:
    return mavlink.MAVLink_heartbeat_message(18, 8, 0, mark, 4, 3)


def test_the_sequence_number_counts_every_frame_and_wraps_at_256() -> None:
    codec = MavCodec(1, 191)
    assert [codec.encode(heartbeat())[4] for _ in range(600)] == [n % 256 for n in range(600)]


def test_each_codec_counts_for_itself() -> None:
    first, second = MavCodec(1, 191), MavCodec(1, 191)
    first.encode(heartbeat())
    assert second.encode(heartbeat())[4] == 0


def test_frames_are_mavlink_2_and_carry_our_identity() -> None:
    frame = MavCodec(7, 191).encode(heartbeat())
    assert (frame[0], frame[5], frame[6]) == (0xFD, 7, 191)


def test_every_frame_has_the_next_number_of_the_link() -> None:
    codec = MavCodec(1, 191)
    assert [codec.encode(heartbeat())[4] for _ in range(3)] == [0, 1, 2]


def test_an_adopted_system_id_is_sent_from_then_on() -> None:
    codec = MavCodec(1, 191)
    codec.system_id = 42
    assert codec.encode(heartbeat())[5] == 42
    assert codec.system_id == 42


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_heartbeat_message(18, 8, 0, -1, 4, 3),
        mavlink.MAVLink_heartbeat_message(300, 8, 0, 0, 4, 3),
        mavlink.MAVLink_heartbeat_message(18, 8, 0, "high", 4, 3),  # type: ignore[arg-type]
        mavlink.MAVLink_heartbeat_message(18, 8, 0, None, 4, 3),  # type: ignore[arg-type]
        mavlink.MAVLink_local_position_ned_message(2**32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_local_position_ned_message(0, 1e39, 0.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
def test_a_value_that_does_not_fit_is_our_mistake_and_costs_no_number(message: Message) -> None:
    codec = MavCodec(1, 191)
    with pytest.raises(LocalProtocolError, match=message.get_type()):
        codec.encode(message)
    assert codec.encode(heartbeat())[4:7] == bytes((0, 1, 191))


def test_what_one_codec_packs_another_reads_with_its_sender() -> None:
    sent = mavlink.MAVLink_local_position_ned_message(5, 1.5, -2.5, 0.0, 0.25, 0.0, 0.0)
    (message,) = MavCodec(9, 9).decode(MavCodec(1, 191).encode(sent))
    assert message.to_dict() == sent.to_dict()
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


def test_nan_survives_the_wire() -> None:
    sent = mavlink.MAVLink_local_position_ned_message(5, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    (message,) = MavCodec(9, 9).decode(MavCodec(1, 191).encode(sent))
    assert math.isnan(float(message.to_dict()["x"]))


def test_text_that_is_no_ascii_is_counted_or_read_but_never_raised() -> None:
    packed = bytearray(MavCodec(1, 1).encode(mavlink.MAVLink_statustext_message(6, b"\xff\xfe ok")))
    codec = MavCodec(9, 9)
    messages = codec.decode(bytes(packed))
    assert len(messages) + codec.undecodable == 1
    assert len(codec.decode(MavCodec(1, 1).encode(heartbeat()))) == 1


def test_counters_tell_what_arrived() -> None:
    codec = MavCodec(9, 9)
    codec.decode(b"junk" + MavCodec(1, 1).encode(heartbeat()))
    assert codec.counters.good == 1
    assert codec.counters.junk_bytes == 4
