"""Addresses of links as MAVLink tools write them, and which of them need a signing key.

`udp:HOST:PORT` and `udpin:` both bind and listen, as in pymavlink; MAVSDK's old `udp://HOST:PORT`
sends instead, and is read here as the same thing as `udp:HOST:PORT`. `udpout:` sends first.
`make_link` turns a transport into a link that sends and receives. Links that others on the network
can reach are opened only with a signing key.

Links of radios: an address as of any link, a page to poll, a program, a file, standard input.

The kind of radio fills in what an address leaves out: the speed of a serial port, the scheme and
port of a host, the path of a page.
"""

from __future__ import annotations

import ipaddress
import urllib.parse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ConfigError
from companion.io.links.byte_streams import SerialLink, TcpClientLink
from companion.io.links.link import Link, Received
from companion.io.links.stream_links import (
    ExecLink,
    PtyLink,
    StdinLink,
    TcpFanOutLink,
    TcpServerLink,
)
from companion.io.links.udp import UdpConnectLink, UdpFanOutLink, UdpLink
from companion.io.links.waiting_links import FileLink, HttpPollLink, PlayedFileLink, WebSocketLink
from companion.link.interface import LinkRole, LinkSpec, RadioSetup
from companion.mav.endpoint import Address
from companion.radios.decoder import Poll

DEFAULT_BAUD = 921_600
"""Serial speed where none is given: PX4's default for TELEM2, its companion port."""
OWN_HOST = "127.0.0.1"
"""Loopback address, used for an empty host when listening."""


@dataclass(frozen=True, slots=True)
class _AtPort:
    host: str
    port: int

    def __str__(self) -> str:
        """Return the canonical spelling, which parses to the same address."""
        return f"{_SCHEME[type(self)]}:{self.host}:{self.port}"


class UdpBind(_AtPort):
    """UDP port that binds and waits; a chunk goes to the peer it names, else it is dropped."""


@dataclass(frozen=True, slots=True)
class UdpFanOut(_AtPort):
    """UDP port; a chunk without a peer goes to all `remotes` and the last 16 senders heard."""

    remotes: tuple[Address, ...] = ()


class UdpConnect(_AtPort):
    """UDP socket on a free port that sends first, to one remote, and receives only from it."""


class TcpClient(_AtPort):
    """TCP client that reconnects after a loss."""


class TcpServer(_AtPort):
    """TCP server for one client at a time."""


class TcpFanOut(_AtPort):
    """TCP server for several clients; a chunk without a peer goes to all of them."""


@dataclass(frozen=True, slots=True)
class Pty:
    """Pseudo terminal that others open as a serial port under `path`."""

    path: str

    def __str__(self) -> str:
        return f"pty:{self.path}"


@dataclass(frozen=True, slots=True)
class SerialPort:
    """Serial device, reopened after it was unplugged."""

    device: str
    baud: int = DEFAULT_BAUD

    def __str__(self) -> str:
        return f"serial:{self.device}:{self.baud}"


@dataclass(frozen=True, slots=True)
class OwnLine:
    """Transport that creates its own link; only radios have such."""

    address: str
    make: Callable[[int, Received], Link]
    listens_at: UdpBind | TcpServer | None = None
    """Transport to which others send; None if it does not listen."""

    def __str__(self) -> str:
        return self.address


Transport = (
    UdpBind
    | UdpFanOut
    | UdpConnect
    | TcpClient
    | TcpServer
    | TcpFanOut
    | Pty
    | SerialPort
    | OwnLine
)
Line = Pty | SerialPort
"""Links that no other computer can receive."""
Listening = UdpBind | UdpFanOut | TcpServer | TcpFanOut

