"""Messages as they come off the wire, and partners to send them."""

from __future__ import annotations

from typing import TypeVar

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message
from sim_link.autopilot.protocols.addressing import Channel, Outgoing, Partner

M = TypeVar("M", bound=Message)

STATION_CHANNEL = Channel(0, ("127.0.0.1", 14550))
COMPANION_CHANNEL = Channel(0, ("127.0.0.1", 14540))
SERIAL_CHANNEL = Channel(1)
STATION = Partner(STATION_CHANNEL, 255, 190)
COMPANION = Partner(COMPANION_CHANNEL, 1, 191)


def received(message: Message, sender: Partner = STATION) -> Message:
    """The message after a trip over the wire."""
    codec = MavCodec(sender.system_id, sender.component_id)
    (decoded,) = MavCodec(1, 1).decode(codec.encode(message))
    return decoded


def sent(outgoing: Outgoing) -> Message:
    """Return the message that the other end decodes."""
    return said(outgoing.message)


def said(message: Message) -> Message:
    """Return a message of ours as the other end decodes it."""
    (decoded,) = MavCodec(255, 190).decode(MavCodec(1, 1).encode(message))
    return decoded


def of_type(outgoing: list[Outgoing], kind: type[M]) -> list[M]:
    """The messages of one type, as the other end reads them."""
    return [read for read in map(sent, outgoing) if isinstance(read, kind)]
