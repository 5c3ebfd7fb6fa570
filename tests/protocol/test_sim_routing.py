"""Forwarding between those who share the simulated vehicle (MAVLink guide, "Routing")."""

from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario

COMPANION: Address = ("127.0.0.1", 14550)
STATION: Address = ("127.0.0.1", 14540)


class Shared:
    """A vehicle with a companion and a ground station on its link."""

    def __init__(self) -> None:
        self.sim = SimEndpoint(Scenario(), 1)
        self.codecs = {COMPANION: MavCodec(1, 191), STATION: MavCodec(255, 190)}
        self.send(COMPANION, heartbeat(18))
        self.send(STATION, heartbeat(6))

    def send(self, peer: Address, message: Message) -> list[Chunk]:
        """Send as a peer; what the vehicle sends in answer."""
        self.sim.take_output()
        self.sim.receive(Chunk(0, self.codecs[peer].encode(message), peer), 0.0)
        return self.sim.take_output()


def heartbeat(kind: int) -> Message:
    return mavlink.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3)


def command(system_id: int, component_id: int, number: int = 92) -> Message:
    return mavlink.MAVLink_command_long_message(
        system_id, component_id, number, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )


def test_a_broadcast_goes_to_everyone_else_unaltered() -> None:
    shared = Shared()
    text = mavlink.MAVLink_statustext_message(5, b"LOCALISED", 0, 0)
    (chunk,) = shared.send(COMPANION, text)
    assert (chunk.peer, chunk.except_peers) == (None, frozenset({COMPANION}))
    (heard,) = MavCodec(9, 9).decode(chunk.data)
    assert (heard.get_srcSystem(), heard.get_srcComponent()) == (1, 191)
    assert chunk.data == bytes(text.get_msgbuf())


def test_a_command_for_the_companion_reaches_only_the_companion() -> None:
    (chunk,) = Shared().send(STATION, command(1, 191))
    assert chunk.peer == COMPANION


def test_the_answer_finds_its_way_back() -> None:
    ack = mavlink.MAVLink_command_ack_message(92, 0, 0, 0, 255, 190)
    (chunk,) = Shared().send(COMPANION, ack)
    assert chunk.peer == STATION


def test_a_command_for_the_vehicle_stays_with_it() -> None:
    chunks = Shared().send(STATION, command(1, 1, number=31000))
    messages = [m for chunk in chunks for m in MavCodec(9, 9).decode(chunk.data)]
    assert [m.get_type() for m in messages] == ["COMMAND_ACK"]


@pytest.mark.parametrize("target", [(77, 1), (1, 100)])
def test_a_command_for_an_unknown_target_is_not_forwarded(target: tuple[int, int]) -> None:
    chunks = Shared().send(STATION, command(*target))
    (ack,) = [message for chunk in chunks for message in MavCodec(9, 9).decode(chunk.data)]
    assert (ack.get_type(), ack.get_srcComponent()) == ("COMMAND_ACK", 1)


def test_a_signing_setup_is_never_forwarded() -> None:
    setup = mavlink.MAVLink_setup_signing_message(1, 191, [7] * 32, 0)
    assert Shared().send(STATION, setup) == []


def test_what_a_peer_sends_never_comes_back_to_it() -> None:
    shared = Shared()
    own = mavlink.MAVLink_command_ack_message(92, 0, 0, 0, 1, 191)
    assert shared.send(COMPANION, own) == []
