"""UDP links over plain non-blocking sockets, and a filter of senders in the kernel.

asyncio's datagram transport queues without bound when the system refuses and reads one datagram
per loop; here a refusal is counted at once and a wake-up reads a bounded batch. Sockets are bound
without SO_REUSEADDR and SO_REUSEPORT: with them a second listener on a port starts without an
error and one of the two silently gets nothing.

A socket can outlive the interface or the address that it was opened on, and then fails permanently.
It is closed and reopened, with growing pauses, until it works.

In a flood of unknown peers the socket's buffer overflows between two reads, and the autopilot's
frames are lost with the rest. So on Linux a classic BPF program on the socket, which needs no
privilege, drops datagrams by source address and port as they arrive.

There the kernel also stamps each datagram with its arrival, so that reading them later does not
make them younger. Its clock may be set in between: a stamp counts only between the last look that
found nothing more and now.

Source: Linux kernel documentation, "Linux Socket Filtering" and "Timestamping".
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import ipaddress
import socket
import struct
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from companion.errors import LinkError
from companion.io.links.link import MAX_READS, Link, Received, bind_problem, bound_address
from companion.mav.endpoint import Address, Chunk

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
_LOAD_HALF, _LOAD_WORD, _JUMP_EQUAL, _RETURN = 0x28, 0x20, 0x15, 0x06
_NETWORK_HEADER = 0xFFF00000
"""Offset of the IP header; other offsets count from the UDP header."""
_SOURCE_ADDRESS, _SOURCE_PORT = 12, 0
_WHOLE, _NOTHING = 0xFFFFFFFF, 0
_SO_TIMESTAMPNS_NEW = 64
"""Option, and type of the stamp: seconds and nanoseconds of 64 bits each on every machine."""
_STAMP = struct.Struct("=qq")


def attach_source_filter(sock: socket.socket, peer: Address) -> bool:
    """Drop every datagram that is not from `peer`; return False if the system cannot."""
    address = int.from_bytes(socket.inet_aton(peer[0]), "big")
    steps = (
        (_LOAD_HALF, 0, 0, _SOURCE_PORT),
        (_JUMP_EQUAL, 0, 3, peer[1]),
        (_LOAD_WORD, 0, 0, _NETWORK_HEADER + _SOURCE_ADDRESS),
        (_JUMP_EQUAL, 0, 1, address),
        (_RETURN, 0, 0, _WHOLE),
        (_RETURN, 0, 0, _NOTHING),
    )
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    value = struct.pack("HL", len(steps), ctypes.addressof(program))
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, value)
    except OSError:
        return False
    return True


def detach_source_filter(sock: socket.socket) -> None:
    """Remove the filter."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
    except OSError:
        return  # there was none


def _ask_for_stamps(sock: socket.socket) -> bool:
    """Let the kernel time-stamp arrivals; return False if it cannot, as before Linux 5.1."""
    if sys.platform != "linux":
        return False
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS_NEW, 1)
    except OSError:
        return False
    return True


MAX_DATAGRAM = 65_535
_ROOM_FOR_STAMP = socket.CMSG_SPACE(_STAMP.size)
RECEIVE_BUFFER = 1 << 20
"""Socket receive buffer in bytes, so that a burst is not lost between two reads."""
GONE = frozenset(
    {
        errno.EADDRNOTAVAIL,
        errno.EBADF,
        errno.EINVAL,
        errno.ENETDOWN,
        errno.ENETRESET,
        errno.ENETUNREACH,
        errno.ENODEV,
    }
)
"""Errors of a socket that may never work again."""
FIRST_REOPEN_S, LAST_REOPEN_S = 0.25, 4.0
BUSY_S = 1.0
"""Time after a wake-up that left data unread for which nothing waits, because the socket's buffer
would overflow: in a flood one wait in twenty control ticks is lost at the most."""
MAX_PEERS = 16
"""Senders that a fan-out link remembers; telemetry must not grow with every unknown peer."""


