"""TCP peers that are gone without a word, or were never MAVLink peers, lose their connection."""

from __future__ import annotations

import asyncio
import itertools
import random
import socket
from contextlib import suppress

import pytest

from companion.io.links.byte_streams import USER_TIMEOUT_MS, tune
from companion.io.links.stream_links import MAX_CLIENTS, TcpFanOutLink
from companion.io.links.transports import TcpClient, TcpFanOut, TcpServer
from companion.io.shell import Shell
from tests.e2e.shell_helpers import (
    EchoEndpoint,
    drive,
    heartbeat,
    port_of,
    understood,
    until,
)
from tests.ports import free_port

REQUEST = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


@pytest.fixture(autouse=True)
def _looks_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.io.links.byte_streams.CHECK_PERIOD_S", 0.03)
    monkeypatch.setattr("companion.io.links.byte_streams.BACKOFF_MIN_S", 0.02)


async def shut(*writers: asyncio.StreamWriter) -> None:
    for writer in writers:
        writer.close()
        with suppress(ConnectionError):
            await writer.wait_closed()


def is_connected(shell: Shell) -> bool:
    return bool(getattr(shell.links[0], "is_connected", False))


@pytest.mark.parametrize("said", [REQUEST, b"", bytes(300), heartbeat(5)[:-1]])
def test_a_client_that_never_speaks_mavlink_loses_the_only_place(said: bytes) -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        shell.links[0].expects_mavlink = True
        stranger, writer = await asyncio.open_connection("127.0.0.1", port_of(shell))
        writer.write(said)
        await until(lambda: is_connected(shell))
        with suppress(ConnectionError):
            assert await stranger.read() == b""
        await until(lambda: not is_connected(shell))
        _, vehicle = await asyncio.open_connection("127.0.0.1", port_of(shell))
        vehicle.write(heartbeat(7))
        await understood(endpoint, 7)
        await shut(writer, vehicle)

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_a_client_that_talks_garbage_all_the_time_loses_its_place() -> None:
    endpoint, rng = EchoEndpoint(), random.Random(3)

    async def scene(shell: Shell) -> None:
        shell.links[0].expects_mavlink = True
        _, writer = await asyncio.open_connection("127.0.0.1", port_of(shell))

        async def talk() -> None:
            while not writer.is_closing():
                writer.write(rng.randbytes(40))
                await asyncio.sleep(0.005)

        talking = asyncio.create_task(talk())
        await until(lambda: is_connected(shell))
        await until(lambda: not is_connected(shell))
        talking.cancel()
        await shut(writer)

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_a_mavlink_client_keeps_its_place_and_a_dead_one_loses_it() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        shell.links[0].expects_mavlink = True
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(shell))
        for mark in range(40):
            writer.write(heartbeat(mark))
            await asyncio.sleep(0.03)
        assert is_connected(shell)
        while await reader.read(4096):  # it goes on acknowledging, and says nothing more
            pass
        assert not is_connected(shell)
        await shut(writer)

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)
    assert len(endpoint.marks) == 40


def test_a_server_that_says_nothing_is_dialled_again() -> None:
    endpoint, port = EchoEndpoint(), free_port()

    async def scene(shell: Shell) -> None:
        shell.links[0].expects_mavlink = True
        loop = asyncio.get_running_loop()
        with socket.create_server(("127.0.0.1", port)) as listener:
            listener.setblocking(False)
            silent = [await loop.sock_accept(listener) for _ in range(2)]
            client, _ = await loop.sock_accept(listener)
            client.send(heartbeat(9))
            await understood(endpoint, 9)
            for each, _ in (*silent, (client, None)):
                each.close()

    drive(endpoint, [TcpClient("127.0.0.1", port)], scene)


def test_a_server_that_flaps_is_dialled_ever_more_seldom(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("companion.io.links.byte_streams.BACKOFF_MAX_S", 0.64)
    endpoint, port = EchoEndpoint(), free_port()
    times_s: list[float] = []

    async def scene(_: Shell) -> None:
        loop = asyncio.get_running_loop()
        with socket.create_server(("127.0.0.1", port)) as listener:
            listener.setblocking(False)
            while len(times_s) < 7:
                client, _ = await loop.sock_accept(listener)
                times_s.append(loop.time())
                client.close()

    drive(endpoint, [TcpClient("127.0.0.1", port)], scene)
    pauses_s = [after - before for before, after in itertools.pairwise(times_s)]
    assert pauses_s[5] > 0.5
    assert sum(pauses_s) > 1.0


def test_a_radio_may_be_silent() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", port_of(shell))
        await until(lambda: is_connected(shell))
        await asyncio.sleep(0.6)
        assert is_connected(shell)
        await shut(writer)

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_strangers_on_every_place_give_way_to_a_station() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        link = shell.links[0]
        assert isinstance(link, TcpFanOutLink)
        link.expects_mavlink = True
        port = link.local_address[1]
        station, first = await asyncio.open_connection("127.0.0.1", port)
        first.write(heartbeat(1))
        await understood(endpoint, 1)
        strangers = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MAX_CLIENTS)]
        await until(lambda: len(link.clients) == MAX_CLIENTS)
        assert await strangers[0][0].read() == b""
        first.write(heartbeat(2))
        await understood(endpoint, 2)
        assert not station.at_eof()
        await shut(first, *(writer for _, writer in strangers))

    drive(endpoint, [TcpFanOut("127.0.0.1", 0)], scene)


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="Linux only")
def test_what_a_peer_does_not_acknowledge_ends_the_connection() -> None:
    with socket.socket() as stream:
        tune(stream)
        assert stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == USER_TIMEOUT_MS
