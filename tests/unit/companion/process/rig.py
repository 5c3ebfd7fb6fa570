"""A companion endpoint with the parts that a process adds to it, on invented time."""

from __future__ import annotations

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.io.files import WriterHealth
from companion.io.flight_recorder import BlackBox
from companion.io.links.link import Link
from companion.link.endpoint import CompanionEndpoint
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from sim_link.lab.lockstep import MemoryJournal

PEER = ("127.0.0.1", 14580)


class WatchedNotes(MemoryJournal, BlackBox):
    """Notes whose disk does what the test says."""

    health = WriterHealth(0, 0, 0, 0.0, is_alive=True)

    def discard(self) -> None:
        """There is no directory."""

    def close(self, timeout_s: float = 0.0) -> None:
        """There is no file."""

    def of_kind(self, kind: str) -> list[dict[str, object]]:
        return [dict(fields) for _, name, fields in self.records if name == kind]


class StillLink(Link):
    """A link that does nothing."""

    is_listening = True

    def __init__(self) -> None:
        super().__init__("udp 127.0.0.1:14550", 0, lambda _: None)

    @property
    def is_open(self) -> bool:
        return self.is_listening

    async def open(self) -> None:
        """Nothing to open."""

    def send(self, chunk: Chunk) -> None:
        """Nowhere to send to."""

    def close(self) -> None:
        """Nothing to close."""


def an_endpoint(notes: MemoryJournal, config: CompanionConfig | None = None) -> CompanionEndpoint:
    return build_endpoint(config or CompanionConfig(), notes)


def hear_autopilot(
    endpoint: CompanionEndpoint, now_s: float, *, system_id: int = 1, autopilot: int = 12
) -> None:
    """A heartbeat of PX4 (12) or ArduPilot (3), armed and in hold."""
    hold = 0x03040000 if autopilot == 12 else 17
    heartbeat = mavlink.MAVLink_heartbeat_message(2, autopilot, 0x81, hold, 4, 3)
    endpoint.receive(Chunk(0, MavCodec(system_id, 1).encode(heartbeat), PEER), now_s)
