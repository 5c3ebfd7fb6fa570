"""What links there are, as values; `make_link` turns one into the thing that sends and receives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import assert_never

from companion.io.link_base import Link, LinkCounters, Received
from companion.io.streams import SerialLink, TcpClientLink, TcpServerLink
from companion.io.udp import UdpConnectLink, UdpFanOutLink, UdpLink
from companion.io.urls import DEFAULT_BAUD, LinkKind, LinkUrl
from companion.mav.endpoint import Address

__all__ = [
    "Link",
    "LinkCounters",
    "LinkSpec",
    "SerialPort",
    "TcpClient",
    "TcpServer",
    "UdpBind",
    "UdpConnect",
    "UdpFanOut",
    "link_from_url",
    "make_link",
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
class SerialPort:
    """A serial device, opened again after it was unplugged."""

    device: str
    baud: int = DEFAULT_BAUD


LinkSpec = UdpBind | UdpFanOut | UdpConnect | TcpClient | TcpServer | SerialPort


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


def make_link(spec: LinkSpec, index: int, received: Received) -> Link:
    """The link of a spec, not yet open.

    Args:
        spec: What to open.
        index: Its number in the chunks.
        received: Takes what arrives.
    """
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
        case SerialPort():
            return SerialLink(spec.device, spec.baud, index, received)
    assert_never(spec)
