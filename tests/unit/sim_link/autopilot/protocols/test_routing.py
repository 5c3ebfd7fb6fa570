"""Destinations of forwarded messages (MAVLink developer guide, "Routing")."""

from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import LinkSigning, Signing, SigningKey
from sim_link.autopilot.protocols.addressing import Channel
from sim_link.autopilot.protocols.link_layer import MAX_COMPONENTS, Router

UDP, TCP, SERIAL = 0, 1, 2
COMPANION = Channel(UDP, ("127.0.0.1", 14540))
STATION = Channel(UDP, ("127.0.0.1", 14550))
TABLET = Channel(TCP, ("127.0.0.1", 40001))
RADIO = Channel(SERIAL)
IDS = {COMPANION: (1, 191), STATION: (255, 190), TABLET: (254, 190), RADIO: (51, 68)}


def frame_of(message: Message, channel: Channel) -> bytes:
    return MavCodec(*IDS[channel]).encode(message)


def heartbeat() -> Message:
    return mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def command(system_id: int, component_id: int) -> Message:
    return mavlink.MAVLink_command_long_message(
        system_id, component_id, 92, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )


class Net:
    """A vehicle (system 1, components 1 and 154) with four others on three links."""

    def __init__(self, *present: Channel) -> None:
        self.router = Router(1, (1, 154), links=3)
        for channel in present or tuple(IDS):
            self.router.route(frame_of(heartbeat(), channel), channel)

    def send(self, message: Message, channel: Channel) -> list[Chunk]:
        return self.router.route(frame_of(message, channel), channel)


def destinations(chunks: list[Chunk]) -> set[tuple[int, object, object]]:
    return {(chunk.link, chunk.peer, next(iter(chunk.except_peers), None)) for chunk in chunks}


def test_a_broadcast_goes_to_every_other_channel_and_not_back() -> None:
    assert destinations(Net().send(heartbeat(), COMPANION)) == {
        (UDP, None, COMPANION.peer),
        (TCP, None, None),
        (SERIAL, None, None),
    }


def test_what_comes_by_a_link_with_one_end_does_not_go_back_to_it() -> None:
    assert destinations(Net().send(heartbeat(), RADIO)) == {(UDP, None, None), (TCP, None, None)}


def test_an_addressed_frame_goes_only_where_its_target_was_heard() -> None:
    (chunk,) = Net().send(command(1, 191), TABLET)
    assert (chunk.link, chunk.peer) == (COMPANION.link, COMPANION.peer)


def test_the_answer_finds_its_way_back() -> None:
    ack = mavlink.MAVLink_command_ack_message(92, 0, 0, 0, 254, 190)
    (chunk,) = Net().send(ack, COMPANION)
    assert (chunk.link, chunk.peer) == (TABLET.link, TABLET.peer)


@pytest.mark.parametrize("component", [1, 154])
def test_what_is_for_the_vehicle_stays_with_it(component: int) -> None:
    assert Net().send(command(1, component), STATION) == []


def test_what_is_for_the_whole_system_also_goes_to_its_other_components() -> None:
    (chunk,) = Net().send(command(1, 0), STATION)
    assert chunk.peer == COMPANION.peer


def test_component_zero_is_every_component_of_a_system() -> None:
    (chunk,) = Net().send(command(255, 0), COMPANION)
    assert chunk.peer == STATION.peer


@pytest.mark.parametrize("target", [(77, 1), (1, 100), (255, 1)])
def test_who_was_never_heard_gets_nothing(target: tuple[int, int]) -> None:
    assert Net().send(command(*target), STATION) == []


def test_who_was_heard_on_two_channels_is_reached_on_both() -> None:
    net = Net()
    net.router.route(frame_of(heartbeat(), STATION), RADIO)
    chunks = net.send(command(255, 190), COMPANION)
    assert destinations(chunks) == {(UDP, STATION.peer, None), (SERIAL, None, None)}


def test_what_a_peer_sends_to_itself_never_comes_back() -> None:
    assert Net().send(command(255, 190), STATION) == []


# Unaltered, decoded or not


def test_the_bytes_are_passed_on_as_they_are() -> None:
    frame = frame_of(heartbeat(), COMPANION)
    assert {chunk.data for chunk in Net().router.route(frame, COMPANION)} == {frame}


def test_signed_frames_pass_with_their_signature() -> None:
    signing = LinkSigning(Signing(SigningKey(bytes(range(32)))), 0)
    frame = MavCodec(255, 190, signing).encode(command(1, 191))
    (chunk,) = Net().router.route(frame, STATION)
    assert chunk.data == frame


def test_an_unknown_message_is_passed_on_to_everyone() -> None:
    frame = bytearray(frame_of(command(1, 191), STATION))
    frame[7:10] = (54321).to_bytes(3, "little")
    assert len(Net().router.route(bytes(frame), STATION)) == 3


def test_mavlink_1_is_routed_too() -> None:
    frame = MavCodec(255, 190).encode(command(1, 191), is_mavlink1=True)
    (chunk,) = Net().router.route(frame, STATION)
    assert (chunk.peer, chunk.data) == (COMPANION.peer, frame)


def test_a_key_is_never_passed_on() -> None:
    for target in ((0, 0), (1, 191)):
        setup = mavlink.MAVLink_setup_signing_message(*target, [7] * 32, 0)
        assert Net().send(setup, STATION) == []


def test_system_zero_is_no_source() -> None:
    net = Net()
    assert net.router.route(MavCodec(0, 1).encode(heartbeat()), STATION) == []
    assert net.send(command(0, 1), COMPANION) != []


# Restarts and departures


def system_time(boot_ms: int) -> Message:
    return mavlink.MAVLink_system_time_message(0, boot_ms)


def test_a_restart_clears_the_routes_of_its_system() -> None:
    net = Net()
    net.router.route(frame_of(heartbeat(), STATION), RADIO)
    net.send(system_time(500_000), STATION)
    net.send(system_time(900), STATION)
    assert destinations(net.send(command(255, 190), COMPANION)) == {(UDP, STATION.peer, None)}
    assert len(net.send(command(254, 190), COMPANION)) == 1


@pytest.mark.parametrize(
    ("before_ms", "after_ms"),
    [(500_000, 500_000), (500_000, 501_000), (500_000, 499_500), (2**32 - 500, 300)],
)
def test_time_that_goes_on_or_wraps_or_was_overtaken_is_no_restart(
    before_ms: int, after_ms: int
) -> None:
    net = Net()
    net.router.route(frame_of(heartbeat(), STATION), RADIO)
    net.send(system_time(before_ms), STATION)
    net.send(system_time(after_ms), STATION)
    assert len(net.send(command(255, 190), COMPANION)) == 2


def test_a_channel_that_is_gone_is_not_used() -> None:
    net = Net()
    net.router.forget(COMPANION)
    assert net.send(command(1, 191), STATION) == []


def test_strangers_cannot_fill_the_memory() -> None:
    net = Net(COMPANION)
    for number in range(2 * MAX_COMPONENTS):
        frame = MavCodec(2 + number % 250, 1 + number // 250).encode(system_time(number))
        net.router.route(frame, STATION)
    assert len(net.router._routes) == len(net.router._boot_ms) == MAX_COMPONENTS


def test_who_hops_between_ports_is_followed() -> None:
    net = Net()
    for port in range(50_000, 50_050):
        channel = Channel(UDP, ("127.0.0.1", port))
        net.router.route(frame_of(heartbeat(), STATION), channel)
    peers = {chunk.peer for chunk in net.send(command(255, 190), COMPANION)}
    assert ("127.0.0.1", 50_049) in peers
    assert len(peers) == 8