_PORTS: dict[str, type[UdpBind | UdpConnect | TcpClient | TcpServer]] = {
    "udp": UdpBind,
    "udpin": UdpBind,
    "udpout": UdpConnect,
    "tcpout": TcpClient,
    "tcp": TcpClient,
    "tcpin": TcpServer,
}
_SCHEME: dict[type[_AtPort], str] = {kind: scheme for scheme, kind in _PORTS.items()}
_SCHEME |= {UdpFanOut: "udpin", TcpFanOut: "tcpin"}
_EXAMPLES = {
    "udp": "udp:127.0.0.1:14550",
    "udpin": "udp:127.0.0.1:14550",
    "udpout": "udpout:127.0.0.1:14580",
    "tcp": "tcp:127.0.0.1:5760",
    "tcpout": "tcp:127.0.0.1:5760",
    "tcpin": "tcpin:127.0.0.1:5760",
    "serial": f"serial:/dev/ttyACM0:{DEFAULT_BAUD}",
    "pty": "pty:/tmp/vehicle",
}


def parse_transport(text: str, default_baud: int = DEFAULT_BAUD) -> Transport:
    """Return the transport of the address `text`; a `ConfigError` shows a correct one.

    That is `udp:`, `udpin:`, `udpout:`, `tcp:`, `tcpout:` or `tcpin:` with `HOST:PORT`,
    `serial:DEVICE[:BAUD]`, `pty:PATH` or a bare `/dev/...`; `kind://` is read as `kind:`.
    """
    stripped = text.strip()
    if stripped.startswith("/dev/"):
        return _parse_serial(text, stripped, default_baud)
    scheme, separator, rest = stripped.partition(":")
    scheme, rest = scheme.lower(), rest.removeprefix("//")
    if scheme not in _EXAMPLES or not separator:
        known = ", ".join(f"{name}:" for name in _EXAMPLES)
        raise ConfigError(
            f"link `{text}`: must begin with {known} or /dev/, for example {_EXAMPLES['udp']}"
        )
    if scheme == "serial":
        return _parse_serial(text, rest, default_baud)
    if scheme == "pty":
        if not rest.startswith("/"):
            raise _wrong(text, scheme, "needs the full path of the port to create")
        return Pty(rest)
    return _parse_host_and_port(text, scheme, rest)


def udp_address(option: str, text: str) -> Address:
    """Return the address in an option's `HOST:PORT`; a `ConfigError` shows a correct one."""
    try:
        peer = parse_transport(f"udpout:{text}")
    except ConfigError:
        example = f"{OWN_HOST}:14550"
        raise ConfigError(f"{option} {text}: give HOST:PORT, for example {example}") from None
    assert isinstance(peer, UdpConnect)
    return peer.host, peer.port


def _parse_host_and_port(text: str, scheme: str, rest: str) -> Transport:
    kind = _PORTS[scheme]
    host, separator, port_text = rest.rstrip("/").rpartition(":")
    if "[" in rest or ":" in host:
        raise _wrong(text, scheme, "IPv6 is not supported, give an IPv4 address or a name")
    if not separator:
        raise _wrong(text, scheme, "needs HOST:PORT")
    if not host:
        if kind in (UdpConnect, TcpClient):
            raise _wrong(text, scheme, "needs a host to send to")
        host = OWN_HOST
    if any(character.isspace() or character in "/@?#" for character in host):
        raise _wrong(text, scheme, f"`{host}` is not a host name")
    port = _number(port_text)
    if port is None or not 1 <= port <= 65_535:
        raise _wrong(text, scheme, f"the port must be 1 to 65535, not `{port_text}`")
    return kind(host, port)


def _parse_serial(text: str, rest: str, default_baud: int) -> SerialPort:
    device, separator, baud_text = rest.rpartition(":")
    # /dev/serial/by-path names hold colons: only a last part that is all digits is a speed there
    if not separator or (not baud_text.isdigit() and device.startswith("/dev/serial/")):
        device, baud_text = rest, str(default_baud)
    if not device.startswith("/"):
        raise _wrong(text, "serial", "needs the full path of a device")
    baud = _number(baud_text)
    if baud is None or not 300 <= baud <= 12_000_000:
        raise _wrong(text, "serial", f"the speed must be a number of baud, not `{baud_text}`")
    return SerialPort(device, baud)


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None


