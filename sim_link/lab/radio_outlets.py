"""Outlets of an emulated radio besides serial lines, UDP and TCP: stdout, HTTP, web sockets.

A web socket's client gets the initial messages, and all later frames. A radio
that is polled serves one document, its latest; until there is one, and for any other path
than its own and `/`, it answers 404, as the real ones do.
"""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from companion.errors import ConfigError, LinkError, how_to_install
from companion.io.links.link import Link, bind_problem
from companion.io.links.transports import OwnLine, Transport, UdpBind, parse_transport
from companion.mav.endpoint import Address, Chunk
from sim_link.emulators.emulator import Emulator

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection

REQUEST_S = 5.0
"""Wall seconds that a client may take for its request."""
MAX_HEADERS = 100
EXAMPLES = "pty:/tmp/radio, udpout:127.0.0.1:14700, tcpin:127.0.0.1:14700, stdout:"


@dataclass(frozen=True, slots=True)
class PageAddress:
    """A port of this machine where a document is asked for."""

    host: str
    port: int
    path: str


def is_stdout(text: str) -> bool:
    """Return True if `--to` is standard output, which then must not carry texts for people."""
    return text.strip().partition(":")[0].lower() == "stdout"


def parse_outlet(text: str, kind: type[Emulator]) -> Transport:
    """Parse `--to`; the `ConfigError` for a wrong one shows a right one."""
    scheme = text.strip().partition(":")[0].lower()
    if kind.request and (is_stdout(text) or scheme.startswith("udp")):
        raise ConfigError(
            f"--to {text}: {kind.name} only answers; give pty:PATH or tcpin:HOST:PORT"
        )
    if is_stdout(text):
        return OwnLine("stdout:", lambda index, _: StdoutLink(index))
    if kind.socket is not None and scheme != "ws":
        raise ConfigError(f"--to {text}: {kind.name} is a web socket; give ws:HOST:PORT")
    if scheme in ("ws", "http"):
        page, serve = parse_page(text.strip(), kind), SocketLink if scheme == "ws" else HttpLink
        return OwnLine(f"{scheme}:{page.host}:{page.port}", lambda index, _: serve(page, index))
    try:
        transport = parse_transport(text)
    except ConfigError as error:
        raise ConfigError(f"--to {text}: {error}; or one of {EXAMPLES}, http:HOST:PORT") from None
    if isinstance(transport, UdpBind):
        raise ConfigError(f"--to {text}: a radio sends first, give udpout:HOST:PORT")
    return transport


