"""Which autopilot we talk to, and at which address."""

from __future__ import annotations

from dataclasses import dataclass, field

from companion.domain import Autopilot
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address
from companion.mav.modes import autopilot_of

PEER_SILENCE_S = 3.0
"""The autopilot must be silent this long before the same ids are believed from a new address."""
MOST_OTHERS = 3
"""Other autopilots than this many are not remembered: a stranger can invent any number."""
KEYED_SILENCE_S = 0.5
"""The same where every frame is proved: so long that two ways to one autopilot do not alternate."""


@dataclass(slots=True)
class AutopilotBinding:
    """The first autopilot heard, for good: other systems, stations and payloads are not it.

    Other stations' heartbeats are forwarded by autopilots, so system, component and the
    `autopilot` field decide, and the address once it is known.
    """

    wanted_system_id: int | None = None
    is_keyed: bool = False
    """Whether every frame that comes here was proved to be from somebody with our key."""
    system_id: int | None = None
    component_id: int = 0
    autopilot: Autopilot = Autopilot.OTHER
    peer: Address | None = None
    heard_s: float | None = None
    strangers: int = 0
    """Frames that carried the autopilot's ids from another address."""
    moves: int = 0
    """How often the autopilot's address changed."""
    others: list[int] = field(default_factory=list)
    """Other autopilots that were heard, while none was asked for: their systems."""

    @property
    def is_bound(self) -> bool:
        """Whether an autopilot was heard."""
        return self.system_id is not None

    @property
    def silence_s(self) -> float:
        """How long the autopilot must be silent before another address is believed."""
        return KEYED_SILENCE_S if self.is_keyed else PEER_SILENCE_S

    def admits(self, message: Message, peer: Address | None, now_s: float) -> bool:
        """Whether a message comes from the bound autopilot; binds to the first one."""
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            self._maybe_bind(message, peer)
        if not self._is_its_id(message):
            return False
        if peer != self.peer:
            if self.heard_s is not None and now_s - self.heard_s < self.silence_s:
                self.strangers += 1
                return False
            self.peer = peer
            self.moves += 1
        self.heard_s = now_s
        return True

    def _is_its_id(self, message: Message) -> bool:
        ids = (message.get_srcSystem(), message.get_srcComponent())
        return self.is_bound and ids == (self.system_id, self.component_id)

    def _maybe_bind(
        self, heartbeat: mavlink.MAVLink_heartbeat_message, peer: Address | None
    ) -> None:
        autopilot = autopilot_of(heartbeat)
        system_id = heartbeat.get_srcSystem()
        if autopilot is None or system_id == 0:
            return
        if self.is_bound:
            self._note_other(system_id)
            return
        if self.wanted_system_id not in (None, system_id):
            return
        self.system_id = system_id
        self.component_id = heartbeat.get_srcComponent()
        self.autopilot = autopilot
        self.peer = peer

    def _note_other(self, system_id: int) -> None:
        if self.wanted_system_id is not None or len(self.others) >= MOST_OTHERS:
            return
        if system_id != self.system_id and system_id not in self.others:
            self.others.append(system_id)
