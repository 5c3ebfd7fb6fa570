"""Where the page is served and for whom, as the command line says it."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ConfigError
from companion.web.access import Access, is_loopback
from companion.web.tiles import zooms_of

LOOPBACK = "127.0.0.1"
MIN_TOKEN = 8
"""Characters; a shorter one is guessed."""


@dataclass(frozen=True, slots=True)
class WebSettings:
    """How the page is served."""

    host: str
    port: int
    token: str | None = None
    is_control_on: bool = False
    is_view_open: bool = False
    tiles: Path | None = None
    """Folder of map tiles, `z/x/y.png`."""

    @property
    def access(self) -> Access:
        """Who may do what."""
        return Access(self.host, self.token, self.is_control_on, self.is_view_open)

    @property
    def url(self) -> str:
        """What to type into a browser on this computer."""
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
    """The settings that the options add up to.

    Args:
        address: `PORT` or `HOST:PORT`; without a host only this computer is served.
        token: What clients must show; beyond loopback one is made up if none is given.
        is_control_on: Whether there are buttons.
        is_view_open: Whether clients without the token may look.
        tiles: Folder of map tiles.

    Raises:
        ConfigError: An option is wrong.
    """
    host, _, port_text = address.rpartition(":")
    host = host.strip("[]") or LOOPBACK
    if not port_text.isdecimal() or not 0 < int(port_text) < 65536:
        raise ConfigError(f"--web {address}: give a port, or HOST:PORT, for example 8080")
    if token is not None and len(token) < MIN_TOKEN:
        raise ConfigError(f"--web-token: needs at least {MIN_TOKEN} characters")
    if tiles is not None:
        _check_tiles(tiles)
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(12)
    return WebSettings(host, int(port_text), token, is_control_on, is_view_open, tiles)


def _check_tiles(folder: Path) -> None:
    """Refuse a folder that the map would stay empty with."""
    try:
        has_tiles = zooms_of(folder) is not None
    except OSError as error:
        raise ConfigError(
            f"--web-tiles {folder}: {error.strerror}; give a folder with z/x/y.png in it"
        ) from error
    if not has_tiles:
        raise ConfigError(f"--web-tiles {folder}: there is no tile in it; tiles are z/x/y.png")