def parse_page(text: str, kind: type[Emulator]) -> PageAddress:
    """Return the address in `http:HOST:PORT` or `ws:HOST:PORT`; a `ConfigError` shows one."""
    scheme = text.partition(":")[0].lower()
    path = kind.socket if scheme == "ws" else kind.document
    if path is None:
        what = "has no web socket" if scheme == "ws" else "is not polled"
        raise ConfigError(f"--to {text}: {kind.name} {what}; give {EXAMPLES}")
    rest = text.partition(":")[2].removeprefix("//")
    try:
        parts = urlsplit(f"http://{rest}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or not port:
        example = f"{scheme}:HOST:PORT, for example {scheme}:127.0.0.1:8081"
        raise ConfigError(f"--to {text}: give {example}")
    return PageAddress(host, port, path)


class StdoutLink(Link):
    """Standard output, whole rounds at once; input is not heard."""

    def __init__(self, index: int) -> None:
        super().__init__("stdout", index, lambda _: None)

    async def open(self) -> None:
        """Do nothing: it is open."""

    def send(self, chunk: Chunk) -> None:
        """Write at once; a reader that went away is counted."""
        try:
            sys.stdout.flush()
            os.write(sys.stdout.fileno(), chunk.data)
            self.counters.sent += 1
        except OSError as error:
            self.counters.send_errors += 1
            self.counters.last_error = str(error)

    def close(self) -> None:
        """Do nothing: it stays open."""


class SocketLink(Link):
    """Port that serves a web socket; `websockets` handles handshake, pings and closing."""

    def __init__(self, page: PageAddress, index: int) -> None:
        super().__init__(f"ws {page.host}:{page.port}", index, lambda _: None)
        self._page = page
        self._first: list[str | bytes] = []
        self._clients: set[ServerConnection] = set()
        self._server: Server | None = None

    async def open(self) -> None:
        """Bind and listen."""
        try:
            from websockets.asyncio.server import serve
        except ImportError:
            hint = how_to_install("websockets")
            raise LinkError(f"{self.name}: web sockets need a package; {hint}") from None
        host, port = self._page.host, self._page.port
        try:
            self._server = await serve(self._answer, host, port)
        except OSError as error:
            raise LinkError(bind_problem("ws", host, port, error)) from error

    def send(self, chunk: Chunk) -> None:
        """Send each message to every client; the text messages of the beginning are kept."""
        from websockets.asyncio.server import broadcast

        self.counters.sent += 1
        for message in messages_of(chunk.data):
            broadcast(self._clients, message)
            if isinstance(message, str):
                self._first.append(message)

    def close(self) -> None:
        """Close the port and all connections."""
        if self._server is not None:
            self._server.close()
            self._server = None

    async def _answer(self, client: ServerConnection) -> None:
        if client.request is None or client.request.path != self._page.path:
            return
        for message in self._first:
            await client.send(message)
        self._clients.add(client)
        try:
            async for _ in client:
                self.counters.received += 1
        finally:
            self._clients.discard(client)


def messages_of(frames: bytes) -> list[str | bytes]:
    """Return the messages of whole frames from a server."""
    messages: list[str | bytes] = []
    at = 0
    while at < len(frames):
        opcode, length = frames[at] & 0x0F, frames[at + 1]
        at += 2
        extra = {126: 2, 127: 8}.get(length, 0)
        if extra:
            length = int.from_bytes(frames[at : at + extra], "big")
        payload = frames[at + extra : at + extra + length]
        messages.append(payload.decode() if opcode == 1 else payload)
        at += extra + length
    return messages


class HttpLink(Link):
    """A port that answers every request for the document with the latest one."""

    def __init__(self, page: PageAddress, index: int) -> None:
        super().__init__(f"http {page.host}:{page.port}", index, lambda _: None)
        self._page = page
        self._document: bytes | None = None
        self._server: asyncio.Server | None = None

    @property
    def local_address(self) -> Address:
        """Host and port that the open socket has; `("", 0)` while closed."""
        if self._server is None:
            return ("", 0)
        host, port = self._server.sockets[0].getsockname()[:2]
        return (str(host), int(port))

    async def open(self) -> None:
        """Bind and listen."""
        host, port = self._page.host, self._page.port
        try:
            self._server = await asyncio.start_server(self._answer, host, port)
        except OSError as error:
            raise LinkError(bind_problem("http", host, port, error)) from error

    def send(self, chunk: Chunk) -> None:
        """Serve this document from now on."""
        self._document = chunk.data
        self.counters.sent += 1

    def close(self) -> None:
        """Close the port; a client that is being answered is served to the end."""
        if self._server is not None:
            self._server.close()
            self._server = None

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, TimeoutError, ValueError, asyncio.IncompleteReadError):
            async with asyncio.timeout(REQUEST_S):
                words = (await reader.readline()).decode("latin-1").split()
                for _ in range(MAX_HEADERS):
                    if not (await reader.readline()).strip():
                        break
                path = words[1].partition("?")[0] if len(words) == 3 and words[0] == "GET" else ""
                writer.write(self._response(path))
                await writer.drain()
        writer.close()

    def _response(self, path: str) -> bytes:
        is_known = path in ("/", self._page.path) and self._document is not None
        body = self._document if is_known and self._document is not None else b"not found\n"
        status = "200 OK" if is_known else "404 Not Found"
        self.counters.received += 1
        head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {len(body)}"
        return f"{head}\r\nConnection: close\r\n\r\n".encode() + body
