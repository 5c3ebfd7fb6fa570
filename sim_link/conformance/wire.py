"""The real link: any address that the companion understands, in real time.

The links of `companion.io` run on an event loop; a probe reads like a script. So a loop of our own
runs only while a probe waits.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager

from companion.io.links.link import Link
from companion.io.links.specs import (
    LinkSpec,
    SerialPort,
    TcpClient,
    UdpBind,
    UdpConnect,
    link_from_url,
    make_link,
)
from companion.io.links.urls import parse_link_url
from companion.mav.endpoint import Address, Chunk

CONNECT_GRACE_S = 0.3
"""How long a TCP connection or serial device may take before the first byte is sent."""


class WireLink:
    """One open connection; a `ProbeLink`.

    Args:
        spec: What is opened.
        loop: Runs while a probe waits.
    """

    def __init__(self, spec: LinkSpec, loop: asyncio.AbstractEventLoop) -> None:
        self._spec = spec
        self._loop = loop
        self._arrived: list[bytes] = []
        self._peer: Address | None = None
        self._wake = asyncio.Event()
        self._others: list[WireLink] = []
        self._link: Link = make_link(spec, 0, self._receive)

    def open(self) -> None:
        """Bind or connect.

        Raises:
            LinkError: It cannot be opened.
        """
        self._loop.run_until_complete(self._link.open())
        if isinstance(self._spec, TcpClient | SerialPort):
            self._loop.run_until_complete(asyncio.sleep(CONNECT_GRACE_S))

    @property
    def now_s(self) -> float:
        """The wall clock, monotonic."""
        return time.monotonic()

    @property
    def is_datagram(self) -> bool:
        """Whether it is UDP."""
        return isinstance(self._spec, UdpBind | UdpConnect)

    def send(self, data: bytes) -> None:
        """Send now; nothing is sent before a peer was heard where we only listen.

        What has arrived is read first: a client that was busy elsewhere would lose the answer,
        because its socket is full.
        """
        self._loop.run_until_complete(self._drain())
        self._link.send(Chunk(0, data, self._peer))
        self._loop.run_until_complete(asyncio.sleep(0))

    def poll(self, until_s: float) -> list[bytes]:
        """What arrives first, at the latest at `until_s`."""
        self._loop.run_until_complete(self._wait(until_s))
        arrived, self._arrived = self._arrived, []
        return arrived

    def another(self) -> WireLink | None:
        """A second client, where the peer is reached by connecting to it."""
        if not isinstance(self._spec, UdpConnect | TcpClient):
            return None
        other = WireLink(self._spec, self._loop)
        other.open()
        self._others.append(other)
        return other

    def close_others(self) -> None:
        """Close the connections made from this one: a server takes so many and no more."""
        while self._others:
            self._others.pop().close()

    def close(self) -> None:
        """Close this connection and those made from it."""
        self.close_others()
        self._loop.run_until_complete(self._close())

    async def _close(self) -> None:
        self._link.close()

    async def _drain(self) -> None:
        before = -1
        while before != len(self._arrived):
            before = len(self._arrived)
            await asyncio.sleep(0)
            await asyncio.sleep(0)  # a reader is called in the turn after its socket was seen

    async def _wait(self, until_s: float) -> None:
        self._wake.clear()
        await asyncio.sleep(0)
        if self._arrived:
            return
        patience_s = until_s - self.now_s
        if patience_s > 0.0:
            try:
                await asyncio.wait_for(self._wake.wait(), patience_s)
            except TimeoutError:
                return

    def _receive(self, chunks: list[Chunk]) -> None:
        for chunk in chunks:
            if self._peer is None:
                self._peer = chunk.peer
            if chunk.peer == self._peer:
                self._arrived.append(chunk.data)
        self._wake.set()


@contextmanager
def open_link(url: str) -> Iterator[WireLink]:
    """The link of a URL, closed at the end.

    Args:
        url: `udp:`, `udpin:`, `udpout:`, `tcp:`, `tcpin:` with `HOST:PORT`, or a serial device.

    Raises:
        ConfigError: It is no link address.
        LinkError: It cannot be opened.
    """
    spec = link_from_url(parse_link_url(url))
    loop = asyncio.new_event_loop()
    try:
        link = WireLink(spec, loop)
        try:
            link.open()
            yield link
        finally:
            link.close()
            loop.run_until_complete(asyncio.sleep(0))
    finally:
        loop.close()
