"""Bytes in, messages and bytes out, on several links of one vehicle."""

from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
    Message,
    mavlink,
)
from companion.mav.endpoint import Chunk
from companion.mav.signing import LinkSigning, Signing, SigningKey, is_signed
from sim_link.autopilot.ardupilot import firmware_profile as ardupilot_firmware
from sim_link.autopilot.flavour import Firmware
from sim_link.autopilot.protocols.addressing import Channel, Outgoing
from sim_link.autopilot.protocols.link_layer import LinkLayer, LinkSecurity
from sim_link.autopilot.px4 import firmware_profile as px4_firmware

UDP, TCP, WIRE = 0, 1, 2
STATION = ("127.0.0.1", 14550)
SECRET = bytes(range(1, 33))
KEY, OTHER_KEY = SigningKey(SECRET), SigningKey(bytes(range(2, 34)))
NOW = 37_000_000_000_000


def layer(signing: Signing | None = None) -> LinkLayer:
    """A vehicle (components 1 and 154) on UDP, TCP and a trusted wire."""
    return LinkLayer(1, (1, 154), 3, LinkSecurity(signing, frozenset({WIRE})))


def heartbeat(mark: int = 0) -> Message:
    return mavlink.MAVLink_heartbeat_message(6, 8, 0, mark, 4, 3)


def ping() -> Message:
    return mavlink.MAVLink_ping_message(1, 2, 0, 0)


def station(key: SigningKey | None = None, *, link_id: int = 9) -> MavCodec:
    signing = None if key is None else LinkSigning(Signing(key, NOW), link_id)
    return MavCodec(255, 190, signing)


def heard(vehicle: LinkLayer, frame: bytes, link: int = UDP) -> list[str]:
    """The types of the messages that reach the vehicle."""
    arrivals, _ = vehicle.receive(Chunk(link, frame, STATION if link == UDP else None))
    return [message.get_type() for message, _ in arrivals]


def setup(secret: bytes = SECRET, target: tuple[int, int] = (1, 1)) -> Message:
    return mavlink.MAVLink_setup_signing_message(*target, list(secret), NOW)


# Without a key


def test_a_message_arrives_with_its_channel_and_is_passed_on() -> None:
    frame = station().encode(heartbeat())
    ((_, channel),), forwarded = layer().receive(Chunk(UDP, frame, STATION))
    assert channel == Channel(UDP, STATION)
    assert {(chunk.link, chunk.except_peers) for chunk in forwarded} == {
        (UDP, frozenset({STATION})),
        (TCP, frozenset()),
        (WIRE, frozenset()),
    }


def test_unknown_messages_are_passed_on_and_not_decoded() -> None:
    frame = bytearray(station().encode(heartbeat()))
    frame[7:10] = (54321).to_bytes(3, "little")
    arrivals, forwarded = layer().receive(Chunk(UDP, bytes(frame), STATION))
    assert (arrivals, len(forwarded)) == ([], 3)


def test_system_zero_is_heard_and_not_passed_on() -> None:
    data = MavCodec(0, 1).encode(heartbeat())
    arrivals, forwarded = layer().receive(Chunk(UDP, data, STATION))
    assert (len(arrivals), forwarded) == (1, [])


@pytest.mark.parametrize(
    ("message", "is_known"),
    [
        (heartbeat(), True),
        (mavlink.MAVLink_named_value_float_message(1, b"r95", 1.5), True),
        (MAVLink_target_estimate_message(*[0] * 21), False),
        (MAVLink_radio_ranging_message(*[0] * 10), False),
    ],
)
@pytest.mark.parametrize("firmware", [px4_firmware.FIRMWARE, ardupilot_firmware.FIRMWARE])
def test_an_autopilot_passes_on_what_is_in_its_dialect(
    firmware: Firmware, message: Message, is_known: bool
) -> None:
    vehicle = LinkLayer(1, (1,), 2, dialect=firmware.dialect)
    _, forwarded = vehicle.receive(Chunk(TCP, MavCodec(1, 191).encode(message), None))
    assert [chunk.link for chunk in forwarded] == [UDP] * is_known


def test_a_frame_of_arducopters_own_dialect_is_passed_on() -> None:
    wind = bytes.fromhex("fd0c00000001bfa80000") + bytes(14)
    vehicle = LinkLayer(1, (1,), 2, dialect=ardupilot_firmware.FIRMWARE.dialect)
    assert len(vehicle.receive(Chunk(TCP, wind, None))[1]) == 1


def test_each_link_and_component_has_its_own_sequence_numbers() -> None:
    vehicle = layer()
    for _ in range(3):
        vehicle.send(Outgoing(heartbeat(), Channel(UDP, STATION)))
    vehicle.send(Outgoing(heartbeat()), component_id=154)
    chunks = vehicle.send(Outgoing(heartbeat()))
    assert [(chunk.link, chunk.data[4], chunk.data[6]) for chunk in chunks] == [
        (UDP, 3, 1),
        (TCP, 0, 1),
        (WIRE, 0, 1),
    ]


def test_an_answer_goes_to_all_on_its_link_so_that_none_misses_a_number() -> None:
    (chunk,) = layer().send(Outgoing(ping(), Channel(UDP, STATION)))
    assert (chunk.link, chunk.peer) == (UDP, None)