def _wrong(text: str, scheme: str, problem: str) -> ConfigError:
    return ConfigError(f"link `{text}`: {problem}, for example {_EXAMPLES[scheme]}")


def shared(transport: Transport) -> Transport:
    """Return the transport with a bound UDP port or TCP server opened to several clients."""
    match transport:
        case UdpBind():
            return UdpFanOut(transport.host, transport.port)
        case TcpServer():
            return TcpFanOut(transport.host, transport.port)
    return transport


_LINKS: dict[type[_AtPort], Callable[[str, int, int, Received], Link]] = {
    UdpBind: UdpLink,
    UdpConnect: UdpConnectLink,
    TcpClient: TcpClientLink,
    TcpServer: TcpServerLink,
    TcpFanOut: TcpFanOutLink,
}


def make_link(transport: Transport, index: int, received: Received) -> Link:
    """Return the link of a transport, not yet open."""
    match transport:
        case UdpFanOut(host, port, remotes):
            return UdpFanOutLink(host, port, remotes, index, received)
        case Pty(path):
            return PtyLink(path, index, received)
        case SerialPort(device, baud):
            return SerialLink(device, baud, index, received)
        case OwnLine():
            return transport.make(index, received)
    return _LINKS[type(transport)](transport.host, transport.port, index, received)


@dataclass(frozen=True, slots=True)
class FlightLink:
    """One link of a flight: its transport and its role."""

    transport: Transport
    spec: LinkSpec


def parse_flight_link(text: str, role: LinkRole) -> FlightLink:
    """Return the MAVLink link of an option's address."""
    transport = parse_transport(text)
    is_shared = role is LinkRole.GCS
    return FlightLink(shared(transport) if is_shared else transport, LinkSpec(role))


def is_exposed(transport: Transport) -> bool:
    """Return True if it listens where other machines may send to."""
    if isinstance(transport, OwnLine):
        return transport.listens_at is not None and is_exposed(transport.listens_at)
    if not isinstance(transport, Listening) or transport.host.lower() == "localhost":
        return False
    try:
        return not ipaddress.IPv4Address(transport.host).is_loopback
    except ValueError:
        return True  # a host name may resolve to any interface


def check_exposure(
    links: Sequence[FlightLink],
    *,
    has_key: bool,
    unsigned_ranging: bool = False,
    remedy: str = "give --signing-key FILE, or insist with --insecure",
) -> None:
    """Refuse, by a `ConfigError`, to listen beyond this machine without authenticated senders.

    MAVLink without signing obeys any sender that reaches the port (CVE-2026-1579 is PX4's name for
    it). With `unsigned_ranging` a ranging link authenticates nothing, and every other one does.
    """
    for link in links:
        may_be_unsigned = unsigned_ranging and link.spec.role is LinkRole.RANGING
        is_proved = has_key and not may_be_unsigned and link.spec.radio is None
        if is_exposed(link.transport) and not is_proved:
            raise ConfigError(
                f"{link.transport}: anyone in the network could command it; listen on 127.0.0.1, "
                f"{remedy}"
            )


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
        raise ConfigError(f"radio {setup.kind.name}: poll_s: nothing is polled at {url}; {asks}")

    def greeted(index: int, received: Received) -> Link:
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
                raise _wrong_radio(url, "needs a command, for example exec:cat /tmp/radio.txt")
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
        raise _wrong_radio(url, f"is not an address of a {what}")
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
        raise _wrong_radio(url, "is not a file, for example file:log.txt, or file:log.txt?play=1")
    if not key:
        return url, lambda index, received: FileLink(path, index, received), None
    try:
        speed = float(value or 1.0)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed <= 1000.0:
        raise _wrong_radio(url, f"`{value}` is not a speed, for example play=2")
    radio = setup.kind.name
    return (
        url,
        lambda index, received: PlayedFileLink(path, radio, speed, index, received),
        None,
    )


def _wrong_radio(url: str, problem: str) -> ConfigError:
    return ConfigError(f"radio at `{url}`: {problem}")
