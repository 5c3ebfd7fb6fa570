"""Links of radios: an address as of any link, a page to poll, a program, a file, standard input.

The kind of radio fills in what an address leaves out: the speed of a serial port, the scheme and
port of a host, the path of a page.
"""

from __future__ import annotations

import urllib.parse
from collections.abc import Callable
from pathlib import Path

from companion.errors import ConfigError
from companion.io.links.link import Link, Received
from companion.io.links.program_links import ExecLink, StdinLink
from companion.io.links.transports import (
    DEFAULT_BAUD,
    FlightLink,
    OwnLine,
    TcpServer,
    Transport,
    UdpBind,
    make_link,
    parse_transport,
)
from companion.io.links.waiting_links import FileLink, HttpPollLink, PlayedFileLink, WebSocketLink
from companion.link.interface import LinkRole, LinkSpec
from companion.link.radio_settings import RadioSetup
from companion.radios.decoder import Poll

DEFAULT_POLL = Poll("/", 1.0)
"""Polling of a page where the radio's kind does not define it."""
Make = Callable[[int, Received], Link]


def radio_link(setup: RadioSetup, url: str, *, is_probed: bool = False) -> FlightLink:
    """Return the link of a radio at `url`; a `ConfigError` shows a correct address.

    With `is_probed` a module that must be addressed by name is asked for its own name instead.
    """
    address, make, listens_at = _line(setup, url.strip())
    decoder, poll = setup.kind.decoder(setup.options), setup.kind.poll or DEFAULT_POLL
    greeting, request = decoder.hello(), decoder.request() or poll.request
    request = request or (poll.probe if is_probed else b"")
    if address.startswith("stdin:"):
        greeting = request = b""  # files and pages cannot be written to
    is_asked = request or address.partition(":")[0].lower() in ("http", "https", "exec")
    if setup.settings.poll_s is not None and not is_asked:
        asks = "`lines` has the option `request` for what to ask"
        if "tag" in setup.kind.decoder.Options.__struct_fields__:
            asks = "the option `tag` is the tag to poll"
        raise ConfigError(f"radio {setup.kind.name}: poll_s: nothing is asked at {url}; {asks}")

    def greeted(index: int, received: Received) -> Link:
        """Return the link, which sends the radio's greeting and reports when the radio is gone."""
        link = make(index, received)
        link.greeting, link.signals_loss = greeting, True
        link.request, link.request_period_s = request, setup.settings.poll_s or poll.period_s
        return link

    line = OwnLine(address, greeted, listens_at)
    return FlightLink(line, LinkSpec(LinkRole.RANGING, setup))


def _line(setup: RadioSetup, url: str) -> tuple[str, Make, UdpBind | TcpServer | None]:
    scheme, _, rest = url.partition(":")
    match scheme.lower():
        case "http" | "https":
            return _page(setup, url)
        case "ws" | "wss":
            return _socket(setup, url)
        case "stdin":
            return "stdin:", StdinLink, None
        case "exec":
            if not rest.strip():
                raise _wrong(url, "needs a command, for example exec:cat /tmp/radio.txt")
            poll = setup.kind.poll
            is_run_again = poll is not None and not poll.request and not poll.probe
            usual_s = poll.period_s if poll is not None and is_run_again else None
            period_s = setup.settings.poll_s or usual_s
            return url, lambda index, received: ExecLink(rest, period_s, index, received), None
        case "file":
            return _file(setup, url, rest)
    transport = _transport(setup, url)
    if isinstance(transport, OwnLine):
        return str(transport), transport.make, None
    listens_at = transport if isinstance(transport, UdpBind | TcpServer) else None
    return str(transport), lambda index, received: make_link(transport, index, received), listens_at


def _transport(setup: RadioSetup, url: str) -> Transport:
    """Return the transport of an ordinary address, with the defaults of the radio's kind."""
    usual, _, detail = setup.kind.transport.partition(":")
    detail = detail.partition("/")[0]
    baud = int(detail) if usual == "serial" and detail.isdigit() else DEFAULT_BAUD
    if url.startswith("/"):
        return parse_transport(f"serial:{url}", baud)
    head = url.partition(":")[0].lower()
    if head not in ("udp", "udpin", "udpout", "tcp", "tcpin", "tcpout", "serial", "pty"):
        host = url if ":" in url or not detail else f"{url}:{detail}"
        if usual in ("http", "https", "ws", "wss"):
            page_or_socket = _page if usual in ("http", "https") else _socket
            address, make, _ = page_or_socket(setup, f"{usual}://{host}")
            return OwnLine(address, make)
        if usual in ("udp", "tcp"):
            return parse_transport(f"{usual}:{host}")
    try:
        return parse_transport(url, baud)
    except ConfigError as error:
        more = (
            "; or http://, wss://, exec:, file:, stdin:" if "must begin with" in str(error) else ""
        )
        raise ConfigError(f"radio {setup.kind.name}: {error}{more}") from None


def _socket(setup: RadioSetup, url: str) -> tuple[str, Make, None]:
    parts = _parts(url, "web socket, for example wss://192.168.1.10:8080/ws")
    if parts.path in ("", "/"):
        parts = parts._replace(path="/" + setup.kind.transport.partition("/")[2])
    full = urllib.parse.urlunsplit(parts)
    return full, lambda index, received: WebSocketLink(full, index, received), None


def _parts(url: str, what: str) -> urllib.parse.SplitResult:
    """Return the parts of an address with a host; a `ConfigError` shows a correct one."""
    parts = urllib.parse.urlsplit(url)
    try:
        is_right = bool(parts.hostname) and parts.username is None and parts.port != 0
    except ValueError:
        is_right = False
    if not is_right:
        raise _wrong(url, f"is no address of a {what}")
    return parts


def _page(setup: RadioSetup, url: str) -> tuple[str, Make, None]:
    poll = setup.kind.poll or DEFAULT_POLL
    parts = _parts(url, "page, for example http://192.168.1.10:8081/")
    if parts.path in ("", "/"):
        parts = parts._replace(path=poll.path or "/")
    full = urllib.parse.urlunsplit(parts)
    period_s = setup.settings.poll_s or poll.period_s
    return full, lambda index, received: HttpPollLink(full, period_s, index, received), None


def _file(setup: RadioSetup, url: str, rest: str) -> tuple[str, Make, None]:
    """Return the link of `file:PATH`, a followed file, or `file:PATH?play[=SPEED]`, a playback."""
    name, _, query = rest.removeprefix("//").partition("?")
    path, (key, _, value) = Path(name), query.partition("=")
    if not name or key not in ("", "play"):
        raise _wrong(url, "is no file, for example file:log.txt, or file:log.txt?play=1")
    if not key:
        return url, lambda index, received: FileLink(path, index, received), None
    try:
        speed = float(value or 1.0)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed <= 1000.0:
        raise _wrong(url, f"`{value}` is no speed, for example play=2")
    radio = setup.kind.name
    return (
        url,
        lambda index, received: PlayedFileLink(path, radio, speed, index, received),
        None,
    )


def _wrong(url: str, problem: str) -> ConfigError:
    return ConfigError(f"radio at `{url}`: {problem}")
