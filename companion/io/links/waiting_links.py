"""Links with blocking reads, each in its own thread: polled web pages, files, web sockets.

Theory of operation. A server that hangs and a disk that sleeps block a thread, never the loop. The
thread hands over what it has read in pieces and waits until they are taken, so that nothing grows
when the loop is late. A loss and a return are each reported once. An empty piece means that an
unfinished message will not be completed.

Web sockets: KrakenSDR's suite of 2026, metrics of srsRAN Project. The thread connects, sends each
line of the greeting as a text message, and hands over what arrives: a text message as a line, a
binary one as the frame that a server puts on the wire (RFC 6455, section 5.2: unmasked, whole),
because its length must go with it. A lost connection is retried. The certificate of `wss:` is not
checked: such devices sign their own.
"""

from __future__ import annotations

import asyncio
import http.client
import os
import ssl
import struct
import threading
import time
import urllib.parse
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from companion.errors import CompanionError, LinkError, how_to_install
from companion.io.links.link import Link, Received, logger
from companion.io.radio_recording import RadioBytes, is_radio_recording, read_radio_recording
from companion.mav.endpoint import Chunk

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

PIECE_BYTES = 4096
TIMEOUT_S = 2.0
"""Timeout of a connection, and of each part of an answer."""
WHOLE_TIMEOUT_S = 5.0
"""Timeout of a whole answer."""
MAX_PAGE_BYTES = 1_000_000
FILE_LOOK_S = 0.05
LINES_PER_S = 10.0
"""Rate of a file without times during playback."""


class WaitingLink(Link):
    """Link that a daemon thread reads."""

    def __init__(self, name: str, index: int, received: Received) -> None:
        super().__init__(name, index, received)
        self._stop = threading.Event()
        self._room = threading.Semaphore(1)
        self._loop: asyncio.AbstractEventLoop | None = None

    @property
    def is_open(self) -> bool:
        """Return True while it reads or tries to."""
        return not self._stop.is_set()

    async def open(self) -> None:
        """Begin to read."""
        self._check()
        self._loop = asyncio.get_running_loop()
        threading.Thread(target=self._work, name=self.name, daemon=True).start()

    def close(self) -> None:
        """Stop; the thread follows when it no longer waits."""
        self._stop.set()

    def _check(self) -> None:
        """Raise a `LinkError` if this configuration can never work."""

    @abstractmethod
    def _work(self) -> None:
        """Read in the thread until `_stop` is set."""

    def _hand_over(self, data: bytes) -> None:
        """Hand bytes to the loop, and wait until the earlier ones are taken."""
        while not self._room.acquire(timeout=0.5):
            if self._stop.is_set():
                return
        assert self._loop is not None
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._take, data)

    def _take(self, data: bytes) -> None:
        self._room.release()
        if self._stop.is_set():
            return
        pieces = [data[i : i + PIECE_BYTES] for i in range(0, len(data), PIECE_BYTES)] or [data]
        self.counters.received += len(pieces)
        self._received([Chunk(self.index, piece, is_datagram=False) for piece in pieces])

    def _note_lost(self, reason: str) -> None:
        if self._is_lost or self._stop.is_set():
            return
        self._is_lost = True
        self.counters.last_error = reason
        logger.warning("%s: lost (%s); retrying", self.name, reason)
        if self.signals_loss:
            self._hand_over(b"")


class HttpPollLink(WaitingLink):
    """Page that is requested periodically, over one connection while it lasts."""

    def __init__(self, url: str, period_s: float, index: int, received: Received) -> None:
        parts = urllib.parse.urlsplit(url)
        super().__init__(f"{parts.scheme} {parts.netloc}", index, received)
        self._parts = parts
        self._period_s = period_s
        self._connection: http.client.HTTPConnection | None = None
        self._is_new = True
        """True until the first page has arrived."""

    def _work(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + self._period_s, time.monotonic())
            try:
                page = self._ask()
            except (OSError, http.client.HTTPException, ValueError) as error:
                self._disconnect()
                self._note_lost(str(error) or type(error).__name__)
                continue
            self._note_back()
            if page:
                self._hand_over(page if page.endswith(b"\n") else page + b"\n")
        self._disconnect()

    def _ask(self) -> bytes:
        """Return the page; if the server closed an idle connection, request it on a new one."""
        try:
            return self._page(self._connection or self._connected())
        except (http.client.RemoteDisconnected, ConnectionError):
            if self._is_new:
                raise
            self._disconnect()
            return self._page(self._connected())

    def _connected(self) -> http.client.HTTPConnection:
        is_tls = self._parts.scheme == "https"
        kind = http.client.HTTPSConnection if is_tls else http.client.HTTPConnection
        self._connection, self._is_new = kind(self._parts.netloc, timeout=TIMEOUT_S), True
        return self._connection

    def _page(self, connection: http.client.HTTPConnection) -> bytes:
        path = self._parts.path + (f"?{self._parts.query}" if self._parts.query else "")
        connection.request("GET", path, headers={"Accept": "*/*"})
        answer = connection.getresponse()
        page, until_s = bytearray(), time.monotonic() + WHOLE_TIMEOUT_S
        while piece := answer.read1(65_536):
            page += piece
            if len(page) > MAX_PAGE_BYTES:
                raise ValueError("the page is too large")
            if time.monotonic() > until_s:
                raise TimeoutError("the answer takes too long")
        answer.read()  # used up, but only closing it frees the connection
        if answer.status != http.client.OK:
            raise ValueError(f"HTTP {answer.status} {answer.reason}")
        self._is_new = False
        return bytes(page)

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _check_regular(path: Path, name: str) -> None:
    if not path.is_file():
        problem = "is no regular file" if path.exists() else "there is no such file"
        raise LinkError(f"{name}: {problem}")


