"""Forwarding between those who are on the vehicle's links, as an autopilot does it.

Theory of operation. Whoever is heard on a channel can be reached there; one component may be heard
on several. A broadcast goes to every other channel, an addressed frame only to where its target
was heard, and never back to where it came from. A frame is passed on as its bytes are, whether or
not we can decode or believe it, so routes are read from the bytes too. SETUP_SIGNING stays here.

A SYSTEM_TIME whose time since boot went back means that its sender's system restarted: its routes
are learnt anew.

Source: MAVLink developer guide, "Routing".
"""

from __future__ import annotations

from collections import OrderedDict

from companion.mav.endpoint import Chunk
from companion.mav.signing import is_secret
from companion.mav.targets import boot_ms_of, source_of, targets_of_frame
from sim_link.autopilot.protocols.base import Channel

MAX_COMPONENTS = 256
MAX_CHANNELS = 8
"""On which one component is known; whoever hops between ports leaves the oldest behind."""
REBOOT_BACKWARD_MS = 1000
"""Less is a frame that was overtaken on its way."""
WRAP_MS = 2**32
MAX_WRAP_GAP_MS = 60_000
"""The counter starts again after 49.7 days: a step back by almost all of it is no restart."""

Component = tuple[int, int]


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
        self._routes: OrderedDict[Component, OrderedDict[Channel, None]] = OrderedDict()
        self._boot_ms: OrderedDict[Component, int] = OrderedDict()
        self._rebooted: list[int] = []

    def route(self, frame: bytes, channel: Channel) -> list[Chunk]:
        """The chunks by which a received frame is passed on.

        Args:
            frame: Whole, of a known message or not.
            channel: Where it came from.
        """
        source = source_of(frame)
        if source[0] == 0 or is_secret(frame):
            return []
        self._notice_reboot(source, frame)
        self._learn(source, channel)
        system_id, component_id = targets_of_frame(frame)
        if system_id == 0:
            return self._to_all(frame, channel)
        if system_id == self._system_id and component_id in self._own_components:
            return []
        return [
            Chunk(each.link, frame, each.peer)
            for each in self._channels_of(system_id, component_id)
            if each != channel
        ]

    def take_rebooted(self) -> list[int]:
        """Systems that restarted since the last call; what was known of them is out of date."""
        rebooted, self._rebooted = self._rebooted, []
        return rebooted

    def forget(self, channel: Channel) -> None:
        """Drop the routes over a channel that is gone."""
        for source in list(self._routes):
            self._routes[source].pop(channel, None)
            if not self._routes[source]:
                del self._routes[source]

    def _to_all(self, frame: bytes, channel: Channel) -> list[Chunk]:
        """To the other peers of its own link, and to every other link."""
        chunks = [Chunk(each, frame) for each in self._links if each != channel.link]
        if channel.peer is not None:
            chunks.insert(0, Chunk(channel.link, frame, None, frozenset({channel.peer})))
        return chunks

    def _channels_of(self, system_id: int, component_id: int) -> list[Channel]:
        found = {
            channel: None
            for (system, component), channels in self._routes.items()
            if system == system_id and component_id in (0, component)
            for channel in channels
        }
        return list(found)

    def _learn(self, source: Component, channel: Channel) -> None:
        channels = self._routes.setdefault(source, OrderedDict())
        channels[channel] = None
        channels.move_to_end(channel)
        if len(channels) > MAX_CHANNELS:
            channels.popitem(last=False)
        self._routes.move_to_end(source)
        if len(self._routes) > MAX_COMPONENTS:
            self._routes.popitem(last=False)

    def _notice_reboot(self, source: Component, frame: bytes) -> None:
        boot_ms = boot_ms_of(frame)
        if boot_ms is None:
            return
        before_ms = self._boot_ms.get(source)
        self._boot_ms[source] = boot_ms
        self._boot_ms.move_to_end(source)
        if len(self._boot_ms) > MAX_COMPONENTS:
            self._boot_ms.popitem(last=False)
        if before_ms is None:
            return
        back_ms = before_ms - boot_ms
        if REBOOT_BACKWARD_MS < back_ms < WRAP_MS - MAX_WRAP_GAP_MS:
            for known in [each for each in self._routes if each[0] == source[0]]:
                del self._routes[known]
            self._rebooted.append(source[0])
