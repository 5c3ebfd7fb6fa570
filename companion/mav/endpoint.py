"""The sans-IO interface between a MAVLink participant and the shell that owns its sockets.

A shell stamps the time once per wake-up and passes it in; an endpoint never asks for it. The
companion and the simulator are both endpoints, so one shell drives either, and a test joins them
in memory without any.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

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
