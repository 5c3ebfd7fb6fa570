"""Who speaks, over what, and where an answer goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address


class Channel(NamedTuple):
    """One way in and out: a link, or one of the peers that share it (UDP, TCP server)."""

    link: int
    peer: Address | None = None
    """None where a link has only one other end."""


@dataclass(frozen=True, slots=True)
class Partner:
    """A component that said something, and the channel it was heard on."""

    channel: Channel
    system_id: int
    component_id: int


class Outgoing(NamedTuple):
    """A message to send."""

    message: Message
    to: Channel | None = None
    """None for every channel."""


@dataclass(frozen=True, slots=True)
class Addressing:
    """Which messages are for us.

    Source: MAVLink developer guide, "Routing": 0 is everyone. ArduPilot 4.5 also obeys what is
    for another component of its system.
    """

    system_id: int
    component_id: int = mavlink.MAV_COMP_ID_AUTOPILOT1
    obeys_any_component: bool = False

    def is_for_us(self, message: Message) -> bool:
        """Whether a message is a broadcast or names us."""
        system_id = int(getattr(message, "target_system", 0))
        component_id = int(getattr(message, "target_component", 0))
        if system_id not in (0, self.system_id):
            return False
        return self.obeys_any_component or component_id in (0, self.component_id)


def partner_of(message: Message, channel: Channel) -> Partner:
    """The sender of a received message."""
    return Partner(channel, message.get_srcSystem(), message.get_srcComponent())
