"""Link addresses as MAVLink tools write them, and which of them may be opened without a key.

`udp:HOST:PORT` and `udpin:` both bind and listen, as in pymavlink; MAVSDK's old `udp://HOST:PORT`
sends instead, and is read here as the same thing as `udp:HOST:PORT`. `udpout:` sends first.

Links that others on the network can reach are opened only to those who have a key.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from companion.errors import ConfigError

DEFAULT_BAUD = 921_600
"""Serial speed where none is given: PX4's default for TELEM2, its companion port."""

OWN_HOST = "127.0.0.1"
"""This machine alone: what an empty host means where we listen."""


class LinkKind(Enum):
    """Who opens the connection, and over what."""

    UDP_IN = "udpin"
    """Bind, wait, answer whoever sends."""
    UDP_OUT = "udpout"
    """Send first, from a free port."""
    TCP_IN = "tcpin"
    """Listen; one client at a time."""
    TCP_OUT = "tcp"
    """Connect, and again after a loss."""
    SERIAL = "serial"
    PTY = "pty"
    """Make a pseudo terminal that others open as a serial port."""


_KINDS = {
    "udp": LinkKind.UDP_IN,
    "udpin": LinkKind.UDP_IN,
    "udpout": LinkKind.UDP_OUT,
    "tcp": LinkKind.TCP_OUT,
    "tcpout": LinkKind.TCP_OUT,
    "tcpin": LinkKind.TCP_IN,
    "serial": LinkKind.SERIAL,
    "pty": LinkKind.PTY,
}
_EXAMPLES = {
    LinkKind.UDP_IN: "udp:127.0.0.1:14550",
    LinkKind.UDP_OUT: "udpout:127.0.0.1:14580",
    LinkKind.TCP_IN: "tcpin:127.0.0.1:5760",
    LinkKind.TCP_OUT: "tcp:127.0.0.1:5760",
    LinkKind.SERIAL: f"serial:/dev/ttyACM0:{DEFAULT_BAUD}",
    LinkKind.PTY: "pty:/tmp/vehicle",
}
_LISTENING = (LinkKind.UDP_IN, LinkKind.TCP_IN)


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """One parsed link address."""

    kind: LinkKind
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 0

    @property
    def is_exposed(self) -> bool:
        """Whether it listens where other machines may send to."""
        if self.kind not in _LISTENING or self.host.lower() == "localhost":
            return False
        try:
            return not ipaddress.IPv4Address(self.host).is_loopback
        except ValueError:
            return True  # a name, of who knows which interface

    def __str__(self) -> str:
        """The canonical spelling, which parses to the same address."""
        if self.kind is LinkKind.PTY:
            return f"pty:{self.device}"
        if self.kind is LinkKind.SERIAL:
            return f"serial:{self.device}:{self.baud}"
        return f"{self.kind.value}:{self.host}:{self.port}"


def parse_link_url(text: str) -> LinkUrl:
    """The link address in `text`.

    Args:
        text: `udp:`, `udpin:`, `udpout:`, `tcp:`, `tcpout:` or `tcpin:` with `HOST:PORT`,
            `serial:DEVICE[:BAUD]`, `pty:PATH` or a bare `/dev/...`; `kind://` is read as `kind:`.

    Raises:
        ConfigError: It is none of these; the message shows a right one.
    """
    stripped = text.strip()
    if stripped.startswith("/dev/"):
        return _parse_serial(text, stripped)
    scheme, separator, rest = stripped.partition(":")
    kind = _KINDS.get(scheme.lower())
    if kind is None or not separator:
        known = ", ".join(f"{name}:" for name in _KINDS)
        raise ConfigError(
            f"link `{text}`: must begin with {known} or /dev/, "
            f"for example {_EXAMPLES[LinkKind.UDP_IN]}"
        )
    rest = rest.removeprefix("//")
    if kind is LinkKind.SERIAL:
        return _parse_serial(text, rest)
    if kind is LinkKind.PTY:
        if not rest.startswith("/"):
            raise _wrong(text, kind, "needs the full path of the port to make")
        return LinkUrl(kind, device=rest)
    return _parse_host_and_port(text, kind, rest)


def _parse_host_and_port(text: str, kind: LinkKind, rest: str) -> LinkUrl:
    host, separator, port_text = rest.rstrip("/").rpartition(":")
    if "[" in rest or ":" in host:
        raise _wrong(text, kind, "IPv6 is not supported, give an IPv4 address or a name")
    if not separator:
        raise _wrong(text, kind, "needs HOST:PORT")
    if not host:
        if kind not in _LISTENING:
            raise _wrong(text, kind, "needs a host to send to")
        host = OWN_HOST
    if any(character.isspace() or character in "/@?#" for character in host):
        raise _wrong(text, kind, f"`{host}` is no host name")
    port = _number(port_text)
    if port is None or not 1 <= port <= 65_535:
        raise _wrong(text, kind, f"the port must be 1 to 65535, not `{port_text}`")
    return LinkUrl(kind, host=host, port=port)


def _parse_serial(text: str, rest: str) -> LinkUrl:
    device, separator, baud_text = rest.rpartition(":")
    # /dev/serial/by-path names hold colons: only a last part that is all digits is a speed there
    if not separator or (not baud_text.isdigit() and device.startswith("/dev/serial/")):
        device, baud_text = rest, str(DEFAULT_BAUD)
    if not device.startswith("/"):
        raise _wrong(text, LinkKind.SERIAL, "needs the full path of a device")
    baud = _number(baud_text)
    if baud is None or not 300 <= baud <= 12_000_000:
        raise _wrong(
            text, LinkKind.SERIAL, f"the speed must be a number of baud, not `{baud_text}`"
        )
    return LinkUrl(LinkKind.SERIAL, device=device, baud=baud)


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None


def _wrong(text: str, kind: LinkKind, problem: str) -> ConfigError:
    return ConfigError(f"link `{text}`: {problem}, for example {_EXAMPLES[kind]}")


def check_exposure(links: Sequence[LinkUrl], *, has_key: bool, unsigned_ranging: bool) -> None:
    """Refuse to listen beyond this machine without proof of who speaks.

    MAVLink without signing obeys whoever sends to the port (CVE-2026-1579 is PX4's name for it).

    Args:
        links: The vehicle's, then those that carry only ranging.
        unsigned_ranging: Whether ranging links take unsigned ones all the same.

    Raises:
        ConfigError: One of the links is open to all.
    """
    for number, link in enumerate(links):
        is_proved = has_key and not (unsigned_ranging and number > 0)
        if link.is_exposed and not is_proved:
            raise ConfigError(
                f"{link}: anyone in the network could command it; listen on 127.0.0.1, give "
                "--signing-key FILE, or insist with --insecure"
            )
