from __future__ import annotations

import math
from collections.abc import Mapping

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


def test_a_peer_of_the_first_version_gets_frames_of_the_first_version() -> None:
    codec = MavCodec(7, 191)
    assert codec.encode(heartbeat(), is_mavlink1=True)[0] == 0xFE
    text = mavlink.MAVLink_statustext_message(6, b"hello")
    assert codec.encode(text, is_mavlink1=True)[0] == 0xFE
    assert codec.encode(text)[0] == 0xFD


def test_the_last_message_id_of_the_first_version_is_255() -> None:
    last = heartbeat()
    last.get_header().msgId = 255
    assert MavCodec(1, 191).encode(last, is_mavlink1=True)[5] == 255


class Marking:
    """Signing that refuses everything, and marks what is sent."""

    def accepts(self, frame: bytes) -> bool:
        return not frame

    def sign(self, frame: bytes, crc_extra_by_id: Mapping[int, int]) -> bytes:
        assert 0 in crc_extra_by_id
        return frame + b"signed"


def test_what_the_first_version_cannot_carry_is_our_mistake_and_costs_no_number() -> None:
    farther = heartbeat()
    farther.get_header().msgId = 256
    signing = MavCodec(1, 191, Marking())
    for codec, message in ((MavCodec(1, 191), farther), (signing, heartbeat())):
        with pytest.raises(LocalProtocolError, match=f"^{message.get_type()} cannot be sent in"):
            codec.encode(message, is_mavlink1=True)
        assert codec.encode(heartbeat())[4] == 0


def test_an_unsigned_copy_goes_on_with_identity_and_sequence_number() -> None:
    codec = MavCodec(7, 191, Marking())
    for _ in range(3):
        assert codec.encode(heartbeat()).endswith(b"signed")
    copy = codec.unsigned_copy()
    assert copy.encode(heartbeat()) == codec.encode(heartbeat()).removesuffix(b"signed")


def test_every_frame_that_signing_refuses_is_counted() -> None:
    codec = MavCodec(1, 191, Marking())
    for count in (1, 2):
        assert codec.decode(MavCodec(1, 1).encode(heartbeat())) == []
        assert codec.unproved == count


def test_every_frame_that_cannot_be_decoded_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("as pymavlink does for some payloads")

    monkeypatch.setattr(mavlink.MAVLink, "decode", fail)
    codec, text = MavCodec(1, 191), mavlink.MAVLink_statustext_message(6, b"hello")
    for count in (1, 2):
        assert codec.decode(MavCodec(1, 1).encode(text)) == []
        assert codec.undecodable == count


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
