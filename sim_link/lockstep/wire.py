"""What lies between the two endpoints: a datagram goes in, and comes out somewhen or never."""

from __future__ import annotations

from enum import Enum
from typing import Protocol

Delivery = tuple[float, bytes]
"""When a datagram arrives, and its bytes."""


class Lane(Enum):
    """One direction of one link."""

    TO_COMPANION = "vehicle to companion"
    TO_VEHICLE = "companion to vehicle"
    RANGING = "radio to companion, over a link of its own"


class Wire(Protocol):
    """Carries datagrams; what happens to them depends on its seed and on what it is given only."""

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """What arrives of a datagram that is sent at `now_s`: nothing, it, or copies of it."""


class PerfectWire:
    """Everything arrives at once and as it was sent."""

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Deliver now."""
        return [(now_s, data)]
