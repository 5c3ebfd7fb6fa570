"""What can go wrong between the two endpoints, in one direction or both."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.domain import NonNegative, Positive
from sim_link.faults.record import Count, FaultRecord, Share

Direction = Literal["both", "to_companion", "to_vehicle"]


class LinkFault(FaultRecord, frozen=True):
    """Something between the two, in one direction or both."""

    direction: Direction = "both"


class LinkLoss(LinkFault, frozen=True, tag="link_loss"):
    """Each frame is lost by itself."""

    share: Share = 0.3


class LinkBursts(LinkFault, frozen=True, tag="link_bursts"):
    """Gilbert-Elliott: the link changes between a good and a bad state, by time, not by frame."""

    mean_good_s: Positive = 2.0
    mean_bad_s: Positive = 0.2
    loss_good: Share = 0.0
    loss_bad: Share = 1.0


class LinkBlackout(LinkFault, frozen=True, tag="link_blackout"):
    """Nothing arrives; in one direction only, that is a one-way link."""


class LinkDelay(LinkFault, frozen=True, tag="link_delay"):
    """Every frame is late."""

    delay_s: NonNegative = 0.1


class LinkJitter(LinkFault, frozen=True, tag="link_jitter"):
    """Some frames are late by a random time, so that others overtake them."""

    jitter_s: Positive = 0.2
    """Up to this much."""
    share: Share = 1.0


class LinkDuplicates(LinkFault, frozen=True, tag="link_duplicates"):
    """Some frames arrive several times."""

    share: Share = 0.1
    copies: Count = 1
    """Beside the frame itself."""
    spread_s: NonNegative = 0.1
    """Copies come up to this much later."""


class LinkBitFlips(LinkFault, frozen=True, tag="link_bit_flips"):
    """Some frames arrive with bits turned over."""

    share: Share = 0.1
    bits: Count = 1


class LinkTruncation(LinkFault, frozen=True, tag="link_truncation"):
    """Some frames lose their end."""

    share: Share = 0.1


class LinkGarbage(LinkFault, frozen=True, tag="link_garbage"):
    """Bytes that are no frame stand before some frames, in the same datagram."""

    share: Share = 0.1
    most_bytes: Count = 40


class LinkRateCap(LinkFault, frozen=True, tag="link_rate_cap"):
    """A slow link with a queue; what does not fit into the queue is lost."""

    bits_per_s: Positive = 57_600.0
    queue_bytes: Annotated[int, msgspec.Meta(ge=1, le=10_000_000)] = 4096


class LinkHold(LinkFault, frozen=True, tag="link_hold"):
    """Nothing arrives until the fault is over; then everything at once."""
