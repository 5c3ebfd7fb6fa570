"""The shell on UDP, on real loopback sockets; short, and few sleeps."""

from __future__ import annotations

import asyncio
import errno
import random
import socket
import threading

import pytest

from companion.errors import LinkError
from companion.io.links.transports import TcpServer, Transport, UdpBind, UdpConnect, UdpFanOut
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk
from tests.e2e.shell_helpers import (
    TIMEOUT_S,
    EchoEndpoint,
    drive,
    garbage,
    heard,
    heartbeat,
    marks_in,
    port_of,
    received,
    understood,
    until,
)
from tests.ports import free_port


def test_a_datagram_is_answered_to_its_sender(peer: socket.socket) -> None:
    async def scene(shell: Shell) -> None:
        peer.sendto(heartbeat(42), ("127.0.0.1", port_of(shell)))
        assert marks_in(await heard(peer)) == [42]

    shell = drive(EchoEndpoint(), [UdpBind("127.0.0.1", 0)], scene)
    assert shell.links[0].counters.sent == 1
    assert shell.links[0].counters.received == 1


def test_a_chunk_without_a_peer_is_dropped_by_a_bound_link() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        endpoint.say(Chunk(0, b"x"))
        await until(lambda: shell.links[0].counters.dropped == 1)

    drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)


def test_a_taken_port_is_a_link_error_that_says_what_to_do() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(LinkError) as caught:
            Shell(EchoEndpoint(), [UdpBind("127.0.0.1", port)], Clock()).run_blocking()
    assert str(caught.value) == (
        f"udp 127.0.0.1:{port} is in use by another program; close it or choose another port"
    )


def test_the_links_opened_before_a_failing_one_are_closed() -> None:
    first = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        links: list[Transport] = [
            UdpBind("127.0.0.1", first),
            TcpServer("127.0.0.1", taken.getsockname()[1]),
        ]
        with pytest.raises(LinkError, match="in use"):
            Shell(EchoEndpoint(), links, Clock()).run_blocking()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", first))


def test_an_address_that_is_not_ours_is_named() -> None:
    with pytest.raises(LinkError, match="no interface"):
        Shell(EchoEndpoint(), [UdpBind("192.0.2.1", 14550)], Clock()).run_blocking()


def test_a_host_may_be_a_name(peer: socket.socket) -> None:
    async def scene(shell: Shell) -> None:
        peer.sendto(heartbeat(42), ("127.0.0.1", port_of(shell)))
        assert marks_in(await heard(peer)) == [42]

    drive(EchoEndpoint(), [UdpBind("localhost", 0)], scene)


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(LinkError, match=r"the host `nobody\.invalid` is unknown"):
        Shell(EchoEndpoint(), [UdpConnect("nobody.invalid", 14550)], Clock()).run_blocking()


def test_a_fan_out_reaches_remotes_and_the_last_sixteen_senders() -> None:
    endpoint = EchoEndpoint()
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(19)]
    try:
        for opened in sockets:
            opened.bind(("127.0.0.1", 0))
            opened.setblocking(False)
        remote, *senders = sockets

        async def scene(shell: Shell) -> None:
            for count, sender in enumerate(senders, 1):
                sender.sendto(b"hello", ("127.0.0.1", port_of(shell)))
                await received(shell, count)
            endpoint.say(Chunk(0, b"news"))
            assert await heard(remote) == b"news"
            for sender in senders[2:]:
                assert await heard(sender) == b"news"
            for forgotten in senders[:2]:
                with pytest.raises(BlockingIOError):
                    forgotten.recv(10)

        drive(endpoint, [UdpFanOut("127.0.0.1", 0, (remote.getsockname(),))], scene)
    finally:
        for opened in sockets:
            opened.close()


def test_a_connecting_link_speaks_first_and_hears_only_its_remote(peer: socket.socket) -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        endpoint.say(Chunk(0, heartbeat(1)))
        async with asyncio.timeout(TIMEOUT_S):
            data, address = await asyncio.get_running_loop().sock_recvfrom(peer, 65535)
        assert marks_in(data) == [1]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(heartbeat(666), address)
        peer.sendto(heartbeat(2), address)
        await until(lambda: shell.links[0].counters.received == 1)

    drive(endpoint, [UdpConnect("127.0.0.1", peer.getsockname()[1])], scene)
    assert endpoint.marks == [2]


