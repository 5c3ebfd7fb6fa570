"""The interface of every link, and the queue in front of a slow one.

Theory of operation of `SendQueue`: bounded, newest first to survive, whole frames only. On a line
that cannot carry everything, late data is worthless: a setpoint of a second ago is worse than
none. So the queue is short. Droppable chunks (texts, stream requests) are queued only while little
waits; everything else always finds room, first at the expense of droppable chunks and then of the
oldest. A frame that is partly written is finished, because the receiver would lose the next one
with it.
"""

from __future__ import annotations

import errno
import logging
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from companion.mav.endpoint import Address, Chunk

logger = logging.getLogger("companion.io")
NOTICE = logging.INFO + 5
"""Log level of changes that are not faults; `--quiet` shows them, too."""

Received = Callable[[list[Chunk]], None]
"""Called once per wake-up of a link with the bytes read."""

MAX_READS = 64
"""Reads per wake-up, so that a flood on one link cannot keep the timer waiting."""


@dataclass(slots=True)
class LinkCounters:
    """Counters of a link since it was opened."""

    received: int = 0
    """Number of datagrams, or of chunks of a stream."""
    sent: int = 0
    send_errors: int = 0
    """Chunks that the system refused (ENOBUFS, EAGAIN, ECONNREFUSED, network down)."""
    last_error: str = ""
    receive_errors: int = 0
    dropped: int = 0
    """Chunks not sent because no peer was connected or too much was waiting."""
    reconnects: int = 0


class Link(ABC):
    """One open (or reopening) connection; its name is for messages: `udp 127.0.0.1:14550`."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        self.name = name
        self.index = index
        self.counters = LinkCounters()
        self.greeting = b""
        """Sent first on every new connection."""
        self.request, self.request_period_s = b"", 1.0
        """Query, and its period, over a byte stream to a radio that only answers."""
        self.signals_loss = False
        """True if an empty piece of the stream means that its other end is gone."""
        self.expects_mavlink = False
        """True: a TCP connection without a MAVLink frame for `SILENT_S` is closed as dead."""
        self._received = received
        self._is_lost = False

    @property
    def stamped_descriptor(self) -> int | None:
        """Descriptor with kernel receive timestamps, whose data may wait; None: no such one."""
        return None

    @abstractmethod
    async def open(self) -> None:
        """Start listening or connecting; `LinkError`: this configuration can never work."""

    @property
    def is_open(self) -> bool:
        """Return True while it listens, is connected, or retries; a peer need not be there."""
        return True

    def send(self, chunk: Chunk) -> None:
        """Send now or count the failure; never raises, never waits. This base class only counts."""
        del chunk
        self.counters.dropped += 1

    def hear_only(self, peer: Address | None) -> None:
        """Let the kernel drop datagrams of other peers than `peer`, if it can; None: of none."""
        del peer  # only UDP receives from unknown peers

    @abstractmethod
    def close(self) -> None:
        """Release everything; a second call does nothing."""

    def _note_back(self) -> None:
        """Note that a lost connection is back."""
        if self._is_lost:
            self._is_lost = False
            self.counters.reconnects += 1
            logger.log(NOTICE, "%s: available again", self.name)


def bound_address(bound: socket.socket | None) -> Address:
    """Return host and port of an open socket; `("", 0)` without one."""
    if bound is None:
        return ("", 0)
    host, port = bound.getsockname()[:2]
    return (str(host), int(port))


def bind_problem(kind: str, host: str, port: int, error: OSError) -> str:
    """Return one line about a port that cannot be bound: the cause and the remedy."""
    where = f"{kind} {host}:{port}"
    if error.errno == errno.EADDRINUSE:
        hint = " (QGroundControl listens there too)" if port == 14550 else ""
        return f"{where} is in use by another program{hint}; close it or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{where}: no interface of this machine has that address; use 0.0.0.0 or its own"
    if error.errno == errno.EACCES:
        return f"{where} cannot be opened without privileges; choose a port above 1023"
    return f"{where} cannot be opened ({error.strerror or error}); check host and port"


SPARE_SHARE = 0.25
"""Share of the limit above which data that can be spared is no longer taken."""


class SendQueue:
    """Queue of chunks in the order of sending."""

    def __init__(self, limit_bytes: int) -> None:
        self.dropped = 0
        """Chunks that were refused, or gave way to newer ones."""
        self._limit = limit_bytes
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._written = 0

    def __len__(self) -> int:
        """Return the number of waiting bytes."""
        return self._bytes - self._written

    def add(self, data: bytes, *, is_droppable: bool = False) -> bool:
        """Queue a chunk; return True if it was accepted."""
        if is_droppable and len(self) > SPARE_SHARE * self._limit:
            self.dropped += 1
            return False
        while len(self) + len(data) > self._limit:
            if len(data) > self._limit or not self._drop_one():
                self.dropped += 1
                return False
        self._waiting.append((data, is_droppable))
        self._bytes += len(data)
        return True

    def head(self) -> bytes:
        """Return what to write next: the rest of the first chunk, and all that is behind it."""
        return b"".join(data for data, _ in self._waiting)[self._written :]

    def consume(self, count: int) -> None:
        """Remove this number of written bytes of `head`."""
        self._written += count
        while self._waiting and self._written >= len(self._waiting[0][0]):
            data, _ = self._waiting.popleft()
            self._written -= len(data)
            self._bytes -= len(data)

    def _drop_one(self) -> bool:
        """Drop the oldest droppable chunk, or else the oldest; return False if there was none."""
        begun = 1 if self._written else 0
        indices = range(begun, len(self._waiting))
        spared = (index for index in indices if self._waiting[index][1])
        victim = next(spared, begun)
        if victim >= len(self._waiting):
            return False
        self._bytes -= len(self._waiting[victim][0])
        del self._waiting[victim]
        self.dropped += 1
        return True
