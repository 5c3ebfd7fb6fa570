"""Who may see the page, and who may press its buttons; pure.

Rules. On a loopback address everybody on this computer may look. Beyond loopback a token is needed
even to look, unless the operator opens the page for viewing. Buttons exist only where control was
switched on, and beyond loopback they need the token always. A request must name a host that is
ours, so that a foreign page in the operator's own browser cannot reach the page (DNS rebinding),
and a WebSocket must come from a page of ours (cross-site WebSocket hijacking).
"""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass
from urllib.parse import urlsplit

LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]", "::1"})


def is_loopback(host: str) -> bool:
    """Whether a bound host is only reached from this computer."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Access:
    """The rules of one page."""

    host: str
    """What it is bound to."""
    token: str | None
    is_control_on: bool = False
    is_view_open: bool = False
    """Whether those without the token may look, beyond loopback."""

    def has_token(self, given: str | None) -> bool:
        """Whether this is the token; takes the same time for every wrong one."""
        if self.token is None or given is None:
            return False
        return hmac.compare_digest(self.token.encode(), given.encode())

    def may_view(self, client_host: str, given: str | None) -> bool:
        """Whether a client may see the page and its data."""
        if is_loopback(self.host) and is_loopback(client_host):
            return True
        return self.is_view_open or self.has_token(given)

    def may_control(self, client_host: str, given: str | None) -> bool:
        """Whether a client may press HOLD, RESUME and RETURN."""
        if not self.is_control_on:
            return False
        if self.token is None:
            return is_loopback(self.host) and is_loopback(client_host)
        return self.has_token(given)

    def is_host_ours(self, host_header: str) -> bool:
        """Whether a request's Host names this page.

        On loopback only local names count; beyond, any address does, because a name that
        somebody else points at us still lacks the token.
        """
        if not is_loopback(self.host):
            return True
        return urlsplit(f"//{host_header}").hostname in {name.strip("[]") for name in LOCAL_NAMES}

    def is_origin_ours(self, origin: str | None, host_header: str) -> bool:
        """Whether a WebSocket comes from a page of the same host; without an Origin it does.

        Browsers always send one (RFC 6455 section 10.2), other clients need not.
        """
        return origin is None or urlsplit(origin).netloc == host_header
