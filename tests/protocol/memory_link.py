"""An endpoint in memory, on invented time, with any number of clients."""

from __future__ import annotations

from collections import deque

from companion.mav.endpoint import Address, Chunk, Endpoint

FIRST_PORT = 50_001


class MemoryHub:
    """Runs one endpoint and hands its chunks to the clients connected to it."""

    def __init__(self, endpoint: Endpoint, started_s: float = 0.0) -> None:
        self.endpoint = endpoint
        self.now_s = started_s
        self._links: list[MemoryLink] = []
        self._count = 0

    def connect(self, link_index: int = 0, *, is_datagram: bool = True) -> MemoryLink:
        """A client with an address of its own.

        Args:
            link_index: The endpoint's link that it is on.
            is_datagram: True if pieces keep their boundaries; otherwise it is a byte stream.
        """
        address = ("127.0.0.1", FIRST_PORT + self._count)
        self._count += 1
        link = MemoryLink(self, address, link_index, is_datagram=is_datagram)
        self._links.append(link)
        return link

    def disconnect(self, link: MemoryLink) -> None:
        """Let a client go: it hears nothing any more."""
        self._links.remove(link)

    def receive(self, data: bytes, sender: MemoryLink) -> None:
        """A client's bytes arrive at the endpoint."""
        chunk = Chunk(sender.link_index, data, sender.address, is_datagram=sender.is_datagram)
        self.endpoint.receive(chunk, self.now_s)
        self._deliver()

    def step(self, until_s: float) -> None:
        """Let time pass to the endpoint's next timer, at the latest to `until_s`."""
        due_s = self.endpoint.next_timer_s()
        if due_s > until_s:
            self.now_s = max(self.now_s, until_s)
            return
        self.now_s = max(self.now_s, due_s)
        self.endpoint.handle_timer(self.now_s)
        self._deliver()

    def _deliver(self) -> None:
        for chunk in self.endpoint.take_output():
            for link in self._links:
                if link.is_meant(chunk):
                    link.inbox.append(chunk.data)


class MemoryLink:
    """One client of a `MemoryHub`; a `ProbeLink`.

    Args:
        link_index: The endpoint's link that it is on.
        is_datagram: True if pieces keep their boundaries.
    """

    def __init__(
        self, hub: MemoryHub, address: Address, link_index: int, *, is_datagram: bool
    ) -> None:
        self.is_datagram = is_datagram
        self.address = address
        self.link_index = link_index
        self.inbox: deque[bytes] = deque()
        self._hub = hub
        self._others: list[MemoryLink] = []

    @property
    def now_s(self) -> float:
        """The endpoint's time."""
        return self._hub.now_s

    def send(self, data: bytes) -> None:
        """Send a datagram."""
        self._hub.receive(data, self)

    def poll(self, until_s: float) -> list[bytes]:
        """Return the frames that arrive first, at the latest at `until_s`."""
        while not self.inbox and self._hub.now_s < until_s:
            self._hub.step(until_s)
        arrived = list(self.inbox)
        self.inbox.clear()
        return arrived

    def another(self) -> MemoryLink:
        """A second client on the same link of the endpoint."""
        other = self._hub.connect(self.link_index, is_datagram=self.is_datagram)
        self._others.append(other)
        return other

    def close_others(self) -> None:
        """Let the clients go that were made from this one."""
        while self._others:
            self._hub.disconnect(self._others.pop())

    def is_meant(self, chunk: Chunk) -> bool:
        """Return True if a chunk of the endpoint is sent to this link."""
        if chunk.link != self.link_index or self.address in chunk.except_peers:
            return False
        return chunk.peer in (None, self.address)
