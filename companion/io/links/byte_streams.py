"""One bounded byte stream over a descriptor: TCP clients and serial ports.

Theory of operation. `ByteStream` owns a non-blocking descriptor: it reads a bounded batch per
wake-up, writes at once what the system takes, and queues a little (`SendQueue`), so that a slow
line costs telemetry but neither memory nor setpoints. The system would hide a second of a slow
serial line in its own buffer; no more is written there than the line sends in 0.1 s. The links
above only know how to obtain a descriptor; `ReopeningLink` does so repeatedly with a growing
pause, which is short again once a connection has lasted. A serial port must exist at the start, or
a wrong name would go unnoticed.

A TCP peer may disappear without closing. If it stops acknowledging, the connection ends
(TCP_USER_TIMEOUT; keep-alive probes test only an idle one). A peer that acknowledges but sends no
MAVLink frame, such as a browser or a router whose vehicle is gone, is closed after `SILENT_S`.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import logging
import os
import socket
import sys
import termios
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import serial

from companion.errors import LinkError
from companion.io.links.link import MAX_READS, NOTICE, Link, Received, SendQueue, logger
from companion.io.links.udp import resolve
from companion.mav.codec import CRC_EXTRA_BY_ID, FrameSplitter
from companion.mav.endpoint import Chunk

MAX_UNSENT_BYTES = 64 * 1024
"""Largest queue of a stream of unknown speed."""
QUEUE_S = 0.25
"""Longest queue of a serial line, in seconds of its speed."""
SYSTEM_QUEUE_S = 0.1
"""Largest queue of a serial line in the system's own buffer, in seconds of its speed."""
MIN_QUEUE_BYTES = 600
"""Smallest queue: room for two of the longest frames on the slowest of lines."""
LINE_CHECK_S = 0.02
READ_BYTES = 4096
BACKOFF_MIN_S = 0.5
BACKOFF_MAX_S = 5.0
CONNECT_TIMEOUT_S = 5.0
BITS_PER_BYTE = 10
"""Bits per byte on a serial line: eight, a start and a stop."""
STABLE_S = 10.0
"""Time for which a connection must have lasted before the pause to the next one is short again."""
SILENT_S = 10
"""Silence of a peer, ten HEARTBEATs of a second each, after which it is gone; it is counted in
checks, so that a suspended process does not mistake its own absence for the peer's."""
CHECK_PERIOD_S = 1.0
USER_TIMEOUT_MS = 5_000
"""Longest time for which sent data may stay unacknowledged."""
KEEPALIVE_IDLE_S, KEEPALIVE_INTERVAL_S, KEEPALIVE_PROBES = 5, 2, 3
"""Probes of an idle connection, by which a peer that vanished is noticed after eleven seconds."""


class Handle(Protocol):
    """Owner of a descriptor."""

    def close(self) -> None:
        """Close the descriptor."""


