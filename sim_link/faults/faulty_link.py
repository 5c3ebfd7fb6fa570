"""A link that does what its schedule says, in memory on invented time, repeatable from its seed.

Theory of operation. Every fault gets effects with a generator of their own, seeded by the link's
seed and the fault's number: one per direction for a fault of the link, one for all frames of the
vehicle and its radio for a fault of their content. A datagram passes the effects that act at the
time it is sent, in a fixed order of kinds: first its content, then what is lost, then what is
damaged, then copies, then what makes it late. A radio on a link of its own is touched by faults of
content only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.mav.signing import SigningKey
from sim_link.faults.content_effects import content_effect
from sim_link.faults.content_kinds import ContentFault
from sim_link.faults.effect import Effect
from sim_link.faults.link_effects import link_effect
from sim_link.faults.link_kinds import (
    LinkBitFlips,
    LinkBlackout,
    LinkBursts,
    LinkDelay,
    LinkDuplicates,
    LinkFault,
    LinkGarbage,
    LinkHold,
    LinkJitter,
    LinkLoss,
    LinkRateCap,
    LinkTruncation,
)
from sim_link.faults.record import FaultRecord
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.wire import Delivery, Lane

LINK_LANES = {
    "both": (Lane.TO_COMPANION, Lane.TO_VEHICLE),
    "to_companion": (Lane.TO_COMPANION,),
    "to_vehicle": (Lane.TO_VEHICLE,),
}
CONTENT_LANES = (Lane.TO_COMPANION, Lane.RANGING)
LINK_ORDER: tuple[type[FaultRecord], ...] = (
    LinkBlackout,
    LinkLoss,
    LinkBursts,
    LinkBitFlips,
    LinkTruncation,
    LinkGarbage,
    LinkDuplicates,
    LinkDelay,
    LinkJitter,
    LinkRateCap,
    LinkHold,
)


@dataclass(frozen=True, slots=True)
class _Acting:
    start_s: float
    end_s: float
    rank: int
    effect: Effect


class FaultyLink:
    """A wire with faults; a `sim_link.lockstep.wire.Wire`.

    Args:
        schedule: What goes wrong when; what is no fault of link or content is left to others.
        seed: Of all that is random here.
        began_s: The caller's time at which the schedule begins.
        key: With which changed frames are signed anew, where frames are signed.
    """

    def __init__(
        self,
        schedule: Schedule,
        seed: int,
        began_s: float = 0.0,
        key: SigningKey | None = None,
    ) -> None:
        self._seed = seed
        self._key = key
        self._count = 0
        self._acting: dict[Lane, list[_Acting]] = {lane: [] for lane in Lane}
        for fault in schedule.faults:
            self.add(fault, began_s)

    def add(self, fault: FaultRecord, began_s: float) -> None:
        """One more fault, its times counted from `began_s`."""
        self._count += 1
        start_s, end_s = began_s + fault.start_s, began_s + fault.end_s
        if isinstance(fault, ContentFault):
            rng = np.random.default_rng((self._seed, self._count))
            effect = content_effect(fault, rng, self._key)
            assert effect is not None, fault
            for lane in CONTENT_LANES:
                self._put(lane, _Acting(start_s, end_s, -1, effect))
        if isinstance(fault, LinkFault):
            for lane in LINK_LANES[fault.direction]:
                number = LINK_LANES["both"].index(lane)
                rng = np.random.default_rng((self._seed, self._count, number))
                effect = link_effect(fault, end_s, rng)
                assert effect is not None, fault
                rank = LINK_ORDER.index(type(fault))
                self._put(lane, _Acting(start_s, end_s, rank, effect))

    def _put(self, lane: Lane, acting: _Acting) -> None:
        self._acting[lane].append(acting)
        self._acting[lane].sort(key=lambda each: each.rank)

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """What arrives of a datagram that is sent at `now_s`."""
        deliveries: list[Delivery] = [(now_s, data)]
        for acting in self._acting[lane]:
            if acting.start_s <= now_s < acting.end_s:
                deliveries = acting.effect.apply(deliveries, now_s)
            else:
                acting.effect.watch(data)
        return deliveries
