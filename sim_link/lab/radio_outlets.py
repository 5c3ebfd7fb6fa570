"""Where an emulated radio's bytes go beside serial lines, UDP and TCP: standard output and HTTP.

A radio that is polled serves one document, its latest; until there is one, and for any other path
than its own and `/`, it answers 404, as the real ones do.
"""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from urllib.parse import urlsplit

from companion.errors import ConfigError, LinkError
from companion.io.links.link import Link, bind_problem
from companion.io.links.transports import OwnLine, Transport, UdpBind, parse_transport
from companion.mav.endpoint import Address, Chunk
from sim_link.emulators.emulator import Emulator

REQUEST_S = 5.0
"""Wall seconds that a client may take for its request."""
MOST_HEADERS = 100
EXAMPLES = "pty:/tmp/radio, udpout:127.0.0.1:14700, tcpin:127.0.0.1:14700, stdout:"


@dataclass(frozen=True, slots=True)
class PageAddress:
    """A port of this machine where a document is asked for."""

    host: str
    port: int
    path: str


def is_stdout(text: str) -> bool:
    """Whether `--to` is standard output, which then is no place to tell people."""
    return text.strip().partition(":")[0].lower() == "stdout"


def parse_outlet(text: str, kind: type[Emulator]) -> Transport:
    """Where `--to` leads; a `ConfigError` shows a right one."""
    scheme = text.strip().partition(":")[0].lower()
    if kind.request and (is_stdout(text) or scheme.startswith("udp")):
        raise ConfigError(
            f"--to {text}: {kind.name} only answers; give pty:PATH or tcpin:HOST:PORT"
        )
    if is_stdout(text):
        return OwnLine("stdout:", lambda index, _: StdoutLink(index))
    if scheme == "http":
        page = parse_page(text.strip(), kind)
        return OwnLine(f"http:{page.host}:{page.port}", lambda index, _: HttpLink(page, index))
    try:
        transport = parse_transport(text)
    except ConfigError as error:
        raise ConfigError(f"--to {text}: {error}; or one of {EXAMPLES}, http:HOST:PORT") from None
    if isinstance(transport, UdpBind):
        raise ConfigError(f"--to {text}: a radio sends first, give udpout:HOST:PORT")
    return transport


def parse_page(text: str, kind: type[Emulator]) -> PageAddress:
    """Of `http:HOST:PORT`; a `ConfigError` shows a right one."""
    if kind.document is None:
        raise ConfigError(f"--to {text}: {kind.name} is not polled; give {EXAMPLES}")
    rest = text.partition(":")[2].removeprefix("//")
    try:
        parts = urlsplit(f"http://{rest}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or not port:
        raise ConfigError(f"--to {text}: give http:HOST:PORT, for example http:127.0.0.1:8081")
    return PageAddress(host, port, kind.document)


class StdoutLink(Link):
    """Standard output, whole rounds at once; input is not heard."""

    def __init__(self, index: int) -> None:
        super().__init__("stdout", index, lambda _: None)

    async def open(self) -> None:
        """It is open."""

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
        """It stays open."""


class HttpLink(Link):
    """A port that answers every question for the document with the latest."""

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
        """From now on this is the document."""
        self._document = chunk.data
        self.counters.sent += 1

    def close(self) -> None:
        """Close the port; who is being answered is left alone."""
        if self._server is not None:
            self._server.close()
            self._server = None

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, TimeoutError, ValueError, asyncio.IncompleteReadError):
            async with asyncio.timeout(REQUEST_S):
                path = await _path_asked(reader)
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


async def _path_asked(reader: asyncio.StreamReader) -> str:
    """Of a GET; empty for anything else."""
    words = (await reader.readline()).decode("latin-1").split()
    for _ in range(MOST_HEADERS):
        if not (await reader.readline()).strip():
            break
    return words[1].partition("?")[0] if len(words) == 3 and words[0] == "GET" else ""
