"""The shell on real loopback sockets and a pseudo terminal; short, and few sleeps."""

from __future__ import annotations

import asyncio
import errno
import os
import random
import signal
import socket
import threading
import time
import tty
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from companion.errors import LinkError
from companion.io.clock import Clock
from companion.io.links import (
    LinkSpec,
    SerialPort,
    TcpClient,
    TcpServer,
    UdpBind,
    UdpConnect,
    UdpFanOut,
)
from companion.io.shell import Shell
from companion.io.tcp_server import TcpServerLink
from companion.io.udp import UdpLink
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk

TIMEOUT_S = 10.0


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
    endpoint: EchoEndpoint, links: list[LinkSpec], scene: Callable[[Shell], Awaitable[None]]
) -> Shell:
    """Run a shell while `scene` plays the rest of the world, then stop it."""

    async def play() -> Shell:
        shell = Shell(endpoint, links, Clock())
        running = asyncio.create_task(shell.run())
        try:
            await until(lambda: bool(endpoint.ticks_s) or running.done())
            await scene(shell)
        finally:
            shell.request_stop()
            await running
        return shell

    return asyncio.run(play())


def port_of(shell: Shell, index: int = 0) -> int:
    link = shell.links[index]
    assert isinstance(link, UdpLink | TcpServerLink)
    return link.local_address[1]


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.setblocking(False)
        yield opened


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


# UDP


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
        f"udp 127.0.0.1:{port} is taken by another program; close it or choose another port"
    )


def test_the_links_opened_before_a_failing_one_are_closed() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        first = free.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        links: list[LinkSpec] = [
            UdpBind("127.0.0.1", first),
            TcpServer("127.0.0.1", taken.getsockname()[1]),
        ]
        with pytest.raises(LinkError, match="taken"):
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
    endpoint = EchoEndpoint()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        port = gone.getsockname()[1]

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

    monkeypatch.setattr("companion.io.udp.socket.socket", Full)
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
    """The first socket loses its interface, and the port is taken for a moment meanwhile."""
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

    monkeypatch.setattr("companion.io.udp.socket.socket", Interface)
    endpoint, address = EchoEndpoint(), peer.getsockname()
    spec = UdpBind("127.0.0.1", 0) if is_bound else UdpConnect(*address)

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


# A stall


class Dozing(EchoEndpoint):
    """Falls asleep once, in a tick, while the world goes on."""

    def __init__(self, meanwhile: Callable[[], None], sleep_s: float) -> None:
        super().__init__()
        self._meanwhile = meanwhile
        self._sleep_s = sleep_s
        self.heard_before_next_tick: int | None = None
        self.slept_until_s = 0.0

    def handle_timer(self, now_s: float) -> None:
        super().handle_timer(now_s)
        if len(self.ticks_s) == 5:
            self._meanwhile()
            time.sleep(self._sleep_s)
            self.slept_until_s = now_s + self._sleep_s
        elif len(self.ticks_s) == 6:
            self.heard_before_next_tick = len(self.marks)


def test_after_a_stall_the_past_is_taken_in_before_the_first_tick(peer: socket.socket) -> None:
    def meanwhile() -> None:
        for number in range(150):
            peer.sendto(heartbeat(number), ("127.0.0.1", port_of(shells[0])))

    endpoint, shells = Dozing(meanwhile, 0.3), list[Shell]()

    async def scene(shell: Shell) -> None:
        shells.append(shell)
        await until(lambda: endpoint.heard_before_next_tick is not None)

    shell = drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)
    assert endpoint.heard_before_next_tick == 150
    assert shell.timing.stalls == 1
    assert shell.timing.worst_late_s >= 0.28
    assert shell.timing.late >= 1


def test_after_a_stall_a_flood_puts_the_first_tick_off_for_a_moment_only() -> None:
    stopped = threading.Event()
    threads: list[threading.Thread] = []

    def flood() -> None:
        frame = heartbeat(7)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stopped.is_set():
                sender.sendto(frame, ("127.0.0.1", port_of(shells[0])))

    def meanwhile() -> None:
        threads.append(threading.Thread(target=flood))
        threads[0].start()

    endpoint, shells = Dozing(meanwhile, 0.3), list[Shell]()

    async def scene(shell: Shell) -> None:
        shells.append(shell)
        await until(lambda: endpoint.heard_before_next_tick is not None)
        stopped.set()
        threads[0].join()

    shell = drive(endpoint, [UdpBind("127.0.0.1", 0)], scene)
    assert endpoint.ticks_s[5] - endpoint.slept_until_s < 1.0
    assert shell.timing.stalls >= 1


