"""Links that serve everybody who comes: TCP for several clients, a pseudo terminal, all at once."""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from companion.errors import LinkError
from companion.io.links.stream_links import MAX_CLIENTS, PtyLink, TcpFanOutLink
from companion.io.links.transports import (
    Pty,
    TcpFanOut,
    Transport,
    UdpFanOut,
    parse_transport,
    shared,
)
from companion.io.links.udp import UdpLink
from companion.io.shell import Clock, Shell
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.protocols.link_layer import FrameReceivers
from sim_link.autopilot.scenario import Scenario
from tests.e2e.shell_helpers import TIMEOUT_S, drive, until

HOST = "127.0.0.1"


class Echo:
    """Endpoint that returns every frame to its peer, and sends the chunks of `say`."""

    is_finished = False

    def __init__(self) -> None:
        self.heard: list[Chunk] = []
        self._receivers = FrameReceivers()
        self._output: list[Chunk] = []

    def receive(self, chunk: Chunk, now_s: float) -> None:  # noqa: ARG002
        for frame in self._receivers.split(chunk)[0]:
            self.heard.append(Chunk(chunk.link, frame, chunk.peer))
            self._output.append(Chunk(chunk.link, frame, chunk.peer))

    def say(self, chunk: Chunk) -> None:
        self._output.append(chunk)

    def handle_timer(self, now_s: float) -> None:
        self._due_s = now_s + 0.01

    _due_s = 0.0

    def next_timer_s(self) -> float:
        return self._due_s

    def take_output(self) -> list[Chunk]:
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:  # noqa: ARG002
        self.is_finished = True


def tcp_port(shell: Shell, index: int = 0) -> int:
    link = shell.links[index]
    assert isinstance(link, TcpFanOutLink)
    return link.local_address[1]


async def connected(shell: Shell, index: int = 0) -> socket.socket:
    """A new client, after the server has noticed it."""
    link = shell.links[index]
    assert isinstance(link, TcpFanOutLink)
    client = socket.create_connection((HOST, tcp_port(shell, index)))
    client.setblocking(False)
    await until(lambda: client.getsockname() in link.clients)
    return client


def frame(mark: int) -> bytes:
    return MavCodec(255, 190).encode(mavlink.MAVLink_heartbeat_message(6, 8, 0, mark, 4, 3))


async def read(client: socket.socket, length: int) -> bytes:
    data = b""
    async with asyncio.timeout(TIMEOUT_S):
        while len(data) < length:
            piece = await asyncio.get_running_loop().sock_recv(client, length - len(data))
            assert piece, "closed"
            data += piece
    return data


# TCP


def test_each_client_gets_its_own_answers_though_their_frames_arrive_in_pieces() -> None:
    async def scene(shell: Shell) -> None:
        with ExitStack() as stack:
            clients = [stack.enter_context(await connected(shell)) for _ in range(3)]
            for index in range(len(frame(0))):
                for mark, client in enumerate(clients):
                    client.send(frame(mark)[index : index + 1])
                await asyncio.sleep(0.0)
            for mark, client in enumerate(clients):
                assert await read(client, len(frame(mark))) == frame(mark)

    drive(Echo(), [TcpFanOut(HOST, 0)], scene)


def test_what_names_no_peer_goes_to_every_client_but_the_excepted_one() -> None:
    endpoint = Echo()

    async def scene(shell: Shell) -> None:
        with ExitStack() as stack:
            clients = [stack.enter_context(await connected(shell)) for _ in range(3)]
            first: Address = clients[0].getsockname()
            endpoint.say(Chunk(0, b"for the others", None, except_peers=frozenset({first})))
            endpoint.say(Chunk(0, b"for all"))
            assert await read(clients[0], 7) == b"for all"
            for client in clients[1:]:
                assert await read(client, 21) == b"for the othersfor all"

    shell = drive(endpoint, [TcpFanOut(HOST, 0)], scene)
    assert shell.links[0].counters.sent == 5


def test_a_client_that_leaves_disturbs_no_other() -> None:
    endpoint = Echo()

    async def scene(shell: Shell) -> None:
        link = shell.links[0]
        assert isinstance(link, TcpFanOutLink)
        with await connected(shell) as stays:
            leaves = await connected(shell)
            gone: Address = leaves.getsockname()
            leaves.send(frame(1)[:9])
            leaves.close()
            await until(lambda: len(link.clients) == 1)
            endpoint.say(Chunk(0, b"x", gone))
            stays.send(frame(2))
            assert await read(stays, len(frame(2))) == frame(2)

    shell = drive(endpoint, [TcpFanOut(HOST, 0)], scene)
    assert shell.links[0].counters.dropped == 1


def test_there_is_room_for_sixteen() -> None:
    async def scene(shell: Shell) -> None:
        with ExitStack() as stack:
            for _ in range(MAX_CLIENTS):
                stack.enter_context(await connected(shell))
            late = stack.enter_context(socket.create_connection((HOST, tcp_port(shell))))
            late.setblocking(False)
            async with asyncio.timeout(TIMEOUT_S):
                assert await asyncio.get_running_loop().sock_recv(late, 1) == b""

    drive(Echo(), [TcpFanOut(HOST, 0)], scene)


