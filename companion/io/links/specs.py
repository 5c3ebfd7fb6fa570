"""What links there are, as values; `make_link` turns one into the thing that sends and receives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import assert_never

from companion.io.links.byte_streams import PtyLink, SerialLink, TcpClientLink
from companion.io.links.link import Link, LinkCounters, Received
from companion.io.links.tcp import TcpFanOutLink, TcpServerLink
from companion.io.links.udp import UdpConnectLink, UdpFanOutLink, UdpLink
from companion.io.links.urls import DEFAULT_BAUD, LinkKind, LinkUrl
from companion.mav.endpoint import Address

__all__ = [
    "Link",
    "LinkCounters",
    "LinkSpec",
    "Pty",
    "SerialPort",
    "TcpClient",
    "TcpFanOut",
    "TcpServer",
    "UdpBind",
    "UdpConnect",
    "UdpFanOut",
    "link_from_url",
    "make_link",
    "shared_link_from_url",
]


@dataclass(frozen=True, slots=True)
class UdpBind:
    """Bind and wait; a chunk goes to the peer it names, and nowhere without one."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class UdpFanOut:
    """Bind; a chunk without a peer goes to all `remotes` and the last 16 senders heard."""

    host: str
    port: int
    remotes: tuple[Address, ...] = ()


@dataclass(frozen=True, slots=True)
class UdpConnect:
    """Send first, from a free port, to one remote and hear only that one."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class TcpClient:
    """Connect, and again after a loss."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class TcpServer:
    """Listen, and serve one client at a time."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class TcpFanOut:
    """Listen, and serve several clients; a chunk without a peer goes to all of them."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class Pty:
    """A pseudo terminal that others open as a serial port under `path`."""

    path: str


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial device, opened again after it was unplugged."""

    device: str
    baud: int = DEFAULT_BAUD


LinkSpec = UdpBind | UdpFanOut | UdpConnect | TcpClient | TcpServer | TcpFanOut | Pty | SerialPort


def link_from_url(url: LinkUrl) -> LinkSpec:
    """The link that a parsed address means."""
    match url.kind:
        case LinkKind.UDP_IN:
            return UdpBind(url.host, url.port)
        case LinkKind.UDP_OUT:
            return UdpConnect(url.host, url.port)
        case LinkKind.TCP_IN:
            return TcpServer(url.host, url.port)
        case LinkKind.TCP_OUT:
            return TcpClient(url.host, url.port)
        case LinkKind.SERIAL:
            return SerialPort(url.device, url.baud)
        case LinkKind.PTY:
            return Pty(url.device)


def shared_link_from_url(url: LinkUrl, remotes: tuple[Address, ...] = ()) -> LinkSpec:
    """The link that an address means to a vehicle, which serves everybody who comes.

    Args:
        url: Where to listen, or a line.
        remotes: Whom a UDP link sends to unasked.
    """
    match url.kind:
        case LinkKind.UDP_IN:
            return UdpFanOut(url.host, url.port, remotes)
        case LinkKind.TCP_IN:
            return TcpFanOut(url.host, url.port)
    return link_from_url(url)


def make_link(spec: LinkSpec, index: int, received: Received) -> Link:
    """The link of a spec, not yet open."""
    match spec:
        case UdpBind():
            return UdpLink(spec.host, spec.port, index, received)
        case UdpFanOut():
            return UdpFanOutLink(spec.host, spec.port, spec.remotes, index, received)
        case UdpConnect():
            return UdpConnectLink(spec.host, spec.port, index, received)
        case TcpClient():
            return TcpClientLink(spec.host, spec.port, index, received)
        case TcpServer():
            return TcpServerLink(spec.host, spec.port, index, received)
        case TcpFanOut():
            return TcpFanOutLink(spec.host, spec.port, index, received)
        case Pty():
            return PtyLink(spec.path, index, received)
        case SerialPort():
            return SerialLink(spec.device, spec.baud, index, received)
    assert_never(spec)
