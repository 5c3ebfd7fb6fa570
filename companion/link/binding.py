"""Which autopilot we talk to, at which address, and the parameters of vehicle and link."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import msgspec

from companion.domain import Autopilot, Params
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address
from companion.mav.flight_modes import autopilot_of


class VehicleParams(Params, frozen=True):
    """Which autopilot, and how it is commanded."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one heard."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""


class LinkParams(Params, frozen=True):
    """How the companion uses its links."""

    rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 20.0
    """Control ticks, and so setpoints, per second."""
    lossy_rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 50.0
    """The same where frames get lost."""
    lossy_share: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.2
    """A line that loses more than this share of the autopilot's frames is lossy."""
    signing_key_file: str | None = None
    """MAVLink 2 signing with the key in this file; null: no signing. `--signing-key` goes first."""
    unsigned_ranging: bool = False
    """With a key: whether ranging links may bring unsigned frames, of a radio that cannot sign."""

    gcs_icon: bool = False
    """Whether ground stations on `--gcs` links get the estimate as an ADSB_VEHICLE, an icon."""

    def __post_init__(self) -> None:
        """Refuse a rate that goes down where it should go up."""
        if self.lossy_rate_hz < self.rate_hz:
            raise ValueError("lossy_rate_hz must not be below rate_hz")


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
