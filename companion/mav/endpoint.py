"""The sans-IO interface between a MAVLink participant and the shell that owns its sockets.

A shell stamps the time once per wake-up and passes it in; an endpoint never asks for it. The
companion and the simulator are both endpoints, so one shell drives either, and a test joins them
in memory without any.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

TICK_S = 0.05
Address = tuple[str, int]
"""Host and port of a UDP peer."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes to or from a link."""

    link: int
    """Index of the link, in the order the shell was given them."""
    data: bytes
    """Without any, from one of several clients of a TCP port: that one has gone."""
    peer: Address | None = None
    """Who sent it; on the way out, None means whomever the link talks to by default."""
    except_peers: frozenset[Address] = frozenset()
    """On the way out, without a peer: everyone but these."""
    is_datagram: bool = True
    """False on serial and TCP links, where a chunk may hold any part of a frame."""
    is_droppable: bool = False
    """On the way out: given up first where a line is too slow for all of it."""

    def readdressed(self, link: int, peer: Address | None) -> Chunk:
        """The same bytes on another link, to another peer."""
        but = self.except_peers
        return Chunk(link, self.data, peer, but, self.is_datagram, self.is_droppable)


class Endpoint(Protocol):
    """One MAVLink participant, without sockets or clocks."""

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived on a link."""

    def handle_timer(self, now_s: float) -> None:
        """Do what is due; called at `next_timer_s` or later."""

    def next_timer_s(self) -> float:
        """When `handle_timer` wants to be called next."""

    def take_output(self) -> list[Chunk]:
        """What is to be sent, in order; taken once."""

    def request_stop(self, now_s: float) -> None:
        """Begin an orderly end (SIGTERM, SIGINT)."""

    @property
    def is_finished(self) -> bool:
        """Whether the shell may close the links."""


class OneShotEndpoint:
    """An `Endpoint` that looks again every tick, until its time is over or it is asked to end."""

    def __init__(self, duration_s: float | None, tick_s: float = TICK_S) -> None:
        self.now_s = 0.0
        self._duration_s = duration_s
        self._tick_s = tick_s
        self._next_s = 0.0
        self._is_stopped = False
        self._output: list[Chunk] = []

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Take in what arrived."""
        del chunk
        self.now_s = now_s

    def handle_timer(self, now_s: float) -> None:
        """Do what is due."""
        self.now_s, self._next_s = now_s, now_s + self._tick_s

    def next_timer_s(self) -> float:
        """When to look again."""
        return self._next_s

    def take_output(self) -> list[Chunk]:
        """What is to be sent; taken once."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        """End at once, with what is known."""
        del now_s
        self._is_stopped = True

    @property
    def is_finished(self) -> bool:
        """Whether it was asked to end, or the time is over."""
        is_over = self._duration_s is not None and self.now_s >= self._duration_s
        return self._is_stopped or is_over