def test_a_timer_in_time_is_not_counted_as_late() -> None:
    endpoint = EchoEndpoint()

    async def scene(_: Shell) -> None:
        await until(lambda: len(endpoint.ticks_s) > 10)

    shell = drive(endpoint, [], scene)
    assert shell.timing.fired == len(endpoint.ticks_s)
    assert shell.timing.late_total_s <= shell.timing.fired * shell.timing.worst_late_s


# Streams


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
    monkeypatch.setattr("companion.io.streams.BACKOFF_MIN_S", 0.02)
    endpoint = EchoEndpoint()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as reserved:
        reserved.bind(("127.0.0.1", 0))
        port = reserved.getsockname()[1]

    async def scene(shell: Shell) -> None:
        endpoint.say(Chunk(0, b"nobody is there"))
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
    monkeypatch.setattr("companion.io.streams.BACKOFF_MIN_S", 0.02)
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


# The end


def test_a_finished_endpoint_ends_the_run() -> None:
    endpoint = EchoEndpoint()
    wakeups: list[float] = []

    def on_wakeup(now_s: float) -> None:
        wakeups.append(now_s)
        endpoint.is_finished = len(wakeups) == 5

    Shell(endpoint, [], Clock(speed=10.0), on_wakeup).run_blocking()
    assert wakeups == sorted(wakeups)
    assert len(endpoint.ticks_s) == 5
    assert endpoint.stops_s == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_asks_the_endpoint_to_stop(number: signal.Signals) -> None:
    def own_handler(*_: object) -> None: ...

    before = signal.signal(number, own_handler)
    endpoint = EchoEndpoint()

    def on_wakeup(_: float) -> None:
        if len(endpoint.ticks_s) == 3 and not endpoint.stops_s:
            os.kill(os.getpid(), number)

    try:
        Shell(endpoint, [], Clock(), on_wakeup).run_blocking()
        assert signal.getsignal(number) is own_handler
    finally:
        signal.signal(number, before)
    assert len(endpoint.stops_s) == 1


@pytest.mark.parametrize(
    ("again_s", "least_s", "most_s"),
    [([0.05, 0.2], 1.4, 2.5), ([0.5], 0.4, 1.2), ([0.1, 0.5], 0.4, 1.2)],
    ids=["at once", "later", "both"],
)
def test_a_second_signal_ends_at_once_if_it_is_not_the_echo_of_the_first(
    again_s: list[float], least_s: float, most_s: float
) -> None:
    """timeout(1) signals the process, and then its group: within 0.3 s that is one wish."""
    endpoint = EchoEndpoint(finishes=False)
    signals_s = [0.0, *again_s]
    started_s = time.monotonic()

    def on_wakeup(_: float) -> None:
        if signals_s and time.monotonic() - started_s >= signals_s[0]:
            signals_s.pop(0)
            os.kill(os.getpid(), signal.SIGTERM)

    Shell(endpoint, [], Clock(), on_wakeup).run_blocking()
    assert least_s < time.monotonic() - started_s < most_s
    assert len(endpoint.stops_s) == 1


def test_an_endpoint_that_never_finishes_is_cut_off() -> None:
    endpoint = EchoEndpoint(finishes=False)
    shell = Shell(endpoint, [], Clock())
    shell.request_stop()
    started_s = time.monotonic()
    asyncio.run(shell.run())
    assert 1.4 < time.monotonic() - started_s < 2.5
    assert len(endpoint.stops_s) == 1
    assert len(endpoint.ticks_s) > 50


def test_a_shell_runs_and_stops_outside_the_main_thread() -> None:
    endpoint = EchoEndpoint()
    shell = Shell(endpoint, [UdpBind("127.0.0.1", 0)], Clock())
    thread = threading.Thread(target=lambda: asyncio.run(shell.run()))
    thread.start()
    while not endpoint.ticks_s:
        time.sleep(0.002)
    shell.request_stop()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert len(endpoint.stops_s) == 1
    shell.request_stop()


def test_a_bug_in_the_endpoint_ends_the_run_with_its_exception() -> None:
    class Broken(EchoEndpoint):
        def handle_timer(self, now_s: float) -> None:
            raise ZeroDivisionError(f"at {now_s >= 0}")

    with pytest.raises(ZeroDivisionError):
        Shell(Broken(), [UdpBind("127.0.0.1", 0)], Clock()).run_blocking()


def test_an_endpoint_that_is_always_late_does_not_take_the_processor() -> None:
    class Late(EchoEndpoint):
        def next_timer_s(self) -> float:
            return 0.0

    endpoint = Late()

    def on_wakeup(now_s: float) -> None:
        endpoint.is_finished = now_s > 0.2

    Shell(endpoint, [], Clock(), on_wakeup).run_blocking()
    assert len(endpoint.ticks_s) <= 250
