"""A link that does what its schedule says, in memory on invented time, repeatable from its seed.

Theory of operation. Every fault gets an effect per direction with a generator of its own, seeded by
the link's seed and the fault's number. A datagram passes the effects that act at the time it is
sent, in a fixed order of kinds: first what is lost, then what is damaged, then copies, then what
makes it late. The vehicle's link has two directions; a radio on a link of its own is touched by
faults of the radio only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_link.faults.kinds import (
    FaultRecord,
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
from sim_link.faults.link_effects import Effect, make_effect
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.wire import Delivery, Lane

LINK_LANES = (Lane.TO_COMPANION, Lane.TO_VEHICLE)
LANE_OF = {"to_companion": Lane.TO_COMPANION, "to_vehicle": Lane.TO_VEHICLE}
ORDER: tuple[type[FaultRecord], ...] = (
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
        schedule: What goes wrong when.
        seed: Of all that is random here.
        began_s: The caller's time at which the schedule begins.
    """

    def __init__(self, schedule: Schedule, seed: int, began_s: float = 0.0) -> None:
        self._seed = seed
        self._count = 0
        self._acting: dict[Lane, list[_Acting]] = {lane: [] for lane in Lane}
        for fault in schedule.faults:
            self.add(fault, began_s)

    def add(self, fault: FaultRecord, began_s: float) -> None:
        """One more fault, its times counted from `began_s`; what is none of the link is ignored."""
        self._count += 1
        if not isinstance(fault, LinkFault):
            return
        start_s, end_s = began_s + fault.start_s, began_s + fault.end_s
        for lane in LINK_LANES:
            if fault.direction != "both" and LANE_OF[fault.direction] is not lane:
                continue
            rng = np.random.default_rng((self._seed, self._count, LINK_LANES.index(lane)))
            effect = make_effect(fault, end_s, rng)
            if effect is not None:
                rank = ORDER.index(type(fault))
                self._acting[lane].append(_Acting(start_s, end_s, rank, effect))
                self._acting[lane].sort(key=lambda acting: acting.rank)

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """What arrives of a datagram that is sent at `now_s`."""
        deliveries: list[Delivery] = [(now_s, data)]
        for acting in self._acting[lane]:
            if acting.start_s <= now_s < acting.end_s:
                deliveries = acting.effect.apply(deliveries, now_s)
        return deliveries
