"""Web socket as a stream of bytes: KrakenSDR's suite of 2026, metrics of srsRAN Project.

Theory of operation. A thread connects, sends each line of the greeting as a text message, and hands
over what arrives: a text message as a line, a binary one as the frame that a server puts on the
wire (RFC 6455, section 5.2: unmasked, whole), because its length must go with it. A lost connection
is retried. The certificate of `wss:` is not checked: such devices sign their own.
"""

from __future__ import annotations

import ssl
import struct
from typing import TYPE_CHECKING

from companion.errors import LinkError, how_to_install
from companion.io.links.link import Received
from companion.io.links.waiting_links import MOST_PAGE_BYTES, TIMEOUT_S, WaitingLink

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

LOOK_S = 0.5
"""Interval at which a silent connection checks for its end."""
RETRY_S = 1.0
BINARY = 0x82
"""First byte of a whole binary frame."""
SHORT, MEDIUM = 126, 1 << 16
"""Sizes from which on the length has two and eight bytes of its own."""


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
                    self._read(connection)
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
            close_timeout=LOOK_S,
            max_size=MOST_PAGE_BYTES,
        )

    def _read(self, connection: ClientConnection) -> None:
        """Hand over messages until the connection ends."""
        while not self._stop.is_set():
            try:
                message = connection.recv(timeout=LOOK_S)
            except TimeoutError:
                continue
            self._hand_over(on_the_wire(message))
