"""The shell on TCP and on a pseudo terminal; short, and few sleeps."""

from __future__ import annotations

import asyncio
import os
import random
import socket
import tty
from contextlib import suppress
from pathlib import Path

import pytest

from companion.errors import LinkError
from companion.io.links.transports import SerialPort, TcpClient, TcpServer
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk
from tests.e2e.shell_helpers import (
    TIMEOUT_S,
    EchoEndpoint,
    drive,
    garbage,
    heartbeat,
    lost,
    marks_in,
    port_of,
    understood,
    until,
)
from tests.ports import free_port


def test_a_stream_of_garbage_over_tcp_does_no_harm() -> None:
    endpoint, rng = EchoEndpoint(), random.Random(4)

    async def scene(shell: Shell) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(shell))
        for _ in range(10_000):
            writer.write(garbage(rng))
        await writer.drain()
        # A beginning that looks like a frame may wait for 280 bytes: the next frames fill it.
        for _ in range(30):
            writer.write(heartbeat(4242))
        await until(lambda: endpoint.marks.count(4242) > 10)
        writer.close()
        await writer.wait_closed()
        assert reader is not None

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_a_tcp_server_serves_one_client_at_a_time_and_the_next_after_it() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        port = port_of(shell)
        _, first = await asyncio.open_connection("127.0.0.1", port)
        first.write(heartbeat(1))
        await until(lambda: endpoint.marks == [1])
        second_reader, second = await asyncio.open_connection("127.0.0.1", port)
        assert await second_reader.read() == b""
        first.close()
        await until(lambda: not getattr(shell.links[0], "is_connected", True))
        third_reader, third = await asyncio.open_connection("127.0.0.1", port)
        third.write(heartbeat(3))
        assert marks_in(await third_reader.read(100)) == [3]
        for writer in (second, third):
            writer.close()
            await writer.wait_closed()

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_a_tcp_client_connects_late_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.io.links.byte_streams.BACKOFF_MIN_S", 0.02)
    endpoint, port = EchoEndpoint(), free_port()

    async def scene(shell: Shell) -> None:
        endpoint.say(Chunk(0, b"no peer is there"))
        await until(lambda: shell.links[0].counters.dropped == 1)
        for mark in (1, 2):
            with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind(("127.0.0.1", port))
                listener.listen()
                listener.setblocking(False)
                loop = asyncio.get_running_loop()
                async with asyncio.timeout(TIMEOUT_S):
                    client, _ = await loop.sock_accept(listener)
                with client:
                    client.send(heartbeat(mark))
                    await understood(endpoint, mark)
            await lost(shell, mark)

    drive(endpoint, [TcpClient("127.0.0.1", port)], scene)
    assert endpoint.marks == [1, 2]


def test_a_client_that_does_not_read_costs_chunks_and_not_memory() -> None:
    endpoint = EchoEndpoint()

    async def scene(shell: Shell) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as lazy:
            lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            lazy.connect(("127.0.0.1", port_of(shell)))
            await until(lambda: bool(getattr(shell.links[0], "is_connected", False)))

            def is_full() -> bool:
                for _ in range(100):
                    endpoint.say(Chunk(0, bytes(10_000)))
                return shell.links[0].counters.dropped > 100

            await until(is_full)
            ticks = len(endpoint.ticks_s)
            await until(lambda: len(endpoint.ticks_s) > ticks + 3)

    drive(endpoint, [TcpServer("127.0.0.1", 0)], scene)


def test_a_serial_line_is_read_through_garbage_and_reopened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.io.links.byte_streams.BACKOFF_MIN_S", 0.02)
    endpoint, rng = EchoEndpoint(), random.Random(5)
    device = tmp_path / "ttyACM0"

    def plug_in() -> int:
        master, slave = os.openpty()
        tty.setraw(slave)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(master, False)
        return master

    async def put(master: int, data: bytes) -> None:
        async with asyncio.timeout(TIMEOUT_S):
            while data:
                try:
                    data = data[os.write(master, data) :]
                except BlockingIOError:
                    await asyncio.sleep(0.001)
                with suppress(BlockingIOError):  # the echoes, lest the line fill up
                    os.read(master, 65536)

    first = plug_in()

    async def scene(shell: Shell) -> None:
        master = first
        await until(lambda: bool(getattr(shell.links[0], "is_connected", False)))
        await put(master, b"".join(garbage(rng) for _ in range(10_000)))
        await put(master, heartbeat(4242) * 30)
        await until(lambda: endpoint.marks.count(4242) > 10)
        os.close(master)
        await until(lambda: shell.links[0].counters.reconnects == 1)
        master = plug_in()
        await until(lambda: bool(getattr(shell.links[0], "is_connected", False)))
        await put(master, heartbeat(77) * 20)
        await until(lambda: 77 in endpoint.marks)
        os.close(master)

    drive(endpoint, [SerialPort(str(device))], scene)


@pytest.mark.parametrize(
    ("device", "problem"),
    [
        ("/dev/ttyNoSuchPort", "no such device"),
        ("/dev/null", "is not a serial port"),
        (__file__, "is not a serial port"),
    ],
)
def test_a_serial_port_that_is_none_is_refused_at_the_start(device: str, problem: str) -> None:
    with pytest.raises(LinkError, match=f"{device}: {problem}"):
        Shell(EchoEndpoint(), [SerialPort(device)], Clock()).run_blocking()
