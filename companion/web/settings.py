"""Address of the page and access to it: the command line, access rules, map tiles.

Access rules. On a loopback address every user of this computer may look. Beyond loopback a token is
needed even to look, unless the operator opens the page for viewing. Buttons exist only where
control was switched on, and beyond loopback they need the token always. A request must name a host
that is ours, so that a foreign page in the operator's own browser cannot reach the page (DNS
rebinding), and a WebSocket must come from a page of ours (cross-site WebSocket hijacking).
"""

from __future__ import annotations

import argparse
import hmac
import ipaddress
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from companion.errors import ConfigError

LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]", "::1"})


def is_loopback(host: str) -> bool:
    """Return True if a bound host is only reached from this computer."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Access:
    """The access rules of one page."""

    host: str
    token: str | None
    is_control_on: bool = False
    is_view_open: bool = False
    """True if the page may be viewed without the token, beyond loopback."""

    def has_token(self, given: str | None) -> bool:
        """Return True if this is the token; takes the same time for every wrong one."""
        if self.token is None or given is None:
            return False
        return hmac.compare_digest(self.token.encode(), given.encode())

    def may_view(self, client_host: str, given: str | None) -> bool:
        """Return True if a client may see the page and its data."""
        if is_loopback(self.host) and is_loopback(client_host):
            return True
        return self.is_view_open or self.has_token(given)

    def may_control(self, client_host: str, given: str | None) -> bool:
        """Return True if a client may press HOLD, RESUME, RETURN and GRANT."""
        if not self.is_control_on:
            return False
        if self.token is None:
            return is_loopback(self.host) and is_loopback(client_host)
        return self.has_token(given)

    def is_host_ours(self, host_header: str) -> bool:
        """Return True if Host names this page: locally on loopback, any address beyond it."""
        if not is_loopback(self.host):
            return True
        names = {name.strip("[]") for name in LOCAL_NAMES}
        return _parsed(f"//{host_header}", "hostname") in names

    def is_origin_ours(self, origin: str | None, host_header: str) -> bool:
        """Return True if a WebSocket is from a page of ours, by its origin (RFC 6455, 10.2)."""
        return origin is None or _parsed(origin, "netloc") == host_header


def _parsed(address: str, part: Literal["hostname", "netloc"]) -> str | None:
    """Return a part of an address; None if missing, or if the address is malformed."""
    try:
        found: str | None = getattr(urlsplit(address), part)
    except ValueError:
        return None
    return found


NO_TILE = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c489"
    "0000000b49444154789c6360000200000500017a5eab3f0000000049454e44ae426082"
)
"""One transparent pixel as PNG, where there is no tile."""
IMAGE_KINDS = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg", b"RIFF": "webp"}
"""Magic numbers of a tile's image formats; file names are ignored."""
MAX_TILE_BYTES = 2_000_000


def zooms_of(folder: Path) -> tuple[int, int] | None:
    """Return the smallest and the largest zoom of `z/x/y.png` in a folder; None without tiles."""
    numbered = (path for path in folder.iterdir() if path.name.isdecimal())
    tiles = (tile for path in numbered for tile in path.glob("*/*.png"))
    zooms = [
        int(tile.parent.parent.name)
        for tile in tiles
        if tile.stem.isdecimal() and tile.parent.name.isdecimal()
    ]
    return (min(zooms), max(zooms)) if zooms else None


def tile_path(folder: Path, zoom: int, x: int, y: int) -> Path:
    """Return the file of a tile; `y` counts from the north."""
    return folder / str(zoom) / str(x) / f"{y}.png"


def tile(folder: Path, zoom: int, x: int, y: int) -> bytes:
    """Return a tile as PNG, a transparent one if it is missing."""
    try:
        return tile_path(folder, zoom, x, y).read_bytes()
    except OSError:
        return NO_TILE


VIEWED, LEFT = "viewed", "left"
"""The lines by which the page's process reports that a browser has opened the page, or left it."""
LOOPBACK = "127.0.0.1"
MIN_TOKEN = 8
"""Characters; a shorter one is guessed."""


@dataclass(frozen=True, slots=True)
class WebSettings(Access):
    """Address of the page, and access to it."""

    port: int = 0
    tiles: Path | None = None
    """Folder of map tiles, `z/x/y.png`."""

    @property
    def url(self) -> str:
        """Address for a browser on this computer."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        base = f"http://{host}:{self.port}/"
        return base if self.token is None else f"{base}?token={self.token}"


def web_settings(
    address: str,
    *,
    token: str | None = None,
    is_control_on: bool = False,
    is_view_open: bool = False,
    tiles: Path | None = None,
) -> WebSettings:
    """Return settings from the options, with a token beyond loopback; `ConfigError` if wrong."""
    host, _, port_text = address.rpartition(":")
    host = host.strip("[]") or LOOPBACK
    if not port_text.isdecimal() or not 0 < int(port_text) < 65536:
        raise ConfigError(f"--web {address}: give a port, or HOST:PORT, for example 8080")
    if token is not None and len(token) < MIN_TOKEN:
        raise ConfigError(f"--web-token: needs at least {MIN_TOKEN} characters")
    if tiles is not None:
        check_tiles(tiles)
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(12)
    return WebSettings(host, token, is_control_on, is_view_open, int(port_text), tiles)


def requested_settings(arguments: argparse.Namespace) -> WebSettings | None:
    """Return the map's settings for a flight, the demo (with buttons) or a replay; None: no map."""
    is_flight = arguments.command is None
    web = arguments.fly_web if is_flight else arguments.web
    tiles = arguments.fly_web_tiles if is_flight else arguments.web_tiles
    if web is None:
        options = {
            "control": arguments.web_control,
            "token": arguments.web_token,
            "open": arguments.web_open,
            "tiles": tiles,
        }
        given = [name for name, value in options.items() if value]
        if given:
            raise ConfigError(f"--web-{given[0]}: there is no map without --web PORT")
        return None
    return web_settings(
        web,
        token=arguments.web_token,
        is_control_on=arguments.web_control or arguments.command == "demo",
        is_view_open=arguments.web_open,
        tiles=tiles,
    )


def check_tiles(folder: Path) -> None:
    """Refuse a folder without tiles, which would leave the map empty."""
    try:
        has_tiles = zooms_of(folder) is not None
    except OSError as error:
        raise ConfigError(
            f"--web-tiles {folder}: {error.strerror}; give a folder with z/x/y.png in it"
        ) from error
    if not has_tiles:
        raise ConfigError(f"--web-tiles {folder}: contains no tiles; they are z/x/y.png")
