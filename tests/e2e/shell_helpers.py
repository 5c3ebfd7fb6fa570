"""Helpers of the shell's tests: an endpoint that echoes, a world that waits, and time."""

from __future__ import annotations

import asyncio
import random
import selectors
import socket
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from companion.io.links.stream_links import TcpServerLink
from companion.io.links.transports import Transport
from companion.io.links.udp import UdpLink
from companion.io.shell import Clock, Shell
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk, Endpoint

TIMEOUT_S = 60.0
"""Time limit of an event that must come, on a slow machine that is shared."""


class EchoEndpoint:
    """Understands messages per link, returns each to its sender, and ticks every 10 ms."""

    def __init__(self, *, finishes: bool = True) -> None:
        self.marks: list[int] = []
        """custom_mode of every HEARTBEAT understood."""
        self.ticks_s: list[float] = []
        self.stops_s: list[float] = []
        self.is_finished = False
        self._finishes = finishes
        self._codecs: dict[int, MavCodec] = {}
        self._output: list[Chunk] = []
        self._due_s = 0.0

    def receive(self, chunk: Chunk, now_s: float) -> None:
        assert now_s >= 0.0
        codec = self._codecs.setdefault(chunk.link, MavCodec(1, 191))
        for message in codec.decode(chunk.data, is_datagram=chunk.is_datagram):
            if message.get_type() == "HEARTBEAT":
                self.marks.append(int(message.to_dict()["custom_mode"]))
            self._output.append(Chunk(chunk.link, codec.encode(message), chunk.peer))

    def say(self, chunk: Chunk) -> None:
        self._output.append(chunk)

    def handle_timer(self, now_s: float) -> None:
        self.ticks_s.append(now_s)
        self._due_s = now_s + 0.01

    def next_timer_s(self) -> float:
        return self._due_s

    def take_output(self) -> list[Chunk]:
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        self.stops_s.append(now_s)
        self.is_finished = self._finishes


def heartbeat(mark: int) -> bytes:
    return MavCodec(2, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, mark, 4, 3))


def marks_in(data: bytes) -> list[int]:
    messages = MavCodec(9, 9).decode(data, is_datagram=False)
    return [int(message.to_dict()["custom_mode"]) for message in messages]


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(TIMEOUT_S):
        while not condition():
            await asyncio.sleep(0.002)


async def received(shell: Shell, count: int) -> None:
    await until(lambda: shell.links[0].counters.received >= count)


async def lost(shell: Shell, count: int) -> None:
    await until(lambda: shell.links[0].counters.reconnects == count)


async def understood(endpoint: EchoEndpoint, mark: int) -> None:
    await until(lambda: mark in endpoint.marks)


def drive(
    endpoint: Endpoint,
    links: Sequence[Transport],
    scene: Callable[[Shell], Awaitable[None]],
    clock: Clock | None = None,
) -> Shell:
    """Run a shell while `scene` plays the rest of the world, then stop it."""

    async def play() -> Shell:
        has_begun = asyncio.Event()  # the shell wakes up once all its links are open
        shell = Shell(endpoint, links, clock or Clock(), lambda _: has_begun.set())
        running = asyncio.create_task(shell.run())
        try:
            await until(lambda: has_begun.is_set() or running.done())
            if not running.done():
                await scene(shell)
        finally:
            shell.request_stop()
            await running
        return shell

    return asyncio.run(play())


class TimeOfOurs(selectors.DefaultSelector):
    """Time that passes only while an event loop waits, and then at once: nothing is ever late."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def monotonic(self) -> float:
        """Return the invented time, in place of `time.monotonic`."""
        return self.now_s

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready; otherwise let the timeout pass."""
        ready = super().select(0.0)
        if not ready and timeout is not None:
            self.now_s += max(0.0, timeout)
        return ready

    def run(self, shell: Shell) -> float:
        """Run a shell to its end; how many seconds it took."""
        began_s = self.now_s

        def loop() -> asyncio.AbstractEventLoop:
            made: Any = asyncio.SelectorEventLoop(self)
            made.time = self.monotonic
            return made  # type: ignore[no-any-return]

        with asyncio.Runner(loop_factory=loop) as runner:
            runner.run(shell.run())
        return self.now_s - began_s


def port_of(shell: Shell, index: int = 0) -> int:
    link = shell.links[index]
    assert isinstance(link, UdpLink | TcpServerLink)
    return link.local_address[1]


async def heard(peer: socket.socket) -> bytes:
    async with asyncio.timeout(TIMEOUT_S):
        return await asyncio.get_running_loop().sock_recv(peer, 65535)


def garbage(rng: random.Random) -> bytes:
    frame = heartbeat(rng.randrange(1 << 32))
    match rng.randrange(4):
        case 0:
            return frame[: rng.randrange(1, len(frame))]
        case 1:
            return rng.choice((b"\xfd", b"\xfe")) + rng.randbytes(rng.randrange(40))
        case 2:
            at = rng.randrange(len(frame))
            return frame[:at] + bytes((frame[at] ^ 1 << rng.randrange(8),)) + frame[at + 1 :]
    return rng.randbytes(rng.randrange(300))