class ByteStream:
    """Non-blocking descriptor on the running loop; its `handle` stays open with it.

    `received` takes the pieces read in one wake-up; `lost` is called once, when the other end or
    the device is gone and the stream closed. `bytes_per_s` is the speed of a serial line.
    """

    def __init__(
        self,
        handle: Handle,
        fd: int,
        received: Callable[[list[bytes]], None],
        lost: Callable[[str], None],
        bytes_per_s: float | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._handle, self._fd = handle, fd
        self._received, self._lost = received, lost
        self._bytes_per_s = bytes_per_s
        limit = MAX_UNSENT_BYTES
        if bytes_per_s is not None:
            limit = max(MIN_QUEUE_BYTES, round(QUEUE_S * bytes_per_s))
        self._queue = SendQueue(limit)
        self._look: asyncio.TimerHandle | None = None
        self._is_open = True
        self._loop.add_reader(fd, self._read)

    @property
    def dropped(self) -> int:
        """Number of chunks dropped because the line is too slow."""
        return self._queue.dropped

    def write(self, data: bytes, *, is_droppable: bool = False) -> bool:
        """Send now or later; return False if too much is waiting already and `data` was dropped."""
        if not self._is_open:
            return False
        was_empty = not self._queue
        is_taken = self._queue.add(data, is_droppable=is_droppable)
        if was_empty and is_taken:
            self._flush()
        return is_taken

    def close(self) -> None:
        """Close without calling `lost`."""
        if not self._is_open:
            return
        self._is_open = False
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        if self._look is not None:
            self._look.cancel()
        self._handle.close()

    def _flush(self) -> None:
        self._look = None
        try:
            room = self._room()
            if room > 0:
                self._queue.consume(os.write(self._fd, self._queue.head()[:room]))
        except (BlockingIOError, InterruptedError):
            room = MAX_UNSENT_BYTES
        except OSError as error:
            self._end(error.strerror or str(error))
            return
        self._loop.remove_writer(self._fd)
        if not self._queue:
            return
        if self._bytes_per_s is None or room >= len(self._queue):
            self._loop.add_writer(self._fd, self._flush)
        else:
            self._look = self._loop.call_later(LINE_CHECK_S, self._flush)

    def _room(self) -> int:
        if self._bytes_per_s is None:
            return MAX_UNSENT_BYTES
        answer = fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(4))
        allowed = max(MIN_QUEUE_BYTES // 2, round(SYSTEM_QUEUE_S * self._bytes_per_s))
        return max(0, allowed - int.from_bytes(answer, sys.byteorder))

    def _read(self) -> None:
        pieces: list[bytes] = []
        reason: str | None = None
        for _ in range(MAX_READS):
            try:
                data = os.read(self._fd, READ_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                reason = error.strerror or str(error)
                break
            if not data:
                reason = "closed by the other end"
                break
            pieces.append(data)
        if pieces:
            self._received(pieces)
        if reason is not None:
            self._end(reason)

    def _end(self, reason: str) -> None:
        if self._is_open:
            self.close()
            self._lost(reason)


class StreamLink(Link):
    """Link over at most one byte stream at a time."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        super().__init__(name, index, received)
        self._stream: ByteStream | None = None
        self._is_closed = False
        self._bytes_per_s: float | None = None
        self._asking: asyncio.TimerHandle | None = None
        self._looking: asyncio.TimerHandle | None = None
        self._silent_looks = 0

    @property
    def is_open(self) -> bool:
        """Return True if it is connected or trying to connect."""
        return not self._is_closed

    @property
    def is_connected(self) -> bool:
        """Return True if there is a peer at the other end, to the system's knowledge."""
        return self._stream is not None

    def send(self, chunk: Chunk) -> None:
        """Send to the connected peer; dropped and counted if there is none or the line is full."""
        stream = self._stream
        if stream is None:
            self.counters.dropped += 1
            return
        dropped = stream.dropped
        self.counters.sent += stream.write(chunk.data, is_droppable=chunk.is_droppable)
        self.counters.dropped += stream.dropped - dropped

    def close(self) -> None:
        """Close the stream."""
        self._is_closed = True
        self._cancel_timers()
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _use_stream(self, handle: Handle, fd: int) -> None:
        logger.log(NOTICE if self.counters.reconnects else logging.INFO, "%s: connected", self.name)
        rate = self._bytes_per_s
        self._stream = ByteStream(handle, fd, self._take, self._forget, rate)
        if self.greeting:
            self._stream.write(self.greeting)
        if self.request:
            self._ask()
        if self.expects_mavlink and isinstance(handle, socket.socket):
            self._silent_looks = 0
            self._look_again()

    def _look_again(self) -> None:
        self._looking = asyncio.get_running_loop().call_later(CHECK_PERIOD_S, self._look_at_peer)

    def _look_at_peer(self) -> None:
        """Close a connection that brought no MAVLink frame in `SILENT_S`."""
        self._silent_looks += 1
        if self._silent_looks < SILENT_S or self._stream is None:
            self._look_again()
            return
        self._stream.close()
        self._forget(f"no MAVLink for {SILENT_S} s")

    def _ask(self) -> None:
        """Send the query now and again after its period; skipped while the line is full."""
        if self._stream is not None:
            self._stream.write(self.request, is_droppable=True)
        loop = asyncio.get_running_loop()
        self._asking = loop.call_later(self.request_period_s, self._ask)

    def _cancel_timers(self) -> None:
        for timer in (self._asking, self._looking):
            if timer is not None:
                timer.cancel()
        self._asking = self._looking = None

    def _take(self, pieces: list[bytes]) -> None:
        self.counters.received += len(pieces)
        if self._silent_looks and self._looking is not None and has_frame(pieces):
            self._silent_looks = 0
        self._received([Chunk(self.index, piece, is_datagram=False) for piece in pieces])

    def _forget(self, reason: str) -> None:
        self._stream = None
        self._cancel_timers()
        if reason != "closed by the other end":
            self.counters.send_errors += 1
            self.counters.last_error = reason
        logger.warning("%s: lost (%s)", self.name, reason)
        if self.signals_loss:
            self._received([Chunk(self.index, b"", is_datagram=False)])


class ReopeningLink(StreamLink):
    """Link that reopens its stream whenever it is lost, after pauses growing from 0.5 s to 5 s."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        super().__init__(name, index, received)
        self._task: asyncio.Task[None] | None = None
        self._pause_s = BACKOFF_MIN_S
        self._connected_s = 0.0

    @abstractmethod
    async def _connect(self) -> tuple[Handle, int]:
        """Return a handle and its non-blocking descriptor; raises the `OSError` of opening one."""

    async def open(self) -> None:
        """Begin to connect; a peer that is not there yet is not an error."""
        self._start()

    def _start(self) -> None:
        if not self._is_closed:
            self._task = asyncio.get_running_loop().create_task(self._keep_trying())

    async def _keep_trying(self) -> None:
        while not self._is_closed:
            try:
                handle, fd = await self._connect()
            except (OSError, ValueError, termios.error, LinkError) as error:
                if self._pause_s == BACKOFF_MIN_S and self.counters.reconnects == 0:
                    logger.warning("%s: not available yet (%s); retrying", self.name, error)
                await asyncio.sleep(self._next_pause_s())
            else:
                self._connected_s = asyncio.get_running_loop().time()
                self._use_stream(handle, fd)
                return

    def _next_pause_s(self) -> float:
        """Return how long to wait now; the next pause is twice as long."""
        pause_s = max(self._pause_s, BACKOFF_MIN_S)
        self._pause_s = min(2.0 * pause_s, BACKOFF_MAX_S)
        return pause_s

    def _forget(self, reason: str) -> None:
        super()._forget(reason)
        if not self._is_closed:
            self.counters.reconnects += 1
            loop = asyncio.get_running_loop()
            if loop.time() - self._connected_s >= STABLE_S:
                self._pause_s = BACKOFF_MIN_S
            loop.call_later(self._next_pause_s(), self._start)

    def close(self) -> None:
        """Close, and stop trying."""
        super().close()
        if self._task is not None:
            self._task.cancel()
            self._task = None


class TcpClientLink(ReopeningLink):
    """TCP connection that this side opens."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(f"tcp {host}:{port}", index, received)
        self._host, self._port = host, port

    async def _connect(self) -> tuple[socket.socket, int]:
        address = await resolve(self.name, self._host, self._port)
        new = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            new.setblocking(False)
            tune(new)
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await asyncio.get_running_loop().sock_connect(new, address)
        except BaseException:
            new.close()
            raise
        return new, new.fileno()


class SerialLink(ReopeningLink):
    """Serial port; reopened when its adapter is plugged in again."""

    def __init__(self, device: str, baud: int, index: int, received: Received) -> None:
        super().__init__(f"serial {device}", index, received)
        self._device, self._baud = device, baud
        self._bytes_per_s = baud / BITS_PER_BYTE

    async def open(self) -> None:
        """Open the port; only a service waits for one that is missing at the start."""
        try:
            self._use_stream(*await self._connect())
        except (OSError, ValueError, termios.error) as error:
            if "NOTIFY_SOCKET" not in os.environ or Path(self._device).exists():
                raise LinkError(f"{self.name}: {self._problem(error)}") from error
            self._start()

    def _problem(self, error: Exception) -> str:
        path = Path(self._device)
        if not path.exists():
            return "no such device; is it plugged in, and the name right?"
        if not path.is_char_device() or os.strerror(errno.ENOTTY) in str(error):
            return "is not a serial port"
        if not os.access(path, os.R_OK | os.W_OK):
            return "not allowed; join the group that owns it (dialout, for example)"
        return f"cannot be opened ({error})"

    async def _connect(self) -> tuple[serial.Serial, int]:
        port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0, exclusive=True)
        fd = port.fileno()
        os.set_blocking(fd, False)
        # pyserial asks for reads that return nothing when nothing is there; with a minimum of one
        # byte that is EAGAIN instead, and nothing means that the device is gone.
        settings = termios.tcgetattr(fd)
        settings[6][termios.VMIN] = 1
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        return port, fd


def tune(stream: socket.socket) -> None:
    """Disable Nagle's algorithm, and detect peers that disappear without closing."""
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", KEEPALIVE_IDLE_S),
        ("TCP_KEEPINTVL", KEEPALIVE_INTERVAL_S),
        ("TCP_KEEPCNT", KEEPALIVE_PROBES),
        ("TCP_USER_TIMEOUT", USER_TIMEOUT_MS),
    ):
        if hasattr(socket, option):  # macOS lacks some of them
            stream.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def has_frame(pieces: list[bytes]) -> bool:
    """Return True if one of the pieces contains a whole MAVLink frame of the dialect."""
    splitter = FrameSplitter(CRC_EXTRA_BY_ID)
    return any(splitter.split(piece, is_datagram=True) for piece in pieces)
