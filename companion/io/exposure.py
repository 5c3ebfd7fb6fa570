"""Links that others on the network can reach are opened only to those who have a key."""

from __future__ import annotations

from collections.abc import Sequence

from companion.errors import ConfigError
from companion.io.urls import LinkUrl


def check_exposure(links: Sequence[LinkUrl], *, has_key: bool, unsigned_ranging: bool) -> None:
    """Refuse to listen beyond this machine without proof of who speaks.

    MAVLink without signing obeys whoever sends to the port (CVE-2026-1579 is PX4's name for it).

    Args:
        links: The vehicle's, then those that carry only ranging.
        has_key: Whether frames must be signed.
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
