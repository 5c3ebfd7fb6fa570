"""Forwarding between those who are on the vehicle's links, as an autopilot does it.

A broadcast goes to everyone else; an addressed frame only to where its target was heard; a frame is
never altered. Source: MAVLink developer guide, "Routing".
"""

from __future__ import annotations

from collections import OrderedDict

from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk

MAX_COMPONENTS = 64
NEVER_FORWARDED = (mavlink.MAVLINK_MSG_ID_SETUP_SIGNING,)


class Router:
    """Knows who was heard where.

    Args:
        system_id: Of the vehicle.
        own_components: Components of the vehicle itself; what is for them stays here.
        links: How many there are.
    """

    def __init__(self, system_id: int, own_components: tuple[int, ...], links: int = 1) -> None:
        self._system_id = system_id
        self._own_components = own_components
        self._links = range(links)
        self._places: OrderedDict[tuple[int, int], tuple[int, Address | None]] = OrderedDict()

    def forward(self, message: Message, peer: Address | None, link: int) -> list[Chunk]:
        """The chunks by which a received message is passed on.

        Args:
            message: As decoded; its raw frame is what is forwarded.
            peer: Who sent it; None on a link with only one other end.
            link: The link it came from.
        """
        if message.get_msgId() in NEVER_FORWARDED:
            return []
        self._learn((message.get_srcSystem(), message.get_srcComponent()), (link, peer))
        system_id = int(getattr(message, "target_system", 0))
        component_id = int(getattr(message, "target_component", 0))
        frame = bytes(message.get_msgbuf())
        if system_id == 0 or (system_id == self._system_id and component_id == 0):
            return self._to_all(frame, peer, link)
        if system_id == self._system_id and component_id in self._own_components:
            return []
        heard = {
            place
            for (system, component), place in self._places.items()
            if system == system_id and component_id in (0, component) and place != (link, peer)
        }
        return [Chunk(other, frame, address) for other, address in sorted(heard, key=str)]

    def _to_all(self, frame: bytes, peer: Address | None, link: int) -> list[Chunk]:
        """A broadcast: to the other peers of its own link, and to every other link."""
        chunks = [] if peer is None else [Chunk(link, frame, None, except_peer=peer)]
        return chunks + [Chunk(other, frame) for other in self._links if other != link]

    def _learn(self, source: tuple[int, int], place: tuple[int, Address | None]) -> None:
        self._places[source] = place
        self._places.move_to_end(source)
        if len(self._places) > MAX_COMPONENTS:
            self._places.popitem(last=False)