class UdpLink(Link):
    """Bound socket that answers the peers its chunks name."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(f"udp {host}:{port}", index, received)
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self._sole_peer: Address | None = None
        self._is_stamped = False
        self._busy_until_s = 0.0
        """Monotonic time until which arrivals are read at once."""
        self._earliest_s = 0.0
        """Earliest monotonic arrival time of anything read from now on."""
        self._address: Address = ("", 0)
        """Address that is bound, or connected to."""
        self._reopening: asyncio.TimerHandle | None = None
        self._reopen_s = FIRST_REOPEN_S

    @property
    def local_address(self) -> Address:
        """Host and port of the open socket; `("", 0)` while closed."""
        return bound_address(self._socket)

    @property
    def is_open(self) -> bool:
        """Return True while the socket is open or being reopened."""
        return self._socket is not None or self._reopening is not None

    @property
    def stamped_descriptor(self) -> int | None:
        """Descriptor of the socket; None while closed, flooded or without stamps."""
        may_wait = self._is_stamped and time.monotonic() >= self._busy_until_s
        return self._socket.fileno() if self._socket is not None and may_wait else None

    async def open(self) -> None:
        """Bind, or fix the remote."""
        self._address = await resolve(self.name, self._host, self._port)
        try:
            self._start()
        except OSError as error:
            raise LinkError(self._problem(error)) from error

    def _problem(self, error: OSError) -> str:
        return bind_problem("udp", self._host, self._port, error)

    def _start(self) -> None:
        """Open the socket; raises an `OSError` if it cannot be bound to its address."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)  # as far as allowed
        try:
            self._attach(opened)
        except OSError:
            opened.close()
            raise
        self._socket = opened
        self._is_stamped = _ask_for_stamps(opened)
        self._earliest_s = time.monotonic()
        asyncio.get_running_loop().add_reader(opened, self._read)

    def _attach(self, opened: socket.socket) -> None:
        opened.bind(self._address)
        self._address = bound_address(opened)  # the same port when it is opened again

    def _handle_refusal(self, error: OSError) -> None:
        """Count a refused send; a socket whose network is gone is reopened after a pause."""
        if error.errno in GONE and self._reopening is None:
            self._reopen_later()

    def _reopen_later(self) -> None:
        self._reopening = asyncio.get_running_loop().call_later(self._reopen_s, self._reopen)
        self._reopen_s = min(2.0 * self._reopen_s, LAST_REOPEN_S)

    def _reopen(self) -> None:
        self._reopening = None
        self._drop()
        try:
            self._start()
        except OSError as error:
            self.counters.last_error = error.strerror or str(error)
            self._reopen_later()
        else:
            self.counters.reconnects += 1

    def _drop(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
        self._socket = self._sole_peer = None

    def _read(self) -> None:
        chunks: list[Chunk] = []
        last: Address | None = None
        now_s, now_unix_s = time.monotonic(), time.time()
        for _ in range(MAX_READS):
            if self._socket is None:
                break
            try:
                data, notes, _, peer = self._socket.recvmsg(MAX_DATAGRAM, _ROOM_FOR_STAMP)
            except (BlockingIOError, InterruptedError):
                self._earliest_s = now_s
                break
            except OSError as error:  # ECONNREFUSED: no socket received an earlier datagram
                self.counters.receive_errors += 1
                self._handle_refusal(error)
                continue
            arrived_s = now_s
            if notes:
                seconds, nanoseconds = _STAMP.unpack(notes[0][2])
                arrived_s -= now_unix_s - seconds - 1e-9 * nanoseconds
            self._earliest_s = arrived_s = max(self._earliest_s, min(arrived_s, now_s))
            chunks.append(Chunk(self.index, data, peer, arrived_s=arrived_s))
            if peer != last:
                last = peer
                self._note_peer(peer)
        else:
            self._busy_until_s = now_s + BUSY_S
        self.counters.received += len(chunks)
        if chunks:
            self._received(chunks)

    def _note_peer(self, peer: Address) -> None:
        """Note the sender of a datagram."""

    def hear_only(self, peer: Address | None) -> None:
        """Let the kernel drop datagrams of other peers; called often, it acts on changes only."""
        if peer == self._sole_peer or self._socket is None:
            return
        self._sole_peer = peer
        if peer is None:
            detach_source_filter(self._socket)
        else:
            attach_source_filter(self._socket, peer)

    def send(self, chunk: Chunk) -> None:
        """Send to the chunk's peer; a chunk without one is dropped and counted."""
        if chunk.peer is None:
            self.counters.dropped += 1
            return
        self._send_to(chunk.data, chunk.peer)

    def _send_to(self, data: bytes, peer: Address | None) -> None:
        if self._socket is None:
            self.counters.dropped += 1
            return
        try:
            if peer is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, peer)
        except OSError as error:
            self.counters.send_errors += 1
            self.counters.last_error = error.strerror or str(error)
            self._handle_refusal(error)
        else:
            self.counters.sent += 1
            self._reopen_s = FIRST_REOPEN_S

    def close(self) -> None:
        """Close the socket for good."""
        if self._reopening is not None:
            self._reopening.cancel()
            self._reopening = None
        if self._socket is not None:
            self._drop()


