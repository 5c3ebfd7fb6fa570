"""The two links of a probe: in memory and on a wire."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from companion.errors import ConfigError, LinkError
from companion.mav.endpoint import Chunk, OneShotEndpoint
from sim_link.lab.conformance.cli import open_link
from tests.ports import free_port
from tests.protocol.memory_link import MemoryHub

PATIENCE_S = 30.0


class Clock(OneShotEndpoint):
    """An endpoint that says its time each second, and to each sender what it sent."""

    def __init__(self) -> None:
        super().__init__(None, 1.0)
        self._next_s = 1.0

    def receive(self, chunk: Chunk, now_s: float) -> None:
        super().receive(chunk, now_s)
        self._output.append(Chunk(0, b"re:" + chunk.data, chunk.peer))
        assert chunk.peer is not None
        self._output.append(Chunk(0, b"fw:" + chunk.data, None, frozenset({chunk.peer})))

    def handle_timer(self, now_s: float) -> None:
        super().handle_timer(now_s)
        self._output.append(Chunk(0, f"{now_s:g}".encode()))


def test_time_passes_to_the_next_timer_and_no_further() -> None:
    link = MemoryHub(Clock()).connect()
    assert link.poll(0.5) == []
    assert link.now_s == 0.5
    assert link.poll(5.0) == [b"1"]
    assert link.now_s == 1.0


def test_an_answer_goes_to_who_asked_and_a_forward_to_the_others() -> None:
    first = MemoryHub(Clock()).connect()
    second = first.another()
    first.send(b"hello")
    assert first.poll(first.now_s) == [b"re:hello"]
    assert second.poll(second.now_s) == [b"fw:hello"]


def test_a_client_on_another_link_of_the_endpoint_hears_only_that_link() -> None:
    hub = MemoryHub(Clock())
    first, other = hub.connect(0), hub.connect(1)
    assert first.poll(3.0) == [b"1"]
    assert other.poll(hub.now_s) == []


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened


def test_a_udp_link_sends_and_hears(peer: socket.socket) -> None:
    with open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as link:
        assert link.is_datagram
        link.send(b"question")
        data, address = peer.recvfrom(100)
        assert data == b"question"
        peer.sendto(b"answer", address)
        assert link.poll(link.now_s + PATIENCE_S) == [b"answer"]


def test_a_silent_link_is_waited_for(peer: socket.socket) -> None:
    with open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as link:
        until_s = link.now_s + 0.05
        assert link.poll(until_s) == []
        assert link.now_s >= until_s


def test_a_second_client_has_an_address_of_its_own(peer: socket.socket) -> None:
    with open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as link:
        other = link.another()
        assert other is not None
        link.send(b"1")
        other.send(b"2")
        senders = {peer.recvfrom(100)[1], peer.recvfrom(100)[1]}
        assert len(senders) == 2


def test_a_listening_link_answers_its_first_peer_and_has_room_for_one(
    peer: socket.socket,
) -> None:
    port = free_port()
    with open_link(f"udpin:127.0.0.1:{port}") as link:
        assert link.another() is None
        peer.sendto(b"here", ("127.0.0.1", port))
        assert link.poll(link.now_s + PATIENCE_S) == [b"here"]
        link.send(b"there")
        assert peer.recv(100) == b"there"


def test_a_taken_port_is_reported(peer: socket.socket) -> None:
    with (
        pytest.raises(LinkError, match="in use"),
        open_link(f"udpin:127.0.0.1:{peer.getsockname()[1]}"),
    ):
        pass


def test_a_wrong_address_is_reported() -> None:
    with pytest.raises(ConfigError, match="must begin with"), open_link("carrier-pigeon:1"):
        pass


def test_further_clients_of_a_server_leave_it_when_they_are_closed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        with open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}") as link:
            first, _ = server.accept()
            assert link.another() is not None
            second, _ = server.accept()
            with first, second:
                link.close_others()
                second.settimeout(PATIENCE_S)
                assert second.recv(10) == b""
                link.send(b"still there")
                assert first.recv(20) == b"still there"
