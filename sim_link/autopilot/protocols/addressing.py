"""Senders, channels and the addressing of answers; texts for people, long ones in chunks.

Source: MAVLink common, STATUSTEXT: chunks share a non-zero id and count from 0, and a NUL in the
field marks the last one, so a text that fills its last chunk is followed by an empty one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address


def flags_of(prefix: str, names: str) -> int:
    """Return the bits of a MAVLink enum by their names, separated by blanks."""
    return sum(int(getattr(mavlink, f"{prefix}_{name}")) for name in names.split())


K = TypeVar("K")
V = TypeVar("V")


class Newest(OrderedDict[K, V]):
    """The entries that were set last; beyond `most` the oldest is dropped."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most

    def __setitem__(self, key: K, value: V) -> None:
        super().__setitem__(key, value)
        self.move_to_end(key)
        if len(self) > self._most:
            self.popitem(last=False)


LinkMode = Literal["onboard", "station", "narrow", "asked"]
"""Kind of peer on a link, which determines its default streams (PX4 MAV_x_MODE): companions, ground
stations, a line of 4000 bytes/s, a peer that requests all but HEARTBEAT."""


class LinkSetup(NamedTuple):
    """Configuration of the autopilot on a link."""

    mode: LinkMode = "onboard"
    has_one_peer: bool = False
    """True if only the first sender is answered, as on PX4's UDP; otherwise all."""


class Channel(NamedTuple):
    """One way in and out: a link, or one of the peers that share it (UDP, TCP server)."""

    link: int
    peer: Address | None = None
    """Other end of the channel; None where a link has only one."""


@dataclass(frozen=True, slots=True)
class Partner:
    """Component that has sent a message, and the channel it was heard on."""

    channel: Channel
    system_id: int
    component_id: int

    @property
    def ids(self) -> tuple[int, int]:
        """System and component."""
        return (self.system_id, self.component_id)


class Outgoing(NamedTuple):
    """A message to send."""

    message: Message
    to: Channel | None = None


@dataclass(frozen=True, slots=True)
class Addressing:
    """Filter that selects the messages addressed to this vehicle.

    Source: MAVLink developer guide, "Routing": 0 is everyone; ArduCopter 4.5 as observed.
    """

    system_id: int
    component_id: int = mavlink.MAV_COMP_ID_AUTOPILOT1
    is_known: Callable[[int, int], bool] | None = None
    """Predicate for components that were heard. ArduPilot answers for those of its system that were
    not; None if it does not."""

    def is_for_us(self, message: Message) -> bool:
        """Return True if a message is a broadcast or names us."""
        system_id = int(getattr(message, "target_system", 0))
        component_id = int(getattr(message, "target_component", 0))
        if system_id not in (0, self.system_id):
            return False
        if component_id in (0, self.component_id):
            return True
        return self.is_known is not None and not self.is_known(self.system_id, component_id)


def partner_of(message: Message, channel: Channel) -> Partner:
    """Return the sender of a received message."""
    return Partner(channel, message.get_srcSystem(), message.get_srcComponent())


CHUNK_LENGTH = 50
MAX_CHUNKS = 255
MAX_ID = 0xFFFF


class StatusTexts:
    """Builds STATUSTEXTs, and assigns the ids that join the chunks of long texts."""

    def __init__(self) -> None:
        self._last_id = 0

    def messages(self, severity: int, text: str) -> list[Message]:
        """Return the STATUSTEXTs of a text of any length, truncated after 255 chunks.

        What is not ASCII becomes `?`, which every client shows.
        """
        encoded = text.encode("ascii", errors="replace").replace(b"\0", b"?")
        if len(encoded) <= CHUNK_LENGTH:
            return [mavlink.MAVLink_statustext_message(severity, encoded, 0, 0)]
        self._last_id = self._last_id % MAX_ID + 1
        starts = range(0, len(encoded) + 1, CHUNK_LENGTH)[:MAX_CHUNKS]
        return [
            mavlink.MAVLink_statustext_message(
                severity, encoded[start : start + CHUNK_LENGTH], self._last_id, number
            )
            for number, start in enumerate(starts)
        ]

    def warn(self, partner: Partner, text: str) -> list[Outgoing]:
        """Return a warning to one partner."""
        messages = self.messages(mavlink.MAV_SEVERITY_WARNING, text)
        return [Outgoing(message, partner.channel) for message in messages]
