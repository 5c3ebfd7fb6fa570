"""What every link can do, whatever it runs over, and the queue in front of a slow one.

Theory of operation of `SendQueue`: bounded, newest first to survive, whole frames only. On a line
that cannot take all of it, what is late is worthless: a setpoint of a second ago is worse than
none. So the queue is short. What can be spared (texts, questions for streams) is let in only while
little waits; anything else always finds room, at the expense first of what can be spared and then
of the oldest. A frame that is written in part is finished, because the other side would lose the
next one with it.
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
"""What is news although nothing is wrong: `--quiet` shows it, too."""

Received = Callable[[list[Chunk]], None]
"""Called once per wake-up of a link with all that it read."""

MAX_READS = 64
"""Reads per wake-up, so that a flood on one link cannot keep the timer waiting."""


@dataclass(slots=True)
class LinkCounters:
    """What a link did since it was opened."""

    received: int = 0
    """Datagrams, or pieces of a stream."""
    sent: int = 0
    send_errors: int = 0
    """Chunks that the system refused (ENOBUFS, EAGAIN, ECONNREFUSED, network down)."""
    last_error: str = ""
    receive_errors: int = 0
    dropped: int = 0
    """Chunks not sent because nobody was connected or too much was waiting."""
    reconnects: int = 0


class Link(ABC):
    """One open (or re-opening) connection; its name is for messages: `udp 127.0.0.1:14550`."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        self.name = name
        self.index = index
        self.counters = LinkCounters()
        self.greeting = b""
        """Sent to whoever is connected, each time, before anything else."""
        self.request, self.request_period_s = b"", 1.0
        """Sent as often over a byte stream, to a radio that only answers."""
        self.tells_loss = False
        """Whether an empty piece of a stream says that its other end is gone."""
        self.expects_mavlink = False
        """Close a TCP connection that brings no MAVLink frame for `SILENT_S`: its peer is dead, or
        none that sends HEARTBEATs."""
        self._received = received
        self._is_lost = False

    @abstractmethod
    async def open(self) -> None:
        """Start listening or connecting; a `LinkError` if it can never work as configured."""

    @property
    def is_open(self) -> bool:
        """Whether it listens, is connected, or tries to be; not whether anybody is there."""
        return True

    def send(self, chunk: Chunk) -> None:
        """Send now or count why not; never raises and never waits. Here nobody hears it."""
        del chunk
        self.counters.dropped += 1

    def hear_only(self, peer: Address | None) -> None:
        """Let the system drop what others than `peer` send, if it can; None: hear everybody."""
        del peer  # only UDP hears unknown peers

    @abstractmethod
    def close(self) -> None:
        """Release everything; a second call does nothing."""

    def _note_back(self) -> None:
        """What was lost, if anything was, is there again."""
        if self._is_lost:
            self._is_lost = False
            self.counters.reconnects += 1
            logger.log(NOTICE, "%s: is there again", self.name)


def bound_address(bound: socket.socket | None) -> Address:
    """Host and port that an open socket has; `("", 0)` without one."""
    if bound is None:
        return ("", 0)
    host, port = bound.getsockname()[:2]
    return (str(host), int(port))


def bind_problem(kind: str, host: str, port: int, error: OSError) -> str:
    """One line for a port that cannot be bound: what is wrong and what to do."""
    where = f"{kind} {host}:{port}"
    if error.errno == errno.EADDRINUSE:
        hint = " (QGroundControl listens there too)" if port == 14550 else ""
        return f"{where} is taken by another program{hint}; close it or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{where}: no interface of this machine has that address; use 0.0.0.0 or its own"
    if error.errno == errno.EACCES:
        return f"{where} may not be opened by this user; choose a port above 1023"
    return f"{where} cannot be opened ({error.strerror or error}); check host and port"


SPARE_SHARE = 0.25
"""What can be spared is taken only while less than this share of the limit waits."""


class SendQueue:
    """Chunks in the order of their sending."""

    def __init__(self, limit_bytes: int) -> None:
        self.dropped = 0
        """Chunks that were refused, or gave way to newer ones."""
        self._limit = limit_bytes
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._written = 0

    def __len__(self) -> int:
        """Bytes that wait."""
        return self._bytes - self._written

    def add(self, data: bytes, *, is_droppable: bool = False) -> bool:
        """Queue a chunk; whether it was taken."""
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
        """What to write next: the rest of the first chunk, and all that is behind it."""
        return b"".join(data for data, _ in self._waiting)[self._written :]

    def consume(self, count: int) -> None:
        """So many bytes of `head` are written."""
        self._written += count
        while self._waiting and self._written >= len(self._waiting[0][0]):
            data, _ = self._waiting.popleft()
            self._written -= len(data)
            self._bytes -= len(data)

    def _drop_one(self) -> bool:
        """Give up the oldest chunk that can be spared, or the oldest; whether there was one."""
        begun = 1 if self._written else 0
        places = range(begun, len(self._waiting))
        spared = (place for place in places if self._waiting[place][1])
        victim = next(spared, begun)
        if victim >= len(self._waiting):
            return False
        self._bytes -= len(self._waiting[victim][0])
        del self._waiting[victim]
        self.dropped += 1
        return True
