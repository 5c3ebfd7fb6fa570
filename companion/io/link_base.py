"""What every link can do, whatever it runs over."""

from __future__ import annotations

import errno
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from companion.mav.endpoint import Address, Chunk

logger = logging.getLogger("companion.io")

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
    """Why the last one was refused."""
    receive_errors: int = 0
    dropped: int = 0
    """Chunks not sent because nobody was connected or too much was waiting."""
    reconnects: int = 0


class Link(ABC):
    """One open (or re-opening) connection; made by `companion.io.links.make_link`.

    Args:
        name: The link in messages, for example `udp 127.0.0.1:14550`.
        index: Its number in the chunks.
        received: Takes what arrives.
    """

    def __init__(self, name: str, index: int, received: Received) -> None:
        self.name = name
        self.index = index
        self.counters = LinkCounters()
        self._received = received

    @abstractmethod
    async def open(self) -> None:
        """Start listening or connecting.

        Raises:
            LinkError: It can never work as configured (port taken, no such host).
        """

    @property
    def is_open(self) -> bool:
        """Whether it listens, is connected, or tries to be; not whether anybody is there."""
        return True

    @abstractmethod
    def send(self, chunk: Chunk) -> None:
        """Send now or count why not; never raises and never waits."""

    def hear_only(self, peer: Address | None) -> None:
        """Let the system drop what others than `peer` send, if it can; None: hear everybody."""
        del peer  # only UDP has strangers

    @abstractmethod
    def close(self) -> None:
        """Release everything; a second call does nothing."""


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
