from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.protocols.addressing import Channel
from sim_link.autopilot.protocols.link_layer import MAX_STREAMS, FrameReceivers, WireVersion


def frame(mark: int, *, is_mavlink1: bool = False) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(6, 8, 0, mark, 4, 3)
    return MavCodec(255, 190).encode(message, is_mavlink1=is_mavlink1)


def piece(data: bytes, port: int) -> Chunk:
    return Chunk(1, data, ("127.0.0.1", port), is_datagram=False)


def test_clients_of_one_port_do_not_tear_each_others_frames() -> None:
    receivers = FrameReceivers()
    got = []
    for index in range(len(frame(1))):
        for port, mark in ((40_001, 1), (40_002, 2)):
            got += receivers.split(piece(frame(mark)[index : index + 1], port))[0]
    assert got == [frame(1), frame(2)]


def test_an_unfinished_frame_ends_with_its_channel() -> None:
    receivers = FrameReceivers()
    receivers.split(piece(frame(1)[:10], 40_001))
    receivers.forget(Channel(1, ("127.0.0.1", 40_001)))
    assert receivers.split(piece(frame(1)[10:], 40_001)) == ([], [])


def test_a_datagram_is_complete_in_itself() -> None:
    receivers = FrameReceivers()
    assert receivers.split(Chunk(0, frame(1)[:10], ("127.0.0.1", 1))) == ([], [])
    assert receivers.split(Chunk(0, frame(1)[10:], ("127.0.0.1", 1))) == ([], [])
    assert receivers.split(Chunk(0, frame(1), ("127.0.0.1", 1))) == ([frame(1)], [])


def test_unknown_messages_are_handed_over_for_forwarding() -> None:
    strange = bytearray(frame(1))
    strange[7:10] = (54321).to_bytes(3, "little")
    assert FrameReceivers().split(Chunk(0, bytes(strange))) == ([], [bytes(strange)])


def test_clients_that_come_and_go_do_not_fill_the_memory() -> None:
    receivers = FrameReceivers()
    for port in range(10_000, 10_500):
        receivers.split(piece(b"\xfd", port))
    assert len(receivers._streams) == MAX_STREAMS


# Versions


@pytest.mark.parametrize(
    ("heard", "is_mavlink1"),
    [([], False), ([1], True), ([1, 1, 1], True), ([1, 2], False), ([2, 1], False)],
)
def test_mavlink_1_is_spoken_to_who_never_spoke_2(heard: list[int], is_mavlink1: bool) -> None:
    version = WireVersion()
    for number in heard:
        version.observe(frame(1, is_mavlink1=number == 1))
    assert version.is_mavlink1 is is_mavlink1


def test_where_signing_is_on_there_is_only_mavlink_2() -> None:
    version = WireVersion(is_signed=True)
    version.observe(frame(1, is_mavlink1=True))
    assert not version.is_mavlink1


def test_what_has_no_mavlink_1_form_is_left_out() -> None:
    version = WireVersion()
    ranging = MAVLink_radio_ranging_message(9, 80.0, 3.0, 0.0, 0.1, 0.0, 0.1, 7, 100, 5)
    assert version.can_carry(ranging)
    version.observe(frame(1, is_mavlink1=True))
    assert not version.can_carry(ranging)
    assert version.can_carry(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
