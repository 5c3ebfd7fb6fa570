"""Cursor on Target: found emitters as markers on the ground teams' maps, by UDP.

An event is sent when an emitter is localised, when its estimate has changed, and from time to time
so that its marker does not become stale; at most one a second for each emitter. The socket does not
wait, and refused events are counted.

`companion.handoff` makes the contents of an event.
"""

from __future__ import annotations

import ipaddress
import logging
import math
import socket
import time
from collections.abc import Callable

from companion.domain import EstimateState, TargetEstimate
from companion.errors import ConfigError, LinkError
from companion.guidance.session import EmitterStatus
from companion.handoff import STALE_AFTER_S, cot_event, handoff_of
from companion.link.endpoint import CompanionEndpoint
from companion.mav.endpoint import Address
from companion.run import FlightView

log = logging.getLogger("companion.view")

CHECK_S = 0.25
"""Time between two checks for due events."""
MIN_S = 1.0
"""Shortest time between two events of an emitter."""
AGAIN_S = STALE_AFTER_S / 10.0
"""Time after which an unchanged event is sent again."""
CHANGE_SHARE = 0.2
"""Move, or change of R95, as a share of R95, that makes an event due."""
MAX_PORT = 65_535


def cot_address(text: str) -> Address:
    """Return the address in `HOST:PORT`; raise `ConfigError` on another form."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or not 0 < int(port) <= MAX_PORT:
        raise ConfigError(f"--cot {text}: must be HOST:PORT, as in 239.2.3.1:6969")
    return (host, int(port))


class CotRule:
    """Decides when an emitter's event is due."""

    def __init__(self) -> None:
        self._sent: dict[int, tuple[float, TargetEstimate]] = {}

    def is_due(self, emitter: EmitterStatus, now_s: float) -> bool:
        """Return True if an event is due now; it is then recorded as sent."""
        estimate = emitter.estimate
        if estimate is None:
            return False
        last = self._sent.get(emitter.emitter_id)
        is_found = estimate.state is EstimateState.LOCALISED or emitter.is_reported
        if last is None and not is_found:
            return False  # an emitter found once is reported to the end, whatever its state
        if last is not None:
            sent_s, before = last
            since_s = now_s - sent_s
            if since_s < MIN_S or (since_s < AGAIN_S and not _has_changed(before, estimate)):
                return False
        self._sent[emitter.emitter_id] = (now_s, estimate)
        return True


def _has_changed(before: TargetEstimate, now: TargetEstimate) -> bool:
    least_m = CHANGE_SHARE * min(before.r95_m, now.r95_m)
    moved_m = math.dist(before.position_enu_m, now.position_enu_m)
    is_wider = abs(now.r95_m - before.r95_m) > least_m
    is_wider = is_wider or abs(now.absolute_r95_m - before.absolute_r95_m) > least_m
    return now.state is not before.state or moved_m > least_m or is_wider


class CotView(FlightView):
    """Sends the events of one flight to a host or multicast group, which must be known."""

    def __init__(self, address: Address, unix_s: Callable[[], float] = time.time) -> None:
        self._unix_s = unix_s
        self._rule = CotRule()
        self._next_s = -math.inf
        self.sent = 0
        self.refused = 0
        try:
            family, kind, _, _, target = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise LinkError(f"--cot {address[0]}:{address[1]}: {error.strerror}") from error
        self._target = target
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)
        if ipaddress.ip_address(target[0]).is_multicast:
            log.info("Cursor on Target goes to the group %s:%s", target[0], target[1])

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Send events that are due."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + CHECK_S
        origin = endpoint.session.vehicle.origin
        if origin is None:
            return
        sender = f"companion-{endpoint.binding.system_id or 1}"
        for emitter in endpoint.session.status(now_s).emitters:
            estimate = emitter.estimate
            if estimate is None or not self._rule.is_due(emitter, now_s):
                continue
            name = str(emitter.emitter_id)
            self._send(cot_event(handoff_of(name, estimate, origin, self._unix_s()), sender))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, event: bytes) -> None:
        try:
            self._socket.sendto(event, self._target)
        except OSError as error:
            self.refused += 1
            if self.refused == 1:
                log.warning("Cursor on Target: not sent (%s); the flight continues", error.strerror)
        else:
            self.sent += 1