class UdpFanOutLink(UdpLink):
    """Bound socket; a chunk without a peer goes to fixed remotes and to the last 16 senders."""

    def __init__(
        self, host: str, port: int, remotes: Sequence[Address], index: int, received: Received
    ) -> None:
        super().__init__(host, port, index, received)
        self._given_remotes = tuple(remotes)
        self._remotes: tuple[Address, ...] = ()
        self._peers: dict[Address, None] = {}

    async def open(self) -> None:
        """Bind, and look up the remotes."""
        self._remotes = tuple([await resolve(self.name, *remote) for remote in self._given_remotes])
        await super().open()

    def _note_peer(self, peer: Address) -> None:
        if peer in self._remotes:
            return
        self._peers.pop(peer, None)
        self._peers[peer] = None
        if len(self._peers) > MAX_PEERS:
            del self._peers[next(iter(self._peers))]

    def send(self, chunk: Chunk) -> None:
        """Send to the chunk's peer, or to all remotes and senders if it names none."""
        if chunk.peer is not None:
            self._send_to(chunk.data, chunk.peer)
            return
        for peer in (*self._remotes, *self._peers):
            if peer not in chunk.except_peers:
                self._send_to(chunk.data, peer)


class UdpConnectLink(UdpLink):
    """Connected socket on a free port that sends first; the system drops other senders."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(host, port, index, received)
        self.name = f"udpout {host}:{port}"

    def _problem(self, error: OSError) -> str:
        return f"{self.name}: no route ({error.strerror}); check host"

    def _attach(self, opened: socket.socket) -> None:
        opened.connect(self._address)

    async def open(self) -> None:
        """Connect, and send a first datagram."""
        await super().open()
        if self.greeting:
            self._send_to(self.greeting, None)

    def send(self, chunk: Chunk) -> None:
        """Send to the remote, the only peer, whichever the chunk names."""
        self._send_to(chunk.data, None)


async def resolve(name: str, host: str, port: int) -> Address:
    """Return the IPv4 address of a host; a `LinkError` beginning with `name` if it is unknown.

    Names are looked up in a daemon thread and not in the loop's executor: the loop waits for its
    executor when it ends, and a slow name server must not hold up an exit.
    """
    try:
        return (str(ipaddress.IPv4Address(host)), port)
    except ValueError:
        pass
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[str | None] = loop.create_future()

    def settle(address: str | None) -> None:
        if not answer.done():
            answer.set_result(address)

    def look_up() -> None:
        try:
            address = socket.gethostbyname(host)
        except (OSError, UnicodeError):
            address = None
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(settle, address)

    threading.Thread(target=look_up, name="resolve", daemon=True).start()
    found = await answer
    if found is None:
        raise LinkError(f"{name}: the host `{host}` is unknown; check its spelling")
    return (found, port)