def test_a_link_where_only_mavlink_1_is_spoken_is_answered_in_it() -> None:
    vehicle = layer()
    heard(vehicle, station().encode(heartbeat(), is_mavlink1=True), TCP)
    frames = {chunk.link: chunk.data[0] for chunk in vehicle.send(Outgoing(heartbeat()))}
    assert frames == {UDP: 0xFD, TCP: 0xFE, WIRE: 0xFD}
    ranging = MAVLink_radio_ranging_message(9, 80.0, 3.0, 0.0, 0.1, 0.0, 0.1, 7, 100, 5)
    assert [chunk.link for chunk in vehicle.send(Outgoing(ranging))] == [UDP, WIRE]
    heard(vehicle, station().encode(heartbeat()), TCP)
    assert {chunk.data[0] for chunk in vehicle.send(Outgoing(heartbeat()))} == {0xFD}


# With a key


def test_only_signed_frames_are_heard_but_all_are_passed_on() -> None:
    vehicle = layer(Signing(KEY, NOW))
    assert heard(vehicle, station(KEY).encode(ping())) == ["PING"]
    assert heard(vehicle, station(OTHER_KEY).encode(ping())) == []
    assert heard(vehicle, station().encode(ping())) == []
    forged = station(OTHER_KEY).encode(ping())
    _, forwarded = vehicle.receive(Chunk(UDP, forged, STATION))
    assert {chunk.data for chunk in forwarded} == {forged}


def test_a_frame_is_not_heard_twice_on_whichever_link_it_is_repeated() -> None:
    vehicle = layer(Signing(KEY, NOW))
    frame = station(KEY).encode(ping())
    assert heard(vehicle, frame) == ["PING"]
    assert [heard(vehicle, frame, link) for link in (UDP, TCP, WIRE)] == [[], [], []]


def test_a_trusted_wire_needs_no_signature() -> None:
    assert heard(layer(Signing(KEY, NOW)), station().encode(ping()), WIRE) == ["PING"]


def test_everything_sent_is_signed_with_the_links_id_and_rising_timestamps() -> None:
    vehicle = layer(Signing(KEY, NOW))
    frames = [chunk.data for _ in range(3) for chunk in vehicle.send(Outgoing(heartbeat()))]
    assert [frame[-13] for frame in frames] == [UDP, TCP, WIRE] * 3
    stamps = [int.from_bytes(frame[-12:-6], "little") for frame in frames]
    assert stamps == sorted(set(stamps))
    receiver = station(KEY)
    assert all(receiver.decode(frame) for frame in frames)


def test_mavlink_1_cannot_pull_a_signed_link_down() -> None:
    vehicle = layer(Signing(KEY, NOW))
    for link in (UDP, WIRE):
        heard(vehicle, station().encode(heartbeat(), is_mavlink1=True), link)
    assert all(is_signed(chunk.data) for chunk in vehicle.send(Outgoing(heartbeat())))


# Setting a key up


def test_a_key_comes_over_the_wire_and_is_in_force_at_once() -> None:
    vehicle = layer()
    assert heard(vehicle, station().encode(setup()), WIRE) == []
    assert all(is_signed(chunk.data) for chunk in vehicle.send(Outgoing(heartbeat())))
    assert heard(vehicle, station().encode(ping())) == []
    taken = vehicle.take_setup()
    assert taken is not None
    assert (taken.key, vehicle.take_setup()) == (KEY, None)


def test_a_key_is_never_passed_on() -> None:
    for link in (UDP, WIRE):
        for target in ((1, 1), (0, 0), (255, 190)):
            vehicle = layer()
            vehicle.receive(Chunk(TCP, station().encode(heartbeat())))
            _, forwarded = vehicle.receive(Chunk(link, station().encode(setup(target=target))))
            assert forwarded == []


def test_a_key_over_an_open_link_or_for_everyone_is_ignored() -> None:
    for link, target in ((UDP, (1, 1)), (TCP, (1, 1)), (WIRE, (0, 0)), (WIRE, (1, 0))):
        vehicle = layer()
        heard(vehicle, station().encode(setup(target=target)), link)
        assert vehicle.signing is None


def test_zeros_end_signing() -> None:
    vehicle = layer(Signing(KEY, NOW))
    heard(vehicle, station().encode(setup(bytes(32))), WIRE)
    assert not any(is_signed(chunk.data) for chunk in vehicle.send(Outgoing(heartbeat())))


def test_a_new_key_does_not_turn_the_clock_back() -> None:
    vehicle = layer(Signing(OTHER_KEY, NOW + 10**9))
    heard(vehicle, station().encode(setup()), WIRE)
    assert vehicle.signing is not None
    assert vehicle.signing.timestamp >= NOW + 10**9


def test_a_channel_that_is_gone_is_forgotten() -> None:
    vehicle = layer()
    heard(vehicle, station().encode(heartbeat()))
    vehicle.forget(Channel(UDP, STATION))
    ack = mavlink.MAVLink_command_ack_message(92, 0, 0, 0, 255, 190)
    assert vehicle.receive(Chunk(TCP, MavCodec(1, 191).encode(ack)))[1] == []
