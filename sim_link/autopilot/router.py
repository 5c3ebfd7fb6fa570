"""Forwarding between those who share the vehicle's link, as an autopilot does it.

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
    """

    def __init__(self, system_id: int, own_components: tuple[int, ...]) -> None:
        self._system_id = system_id
        self._own_components = own_components
        self._peers: OrderedDict[tuple[int, int], Address] = OrderedDict()

    def forward(self, message: Message, peer: Address | None, link: int) -> list[Chunk]:
        """The chunks by which a received message is passed on.

        Args:
            message: As decoded; its raw frame is what is forwarded.
            peer: Who sent it; None on a link with only one other end, where nobody else is.
            link: The link it came from and leaves by.
        """
        if peer is None or message.get_msgId() in NEVER_FORWARDED:
            return []
        self._learn((message.get_srcSystem(), message.get_srcComponent()), peer)
        frame = bytes(message.get_msgbuf())
        system_id = int(getattr(message, "target_system", 0))
        component_id = int(getattr(message, "target_component", 0))
        if system_id == 0 or (system_id == self._system_id and component_id == 0):
            return [Chunk(link, frame, None, except_peer=peer)]
        if system_id == self._system_id and component_id in self._own_components:
            return []
        heard = {
            address
            for (system, component), address in self._peers.items()
            if system == system_id and component_id in (0, component) and address != peer
        }
        return [Chunk(link, frame, address) for address in sorted(heard)]

    def _learn(self, source: tuple[int, int], peer: Address) -> None:
        self._peers[source] = peer
        self._peers.move_to_end(source)
        if len(self._peers) > MAX_COMPONENTS:
            self._peers.popitem(last=False)
