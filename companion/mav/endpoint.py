"""Sans-IO interface between a MAVLink participant and the shell that owns its sockets.

A shell passes the time in, which never decreases; an endpoint never reads a clock. The
companion and the simulator are both endpoints, so one shell drives either, and a test connects them
in memory without any.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

TICK_S = 0.05
"""Period of a control tick, seconds: setpoints are sent at 20 Hz."""
Address = tuple[str, int]
"""Host and port of a UDP peer."""


class Chunk(NamedTuple):
    """Bytes to or from a link."""

    link: int
    """Index of the link, in the shell's order."""
    data: bytes
    """The bytes; empty from one of several clients of a TCP port: that client has disconnected."""
    peer: Address | None = None
    """Sender; on the way out, None means the link's default peers."""
    except_peers: frozenset[Address] = frozenset()
    """Peers that are left out, on the way out without a peer."""
    is_datagram: bool = True
    """False on serial and TCP links, where a chunk may hold any part of a frame."""
    is_droppable: bool = False
    """True: on the way out, dropped first where a line is too slow."""
    arrived_s: float | None = None
    """`time.monotonic` of its arrival, where the system has stamped it."""

    def readdressed(self, link: int, peer: Address | None) -> Chunk:
        """Return the same bytes on another link, to another peer."""
        but = self.except_peers
        return Chunk(link, self.data, peer, but, self.is_datagram, self.is_droppable)


class Endpoint(Protocol):
    """MAVLink participant without sockets or clocks."""

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process bytes that arrived on a link."""

    def handle_timer(self, now_s: float) -> None:
        """Run the tasks that are due; called at `next_timer_s` or later."""

    def next_timer_s(self) -> float:
        """Return the time of the next call of `handle_timer`."""

    def take_output(self) -> list[Chunk]:
        """Return the chunks to be sent, in order; each is returned once."""

    def request_stop(self, now_s: float) -> None:
        """Begin an orderly shutdown (SIGTERM, SIGINT)."""

    @property
    def is_finished(self) -> bool:
        """True if the shell may close the links."""


class OneShotEndpoint:
    """`Endpoint` that runs every tick until its time is over or it is stopped."""

    def __init__(self, duration_s: float | None, tick_s: float = TICK_S) -> None:
        self.now_s = 0.0
        self._duration_s = duration_s
        self._tick_s = tick_s
        self._next_s = 0.0
        self._is_stopped = False
        self._output: list[Chunk] = []

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Process bytes that arrived."""
        del chunk
        self.now_s = now_s

    def handle_timer(self, now_s: float) -> None:
        """Run what is due."""
        self.now_s, self._next_s = now_s, now_s + self._tick_s

    def next_timer_s(self) -> float:
        """Return the time of the next tick."""
        return self._next_s

    def take_output(self) -> list[Chunk]:
        """Return the chunks to be sent; each is returned once."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        """Stop at once with the results so far."""
        del now_s
        self._is_stopped = True

    @property
    def is_finished(self) -> bool:
        """True if it was stopped, or its time is over."""
        is_over = self._duration_s is not None and self.now_s >= self._duration_s
        return self._is_stopped or is_over