def test_a_refusing_remote_is_counted_and_never_raised() -> None:
    endpoint, port = EchoEndpoint(), free_port()

    async def scene(shell: Shell) -> None:
        def refused() -> bool:
            endpoint.say(Chunk(0, b"anyone?"))
            counters = shell.links[0].counters
            return counters.send_errors + counters.receive_errors > 3

        await until(refused)

    drive(endpoint, [UdpConnect("127.0.0.1", port)], scene)


def test_a_send_that_the_system_refuses_is_counted(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(socket.socket):
        def sendto(self, *_: object) -> int:
            raise OSError(errno.ENOBUFS, "No buffer space available")

    monkeypatch.setattr("companion.io.links.udp.socket.socket", Full)
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        endpoint.say(Chunk(0, b"x", peer.getsockname()))
        endpoint.say(Chunk(0, bytes(70_000), peer.getsockname()))
        await until(lambda: shell.links[0].counters.send_errors == 2)

    drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)


@pytest.mark.parametrize("is_bound", [True, False])
def test_a_socket_whose_network_is_gone_is_opened_again_on_its_port(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch, is_bound: bool
) -> None:
    """The first socket loses its interface, and the port is taken for a moment."""
    made: list[socket.socket] = []

    class Interface(socket.socket):
        def __init__(self, *arguments: int) -> None:
            super().__init__(*arguments)
            if self.type is socket.SOCK_DGRAM:  # and not one of asyncio's own
                made.append(self)

        def sendto(self, data: bytes, peer: tuple[str, int]) -> int:  # type: ignore[override]
            if len(made) == 1:
                raise OSError(errno.ENETDOWN, "Network is down")
            return super().sendto(data, peer)

        def send(self, data: bytes) -> int:  # type: ignore[override]
            if len(made) == 1:
                raise OSError(errno.EADDRNOTAVAIL, "Cannot assign requested address")
            return super().send(data)

        def bind(self, address: tuple[str, int]) -> None:  # type: ignore[override]
            if len(made) == 2:
                raise OSError(errno.EADDRNOTAVAIL, "Cannot assign requested address")
            super().bind(address)

    endpoint, address, port_of_ours = EchoEndpoint(), peer.getsockname(), free_port()
    monkeypatch.setattr("companion.io.links.udp.socket.socket", Interface)
    spec = UdpBind("127.0.0.1", port_of_ours) if is_bound else UdpConnect(*address)

    async def scene(shell: Shell) -> None:
        port = port_of(shell)
        endpoint.say(Chunk(0, heartbeat(1), address))
        await until(lambda: shell.links[0].counters.send_errors == 1)
        assert shell.links[0].is_open
        await until(lambda: shell.links[0].counters.reconnects == 1)
        assert not is_bound or port_of(shell) == port
        endpoint.say(Chunk(0, heartbeat(2), address))
        assert await heard(peer) == heartbeat(2)
        peer.sendto(heartbeat(3), ("127.0.0.1", port_of(shell)))
        await understood(endpoint, 3)

    drive(endpoint, [spec], scene)
    assert len(made) == (3 if is_bound else 2)


def test_ten_thousand_bad_datagrams_do_no_harm(peer: socket.socket) -> None:
    endpoint, rng = EchoEndpoint(), random.Random(3)

    async def scene(shell: Shell) -> None:
        address = ("127.0.0.1", port_of(shell))
        for number in range(10_000):
            peer.sendto(garbage(rng), address)
            if number % 100 == 0:  # not more at once than the socket's buffer holds
                await asyncio.sleep(0)
                await received(shell, number)
        peer.sendto(heartbeat(4242), address)
        await until(lambda: 4242 in endpoint.marks)

    drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)


def test_a_flood_does_not_starve_the_timer() -> None:
    endpoint = EchoEndpoint()
    stopped = threading.Event()

    def flood(port: int) -> None:
        frame = heartbeat(7)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stopped.is_set():
                sender.sendto(frame, ("127.0.0.1", port))

    async def scene(shell: Shell) -> None:
        thread = threading.Thread(target=flood, args=(port_of(shell),))
        thread.start()
        try:
            await until(lambda: len(endpoint.marks) > 2000)
            ticks = len(endpoint.ticks_s)
            await until(lambda: len(endpoint.ticks_s) >= ticks + 20)
        finally:
            stopped.set()
            thread.join()

    drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)
