"""TCP clients and serial links: one bounded byte stream over a descriptor, reopened when lost.

Theory of operation. `ByteStream` owns a non-blocking descriptor: it reads a bounded batch per
wake-up, writes at once what the system takes, keeps at most 64 kB for later and refuses whole
chunks beyond that, so that a slow line costs telemetry and not memory. The links above it only
know how to obtain a descriptor. `ReopeningLink` does so again and again with a growing pause; a
loss is logged once, and so is a first connection that fails. A serial port must be there at the
start, because a wrong name would otherwise never be noticed.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import termios
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import serial

from companion.errors import LinkError
from companion.io.link_base import MAX_READS, Link, Received, logger
from companion.io.udp import resolve
from companion.mav.endpoint import Chunk

MAX_UNSENT_BYTES = 64 * 1024
READ_BYTES = 4096
BACKOFF_MIN_S = 0.5
BACKOFF_MAX_S = 5.0
CONNECT_TIMEOUT_S = 5.0
KEEPALIVE_IDLE_S, KEEPALIVE_INTERVAL_S, KEEPALIVE_PROBES = 5, 2, 3
"""A peer that vanished without a word is noticed after about eleven seconds."""


class Handle(Protocol):
    """Whatever owns a descriptor."""

    def close(self) -> None:
        """Let go of it."""


class ByteStream:
    """A non-blocking descriptor on the running loop.

    Args:
        handle: Anything with a `close`, kept open while the stream lives.
        fd: Its descriptor, already non-blocking.
        received: Takes the pieces read in one wake-up.
        lost: Called once when the other end or the device is gone; the stream is closed then.
    """

    def __init__(
        self,
        handle: Handle,
        fd: int,
        received: Callable[[list[bytes]], None],
        lost: Callable[[str], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._handle, self._fd = handle, fd
        self._received, self._lost = received, lost
        self._unsent = bytearray()
        self._is_open = True
        self._loop.add_reader(fd, self._read)

    def write(self, data: bytes) -> bool:
        """Send now or later; False if too much is waiting already and `data` was dropped."""
        if not self._is_open or len(self._unsent) + len(data) > MAX_UNSENT_BYTES:
            return False
        was_empty = not self._unsent
        self._unsent += data
        if was_empty:
            self._flush()
        return True

    def close(self) -> None:
        """Close without telling `lost`."""
        if not self._is_open:
            return
        self._is_open = False
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._handle.close()

    def _flush(self) -> None:
        try:
            written = os.write(self._fd, self._unsent)
        except (BlockingIOError, InterruptedError):
            written = 0
        except OSError as error:
            self._end(error.strerror or str(error))
            return
        del self._unsent[:written]
        if self._unsent:
            self._loop.add_writer(self._fd, self._flush)
        else:
            self._loop.remove_writer(self._fd)

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
    """A link over at most one byte stream at a time."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        super().__init__(name, index, received)
        self._stream: ByteStream | None = None
        self._is_closed = False

    @property
    def is_connected(self) -> bool:
        """Whether somebody is at the other end, as far as the system knows."""
        return self._stream is not None

    def send(self, chunk: Chunk) -> None:
        """Send to whoever is connected; dropped and counted if nobody is or the line is full."""
        if self._stream is not None and self._stream.write(chunk.data):
            self.counters.sent += 1
        else:
            self.counters.dropped += 1

    def close(self) -> None:
        """Close the stream."""
        self._is_closed = True
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _connected(self, handle: Handle, fd: int) -> None:
        logger.info("%s: connected", self.name)
        self._stream = ByteStream(handle, fd, self._take, self._forget)

    def _take(self, pieces: list[bytes]) -> None:
        self.counters.received += len(pieces)
        self._received([Chunk(self.index, piece, is_datagram=False) for piece in pieces])

    def _forget(self, reason: str) -> None:
        self._stream = None
        self.counters.send_errors += reason != "closed by the other end"
        logger.warning("%s: lost (%s)", self.name, reason)


class ReopeningLink(StreamLink):
    """A stream that is opened again, after 0.5 s at first and 5 s at most, whenever it is lost."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        super().__init__(name, index, received)
        self._task: asyncio.Task[None] | None = None

    @abstractmethod
    async def _connect(self) -> tuple[Handle, int]:
        """A handle and its non-blocking descriptor; raises whatever opening one raises."""

    async def open(self) -> None:
        """Begin to connect; a peer that is not there yet is not an error."""
        self._start()

    def _start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._keep_trying())

    async def _keep_trying(self) -> None:
        pause_s = BACKOFF_MIN_S
        while not self._is_closed:
            try:
                handle, fd = await self._connect()
            except (OSError, ValueError, termios.error, LinkError) as error:
                if pause_s == BACKOFF_MIN_S and self.counters.reconnects == 0:
                    logger.warning("%s: not there yet (%s); trying on", self.name, error)
                await asyncio.sleep(pause_s)
                pause_s = min(2.0 * pause_s, BACKOFF_MAX_S)
            else:
                self._connected(handle, fd)
                return

    def _forget(self, reason: str) -> None:
        super()._forget(reason)
        if not self._is_closed:
            self.counters.reconnects += 1
            loop = asyncio.get_running_loop()
            loop.call_later(BACKOFF_MIN_S, self._restart)

    def _restart(self) -> None:
        if not self._is_closed:
            self._start()

    def close(self) -> None:
        """Close, and stop trying."""
        super().close()
        if self._task is not None:
            self._task.cancel()
            self._task = None


class TcpClientLink(ReopeningLink):
    """A TCP connection that we open."""

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
    """A serial port; reopened when its adapter is plugged in again."""

    def __init__(self, device: str, baud: int, index: int, received: Received) -> None:
        super().__init__(f"serial {device}", index, received)
        self._device, self._baud = device, baud

    async def open(self) -> None:
        """Open the port; a loss later is mended, a port that is not there at the start is not.

        Raises:
            LinkError: There is no such device, it is no serial port, or it is not ours to open.
        """
        try:
            self._connected(*await self._connect())
        except (OSError, ValueError, termios.error) as error:
            raise LinkError(f"{self.name}: {self._problem(error)}") from error

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
    """Small frames at once, and a silent death noticed."""
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", KEEPALIVE_IDLE_S),
        ("TCP_KEEPINTVL", KEEPALIVE_INTERVAL_S),
        ("TCP_KEEPCNT", KEEPALIVE_PROBES),
    ):
        if hasattr(socket, option):  # macOS names one of them differently
            stream.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
