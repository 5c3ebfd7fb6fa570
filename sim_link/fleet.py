"""Several vehicles behind one shell: their links side by side, their steps in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint


class Fleet:
    """Endpoints that share nothing but the loop; implements `companion.mav.endpoint.Endpoint`.

    Args:
        endpoints: One per vehicle.
        links_each: How many links every one of them has; vehicle n has those from n times this on.
    """

    def __init__(self, endpoints: Sequence[SimEndpoint], links_each: int) -> None:
        self.endpoints = tuple(endpoints)
        self._links_each = links_each

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Give bytes to the vehicle whose link it is."""
        index, link = divmod(chunk.link, self._links_each)
        self.endpoints[index].receive(replace(chunk, link=link), now_s)

    def handle_timer(self, now_s: float) -> None:
        """Step every vehicle that is due."""
        for endpoint in self.endpoints:
            if endpoint.next_timer_s() <= now_s:
                endpoint.handle_timer(now_s)

    def next_timer_s(self) -> float:
        """When the first of them is due."""
        return min(endpoint.next_timer_s() for endpoint in self.endpoints)

    def take_output(self) -> list[Chunk]:
        """What all of them send."""
        chunks: list[Chunk] = []
        for index, endpoint in enumerate(self.endpoints):
            first = index * self._links_each
            output = endpoint.take_output()
            if first == 0:
                chunks += output
            else:
                chunks += [
                    Chunk(
                        first + chunk.link,
                        chunk.data,
                        chunk.peer,
                        chunk.except_peers,
                        chunk.is_datagram,
                    )
                    for chunk in output
                ]
        return chunks

    def request_stop(self, now_s: float) -> None:
        """Finish at once."""
        for endpoint in self.endpoints:
            endpoint.request_stop(now_s)

    @property
    def is_finished(self) -> bool:
        """Whether all of them are."""
        return all(endpoint.is_finished for endpoint in self.endpoints)
