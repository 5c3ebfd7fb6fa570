"""Autopilots heard on the vehicle link, one of which is bound.

Every HEARTBEAT of an autopilot makes its sender a candidate; stations, gimbals, cameras, companion
computers and other senders that are not autopilots are listed separately, for texts. A candidate
that was silent for long has vanished. Forged frames can invent any number of senders, so only some
are kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from companion.domain import Autopilot, VehicleClass
from companion.mav.dialect import mavlink, result_words
from companion.mav.endpoint import Address
from companion.mav.flight_modes import autopilot_of, class_of

VANISHED_S = 10.0
MAX_CANDIDATES = 8

Ids = tuple[int, int]


@dataclass(slots=True)
class Candidate:
    """Autopilot that was received."""

    ids: Ids
    autopilot: Autopilot
    vehicle_class: VehicleClass
    vehicle_type: int
    """MAV_TYPE."""
    peer: Address | None
    first_s: float
    heard_s: float


@dataclass(slots=True)
class Candidates:
    """Candidates of one link, and other senders of HEARTBEATs on it."""

    non_autopilots: dict[Ids, int] = field(default_factory=dict)
    """Senders of HEARTBEATs that are not autopilots, and their MAV_TYPE."""
    known: dict[Ids, Candidate] = field(default_factory=dict)
    ticked_s: float | None = None
    """Time of the last control tick, before which all waiting input was read."""

    def take(
        self,
        heartbeat: mavlink.MAVLink_heartbeat_message,
        peer: Address | None,
        now_s: float,
        *,
        wanted_system_id: int | None,
        bound: Candidate | None,
    ) -> bool:
        """Process a HEARTBEAT; return True for a candidate. The `bound` one is never changed."""
        ids = (heartbeat.get_srcSystem(), heartbeat.get_srcComponent())
        autopilot = autopilot_of(heartbeat)
        if autopilot is None or 0 in ids:
            if len(self.non_autopilots) < MAX_CANDIDATES:
                self.non_autopilots[ids] = heartbeat.type
            return False
        if wanted_system_id not in (None, ids[0]):
            return False
        each = self.known.get(ids)
        if each is None:
            for other in list(self.known.values()):
                if self.has_vanished(other.heard_s, now_s) and other is not bound:
                    del self.known[other.ids]
            if len(self.known) < MAX_CANDIDATES:
                kind = (autopilot, class_of(heartbeat), heartbeat.type)
                self.known[ids] = Candidate(ids, *kind, peer, now_s, now_s)
        else:
            each.heard_s = now_s
            if each is not bound:
                each.autopilot, each.vehicle_class = autopilot, class_of(heartbeat)
                each.vehicle_type, each.peer = heartbeat.type, peer
        return True

    def present(self, now_s: float) -> list[Candidate]:
        """Return the candidates that have not vanished."""
        return [each for each in self.known.values() if not self.has_vanished(each.heard_s, now_s)]

    def listened_s(self, heard_s: float, now_s: float) -> float:
        """Return the time since a frame, s, less a stall after it, whose frames are unread."""
        return (now_s if self.ticked_s is None else self.ticked_s) - heard_s

    def has_vanished(self, heard_s: float, now_s: float) -> bool:
        """Return True if a sender was silent for long."""
        return self.listened_s(heard_s, now_s) > VANISHED_S

    def non_autopilot_names(self) -> list[str]:
        """Return senders of HEARTBEATs that are not autopilots, as ids and type."""
        return [
            f"{system}/{component} ({result_words('MAV_TYPE', number, 'MAV_TYPE_')})"
            for (system, component), number in sorted(self.non_autopilots.items())
        ]