def test_a_taken_port_is_a_link_error_that_says_what_to_do() -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=f"tcp {HOST}:{port} is in use by another program"):
            Shell(Echo(), [TcpFanOut(HOST, port)], Clock()).run_blocking()


# The pseudo terminal


def opened(path: Path) -> int:
    """The port as a program opens it."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(fd)
    return fd


async def serial_read(fd: int, length: int) -> bytes:
    data = b""
    async with asyncio.timeout(TIMEOUT_S):
        while len(data) < length:
            try:
                data += os.read(fd, length - len(data))
            except BlockingIOError:
                await asyncio.sleep(0.002)
    return data


def is_connected(shell: Shell) -> bool:
    link = shell.links[0]
    assert isinstance(link, PtyLink)
    return link.is_connected


def test_a_pseudo_terminal_is_a_serial_port_that_can_be_opened_again(tmp_path: Path) -> None:
    path, endpoint = tmp_path / "vehicle", Echo()

    async def scene(shell: Shell) -> None:
        for mark in range(3):
            endpoint.say(Chunk(0, b"stale"))
            await until(lambda mark=mark: shell.links[0].counters.dropped == mark + 1)  # type: ignore[misc]
            fd = opened(path)
            await until(lambda: is_connected(shell))
            os.write(fd, frame(mark))
            assert await serial_read(fd, len(frame(mark))) == frame(mark)
            os.close(fd)
            await until(lambda: not is_connected(shell))

    drive(endpoint, [Pty(str(path))], scene)
    assert [chunk.data for chunk in endpoint.heard] == [frame(mark) for mark in range(3)]
    assert not path.is_symlink()


def test_a_name_left_behind_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "vehicle"
    path.symlink_to("/dev/pts/no-such-terminal")

    async def scene(shell: Shell) -> None:  # noqa: ARG001
        assert path.is_char_device()

    drive(Echo(), [Pty(str(path))], scene)


@pytest.mark.parametrize(
    ("name", "problem"), [("taken", "delete it or choose another"), ("no/folder", "no folder")]
)
def test_a_name_that_cannot_be_is_a_link_error(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(LinkError, match=problem):
        Shell(Echo(), [Pty(str(tmp_path / name))], Clock()).run_blocking()
    assert (tmp_path / "taken").read_text() == "mine"


# All at once


def ping(mark: int) -> bytes:
    return MavCodec(255, 190).encode(mavlink.MAVLink_ping_message(mark, mark, 0, 0))


def is_answer(message: Message, mark: int) -> bool:
    return isinstance(message, mavlink.MAVLink_ping_message) and message.seq == mark


@pytest.mark.slow
def test_one_vehicle_is_on_udp_tcp_and_a_serial_port_at_once(tmp_path: Path) -> None:
    path = tmp_path / "vehicle"
    links: list[Transport] = [UdpFanOut(HOST, 0), TcpFanOut(HOST, 0), Pty(str(path))]

    async def scene(shell: Shell) -> None:
        udp = shell.links[0]
        assert isinstance(udp, UdpLink)
        with ExitStack() as stack:
            station = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            station.setblocking(False)
            tablet = stack.enter_context(await connected(shell, 1))
            fd = opened(path)
            stack.callback(os.close, fd)
            loop = asyncio.get_running_loop()

            async def from_serial() -> bytes:
                with suppress(BlockingIOError):
                    return os.read(fd, 4096)
                await asyncio.sleep(0.002)
                return b""

            async def from_udp() -> bytes:
                return await loop.sock_recv(station, 65_535)

            async def from_tcp() -> bytes:
                return await loop.sock_recv(tablet, 65_535)

            station.sendto(ping(1), udp.local_address)
            tablet.send(ping(2))
            os.write(fd, ping(3))
            await asyncio.gather(
                *(
                    finds_both(read_some, mark)
                    for mark, read_some in enumerate((from_udp, from_tcp, from_serial), 1)
                )
            )

    drive(SimEndpoint(Scenario(), 1, links=len(links)), links, scene)


async def finds_both(read_some: Callable[[], Awaitable[bytes]], mark: int) -> None:
    """Read until the vehicle's HEARTBEAT and the answer to the PING have come."""
    codec, has_answer, has_heartbeat = MavCodec(255, 190), False, False
    async with asyncio.timeout(TIMEOUT_S):
        while not (has_answer and has_heartbeat):
            for message in codec.decode(await read_some(), is_datagram=False):
                has_answer |= is_answer(message, mark)
                has_heartbeat |= isinstance(message, mavlink.MAVLink_heartbeat_message)


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("udp:127.0.0.1:14580", UdpFanOut(HOST, 14580)),
        ("tcpin:127.0.0.1:5760", TcpFanOut(HOST, 5760)),
        ("pty:/tmp/vehicle", Pty("/tmp/vehicle")),
    ],
)
def test_a_vehicles_addresses_serve_everybody(text: str, spec: Transport) -> None:
    assert shared(parse_transport(text)) == spec
