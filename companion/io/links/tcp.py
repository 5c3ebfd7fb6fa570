"""Listening TCP ports: one for a single client, one for several.

A client is a peer by its address and port; each is a byte stream of its own, so that an endpoint
keeps the unfinished frames of different clients apart.
"""

from __future__ import annotations

import asyncio
import socket
from abc import abstractmethod

from companion.errors import LinkError
from companion.io.links.byte_streams import ByteStream, StreamLink, has_frame, tune
from companion.io.links.link import Link, Received, bind_problem, bound_address, logger
from companion.io.links.udp import resolve
from companion.mav.endpoint import Address, Chunk

MAX_CLIENTS = 16
BACKLOG = 4


class TcpListener(Link):
    """Listening TCP port; subclasses decide what happens to a client."""

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(f"tcpin {host}:{port}", index, received)
        self._host, self._port = host, port
        self._listener: socket.socket | None = None

    @property
    def local_address(self) -> Address:
        """Host and port of the open socket; `("", 0)` while closed."""
        return bound_address(self._listener)

    async def open(self) -> None:
        """Bind and listen."""
        address = await resolve(self.name, self._host, self._port)
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            # For TCP this only skips the wait for old connections; a taken port still fails.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            raise LinkError(bind_problem("tcp", self._host, self._port, error)) from error
        listener.setblocking(False)
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept)

    @abstractmethod
    def _objection(self) -> str | None:
        """Return the reason why another client must be refused; None if it is accepted."""

    @abstractmethod
    def _welcome(self, client: socket.socket, peer: Address) -> None:
        """Accept a client."""

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            client, (host, port) = self._listener.accept()
        except OSError:  # the client left again, or no descriptors are left
            self.counters.receive_errors += 1
            return
        objection = self._objection()
        if objection is not None:
            logger.info("%s: %s turned away, %s", self.name, host, objection)
            client.close()
            return
        client.setblocking(False)
        tune(client)
        self._welcome(client, (str(host), int(port)))

    def _close_port(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None


class TcpServerLink(TcpListener, StreamLink):
    """Listening TCP port that serves one client at a time; others are refused."""

    def _objection(self) -> str | None:
        return None if self._stream is None else "one client at a time"

    def _welcome(self, client: socket.socket, peer: Address) -> None:
        del peer
        self._use_stream(client, client.fileno())

    def close(self) -> None:
        """Close the client and the port."""
        super().close()
        self._close_port()


class TcpFanOutLink(TcpListener):
    """TCP port for 16 clients; a chunk without a peer goes to all.

    When all slots are taken, a new client replaces the oldest one that never sent MAVLink.
    """

    def __init__(self, host: str, port: int, index: int, received: Received) -> None:
        super().__init__(host, port, index, received)
        self._clients: dict[Address, ByteStream] = {}
        self._proved: set[Address] = set()
        """Clients that sent a MAVLink frame."""

    @property
    def clients(self) -> tuple[Address, ...]:
        """Connected clients, in the order of their connection."""
        return tuple(self._clients)

    def send(self, chunk: Chunk) -> None:
        """Send to the chunk's peer, or to all clients if it names none."""
        if chunk.peer is not None:
            self._write(self._clients.get(chunk.peer), chunk.data)
            return
        for peer, client in list(self._clients.items()):
            if peer not in chunk.except_peers:
                self._write(client, chunk.data)

    def close(self) -> None:
        """Close all clients and the port."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._close_port()

    def _write(self, client: ByteStream | None, data: bytes) -> None:
        if client is not None and client.write(data):
            self.counters.sent += 1
        else:
            self.counters.dropped += 1

    def _objection(self) -> str | None:
        if len(self._clients) < MAX_CLIENTS:
            return None
        stranger = next((peer for peer in self._clients if peer not in self._proved), None)
        if stranger is None or not self.expects_mavlink:
            return f"{MAX_CLIENTS} clients at most"
        self._clients[stranger].close()
        self._forget(stranger, "it never sent MAVLink")
        return None

    def _welcome(self, client: socket.socket, peer: Address) -> None:
        logger.info("%s: %s:%d connected", self.name, *peer)
        self._clients[peer] = ByteStream(
            client,
            client.fileno(),
            lambda pieces: self._take(peer, pieces),
            lambda reason: self._forget(peer, reason),
        )

    def _take(self, peer: Address, pieces: list[bytes]) -> None:
        self.counters.received += len(pieces)
        if peer not in self._proved and has_frame(pieces):
            self._proved.add(peer)
        self._received([Chunk(self.index, piece, peer, is_datagram=False) for piece in pieces])

    def _forget(self, peer: Address, reason: str) -> None:
        self._clients.pop(peer, None)
        self._proved.discard(peer)
        self.counters.send_errors += reason != "closed by the other end"
        logger.info("%s: %s:%d lost (%s)", self.name, *peer, reason)
        self._received([Chunk(self.index, b"", peer, is_datagram=False)])
