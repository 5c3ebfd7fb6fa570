"""Intake of a link between two control ticks."""

from __future__ import annotations

import pytest

from companion.link.binding import AutopilotBinding
from companion.link.intake import HEARTBEATS, KNOWN, Intake, Resource
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk

VEHICLE: Address = ("127.0.0.1", 14580)
STRANGER: Address = ("127.0.0.1", 16000)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3)
ATTITUDE = mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
BACKLOG = KNOWN[Resource.MESSAGES] + 10


class Link:
    """A link whose autopilot is known."""

    def __init__(self) -> None:
        binding = AutopilotBinding(wanted_system_id=1)
        self.codec = MavCodec(1, 191)
        self.intake = Intake(self.codec, binding)
        self._sender = MavCodec(1, 1)
        binding.recognise(self.sent(HEARTBEAT)[0], VEHICLE, 0.0)

    def sent(
        self, message: Message, peer: Address = VEHICLE, *, is_datagram: bool = True
    ) -> list[Message]:
        """Return what is taken in of one more message."""
        chunk = Chunk(0, self._sender.encode(message), peer, is_datagram=is_datagram)
        return [message for data in self.intake.take(chunk) for message in self.codec.decode(data)]


@pytest.fixture
def behind() -> Link:
    """More than a tick reads has arrived already."""
    link = Link()
    taken = sum(len(link.sent(ATTITUDE)) for _ in range(BACKLOG))
    assert taken == KNOWN[Resource.MESSAGES]
    return link


def test_the_heartbeat_behind_a_backlog_is_read(behind: Link) -> None:
    (heartbeat,) = behind.sent(HEARTBEAT)
    assert heartbeat.get_type() == "HEARTBEAT"
    assert behind.sent(ATTITUDE) == []


def test_every_mode_of_a_minutes_backlog_is_read(behind: Link) -> None:
    """One a second, and four more that were asked for; who flew in between may be a pilot."""
    asked_s, kept_s = 9.0, 60.0
    assert all(behind.sent(HEARTBEAT) for _ in range(round(kept_s + 4.0 * asked_s)))


def test_of_heartbeats_alone_no_flood_is_made(behind: Link) -> None:
    taken = sum(len(behind.sent(HEARTBEAT)) for _ in range(10 * HEARTBEATS))
    assert taken == HEARTBEATS
    behind.intake.budget.renew()
    assert len(behind.sent(HEARTBEAT)) == 1


def test_a_strangers_heartbeats_have_no_such_right() -> None:
    link = Link()
    for _ in range(BACKLOG):
        link.sent(ATTITUDE, STRANGER)
    assert link.sent(HEARTBEAT, STRANGER) == []


def test_a_longer_message_is_no_heartbeat(behind: Link) -> None:
    assert behind.sent(mavlink.MAVLink_statustext_message(6, b"x" * 30)) == []