class FileLink(WaitingLink):
    """Growing file, read from its current end; a new file of its name from the beginning."""

    def __init__(self, path: Path, index: int, received: Received) -> None:
        super().__init__(f"file {path}", index, received)
        self._path = path

    def _check(self) -> None:
        _check_regular(self._path, self.name)

    def _work(self) -> None:
        is_first = True
        while not self._stop.is_set():
            try:
                with self._path.open("rb") as file:
                    self._note_back()
                    if is_first:
                        file.seek(0, os.SEEK_END)
                        is_first = False
                    self._follow(file.fileno())
            except OSError as error:
                self._note_lost(error.strerror or str(error))
            self._stop.wait(10.0 * FILE_LOOK_S)

    def _follow(self, fd: int) -> None:
        """Deliver appended data until the file is replaced or truncated."""
        inode = os.fstat(fd).st_ino
        while not self._stop.is_set():
            data = os.read(fd, 65_536)
            if data:
                self._hand_over(data)
                continue
            now = self._path.stat()
            if now.st_ino != inode or now.st_size < os.lseek(fd, 0, os.SEEK_CUR):
                return
            self._stop.wait(FILE_LOOK_S)


class PlayedFileLink(WaitingLink):
    """File that is played back once: a radio recording at its own times, others line by line.

    Of a recording the first radio called `radio` is played, or else the first one.
    """

    def __init__(
        self, path: Path, radio: str, speed: float, index: int, received: Received
    ) -> None:
        super().__init__(f"file {path}", index, received)
        self._path, self._radio, self._speed = path, radio, speed

    def _check(self) -> None:
        _check_regular(self._path, self.name)

    def _work(self) -> None:
        began_s = time.monotonic()
        try:
            is_recording = is_radio_recording(self._path)
            for time_s, data in self._recorded() if is_recording else self._lines():
                if self._stop.wait(max(0.0, began_s + time_s / self._speed - time.monotonic())):
                    return
                self._hand_over(data)
        except (OSError, CompanionError) as error:
            self._note_lost(str(error))
            return
        logger.info("%s: played to its end", self.name)

    def _recorded(self) -> Iterator[tuple[float, bytes]]:
        header, records = read_radio_recording(self._path)
        names = [radio.name for radio in header.radios]
        wanted = names.index(self._radio) if self._radio in names else 0
        first_s: float | None = None
        for record in records:
            if isinstance(record, RadioBytes) and record.radio == wanted:
                first_s = record.t_s if first_s is None else first_s
                yield record.t_s - first_s, record.data

    def _lines(self) -> Iterator[tuple[float, bytes]]:
        with self._path.open("rb") as file:
            number = 0
            while line := file.readline(65_536):
                yield number / LINES_PER_S, line
                number += 1


CHECK_S = 0.5
"""Interval at which a silent connection checks for its end."""
RETRY_S = 1.0
BINARY = 0x82
"""First byte of a whole binary frame."""
SHORT, MEDIUM = 126, 1 << 16
"""Sizes from which the length has two and eight bytes of its own."""


def on_the_wire(message: str | bytes) -> bytes:
    """Return a text message as a line, and a binary one as a server's frame."""
    if isinstance(message, str):
        return message.rstrip("\r\n").encode() + b"\n"
    size = len(message)
    if size < SHORT:
        return bytes((BINARY, size)) + message
    if size < MEDIUM:
        return struct.pack(">BBH", BINARY, SHORT, size) + message
    return struct.pack(">BBQ", BINARY, SHORT + 1, size) + message


class WebSocketLink(WaitingLink):
    """Web socket of another computer."""

    def __init__(self, url: str, index: int, received: Received) -> None:
        super().__init__(url, index, received)
        self._url = url

    def _check(self) -> None:
        try:
            import websockets.sync.client  # noqa: F401 -- an extra
        except ImportError:
            hint = how_to_install("websockets")
            raise LinkError(f"{self.name}: web sockets need a package; {hint}") from None

    def _work(self) -> None:
        from websockets.exceptions import WebSocketException

        while not self._stop.is_set():
            try:
                with self._connected() as connection:
                    self._note_back()
                    for line in self.greeting.decode().splitlines():
                        connection.send(line)
                    while not self._stop.is_set():
                        try:
                            message = connection.recv(timeout=CHECK_S)
                        except TimeoutError:
                            continue
                        self._hand_over(on_the_wire(message))
            except (OSError, EOFError, ValueError, WebSocketException) as error:
                self._note_lost(str(error) or type(error).__name__)
            self._stop.wait(RETRY_S)

    def _connected(self) -> ClientConnection:
        from websockets.sync.client import connect

        tls = None
        if self._url.startswith(
            "wss:"
        ):  # devices sign their own certificates, so wss: proves no more than ws:
            tls = ssl.create_default_context()
            tls.check_hostname, tls.verify_mode = False, ssl.CERT_NONE
        return connect(
            self._url,
            ssl=tls,
            compression=None,
            proxy=None,
            open_timeout=TIMEOUT_S,
            close_timeout=CHECK_S,
            max_size=MAX_PAGE_BYTES,
        )
