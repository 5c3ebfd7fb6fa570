"""Clients that share one port of the simulated vehicle: each has what it asked for."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario

ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE
POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
PORTS: tuple[Address, ...] = tuple(("127.0.0.1", port) for port in (14550, 14540, 50_123))
LURKER: Address = ("127.0.0.1", 14_999)
MAGIC_INDEX, MAVLINK1, MAVLINK2 = 0, 0xFE, 0xFD


@dataclass
class Client:
    """One peer; it hears what its socket would."""

    address: Address
    codec: MavCodec = field(default_factory=lambda: MavCodec(255, 190))
    frames: list[bytes] = field(default_factory=list)

    def messages(self, kind: type[Message]) -> list[Message]:
        reader = MavCodec(254, 1)
        found = [message for frame in self.frames for message in reader.decode(frame)]
        return [m for m in found if isinstance(m, kind) and m.get_srcComponent() == 1]


class Port:
    """A vehicle with several clients on its first link."""

    def __init__(self, flavour: FlavourName = "px4", *addresses: Address) -> None:
        scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
        self.sim = SimEndpoint(scenario, 1)
        self.clients = [Client(address) for address in addresses or PORTS]
        self.now_s = 0.0

    def send(
        self,
        client: Client,
        message: Message,
        *,
        is_mavlink1: bool = False,
        is_datagram: bool = True,
    ) -> None:
        data = client.codec.encode(message, is_mavlink1=is_mavlink1)
        self.sim.receive(Chunk(0, data, client.address, is_datagram=is_datagram), self.now_s)
        self.deliver()

    def ask(self, client: Client, number: int, rate_hz: float) -> None:
        values = (float(number), 1e6 / rate_hz, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.send(client, mavlink.MAVLink_command_long_message(1, 1, SET_INTERVAL, 0, *values))

    def run(self, duration_s: float) -> None:
        until_s = self.now_s + duration_s
        while self.now_s < until_s - 1e-9:
            self.now_s = round(self.now_s + 0.02, 6)
            self.sim.handle_timer(self.now_s)
            self.deliver()

    def deliver(self) -> None:
        for chunk in self.sim.take_output():
            for client in self.clients:
                if (
                    chunk.peer in (None, client.address)
                    and client.address not in chunk.except_peers
                ):
                    client.frames.append(chunk.data)

    def clear(self) -> None:
        for client in self.clients:
            client.frames.clear()


def is_of_the_vehicle(frame: bytes) -> bool:
    ids = frame[3:5] if frame[MAGIC_INDEX] == MAVLINK1 else frame[5:7]
    return ids == bytes((1, 1))


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_every_client_of_a_port_gets_the_rates_that_it_asked_for(flavour: FlavourName) -> None:
    port = Port(flavour)
    port.run(3.0)
    wanted = [(50.0, 5.0), (20.0, 25.0), (4.0, 10.0)]
    for client, (attitude_hz, position_hz) in zip(port.clients, wanted, strict=True):
        port.ask(client, ATTITUDE, attitude_hz)
        port.ask(client, POSITION, position_hz)
    port.run(1.0)
    port.clear()
    port.run(10.0)
    heard = [
        (
            len(client.messages(mavlink.MAVLink_attitude_message)) / 10.0,
            len(client.messages(mavlink.MAVLink_local_position_ned_message)) / 10.0,
        )
        for client in port.clients
    ]
    assert heard == [pytest.approx(pair, rel=0.05) for pair in wanted]


def test_a_client_that_requested_nothing_keeps_the_defaults() -> None:
    port = Port("px4", PORTS[0], LURKER)
    port.run(3.0)
    port.clear()
    port.run(2.0)
    before = len(port.clients[1].messages(mavlink.MAVLink_attitude_message))
    port.ask(port.clients[0], ATTITUDE, 1.0)
    port.clear()
    port.run(2.0)
    assert len(port.clients[1].messages(mavlink.MAVLink_attitude_message)) == before
    assert len(port.clients[0].messages(mavlink.MAVLink_attitude_message)) <= 3


def test_no_client_sees_a_gap_in_the_sequence_numbers_when_one_is_kept_apart() -> None:
    port = Port("px4", PORTS[0], LURKER)
    port.run(3.0)
    port.ask(port.clients[0], ATTITUDE, 7.0)
    port.run(3.0)
    for client in port.clients:
        numbers = [frame[4] for frame in client.frames if is_of_the_vehicle(frame)]
        steps = {(b - a) % 256 for a, b in itertools.pairwise(numbers)}
        assert steps == {1}


def test_an_ack_is_heard_by_everyone_on_the_port_once() -> None:
    port = Port("px4", PORTS[0], LURKER)
    port.run(3.0)
    port.ask(port.clients[0], ATTITUDE, 7.0)
    for client in port.clients:
        assert len(client.messages(mavlink.MAVLink_command_ack_message)) == 1


def test_a_plan_is_uploaded_by_a_client_that_changes_its_streams_meanwhile() -> None:
    port = Port("px4", PORTS[0], LURKER)
    client = port.clients[0]
    port.run(3.0)
    port.send(client, mavlink.MAVLink_mission_count_message(1, 1, 1, 0))
    port.ask(client, ATTITUDE, 7.0)
    item = mavlink.MAVLink_mission_item_int_message(
        1, 1, 0, 6, 16, 1, 1, 0.0, 2.0, 0.0, 0.0, 473_978_000, 85_457_000, 20.0, 0
    )
    port.send(client, item)
    (ack,) = client.messages(mavlink.MAVLink_mission_ack_message)
    assert isinstance(ack, mavlink.MAVLink_mission_ack_message)
    assert ack.type == mavlink.MAV_MISSION_ACCEPTED


def test_a_mavlink_1_client_is_answered_in_mavlink_1_beside_others_of_mavlink_2() -> None:
    port = Port("px4", PORTS[0], LURKER)
    modern, old = port.clients
    port.run(3.0)
    port.send(modern, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    port.send(old, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), is_mavlink1=True)
    port.clear()
    port.run(1.0)
    port.send(old, mavlink.MAVLink_param_request_list_message(1, 1), is_mavlink1=True)
    port.run(1.0)
    own = [frame for frame in old.frames if frame[MAGIC_INDEX] == MAVLINK1]
    assert len(own) > 100
    assert [frame for frame in old.frames if frame[MAGIC_INDEX] != MAVLINK1] == []
    assert {frame[MAGIC_INDEX] for frame in modern.frames if len(frame) > 12} >= {0xFD}
    assert not any(
        frame[MAGIC_INDEX] == MAVLINK1 and frame[3:5] == b"\x01\x01" for frame in modern.frames
    )


def test_a_client_that_left_its_tcp_port_is_served_no_more() -> None:
    port = Port("px4", PORTS[0], LURKER)
    client = port.clients[0]
    port.run(3.0)
    port.ask(client, ATTITUDE, 7.0)
    port.sim.receive(Chunk(0, b"", client.address, is_datagram=False), port.now_s)
    port.run(0.1)
    port.sim.handle_timer(port.now_s + 1.0)
    assert {chunk.peer for chunk in port.sim.take_output()} == {None}
