"""What each link fault does to a datagram that is sent while it acts: lost, late, damaged, copied.

Every effect owns its generator, so that adding one fault never changes what another one draws.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np

from companion.mav.signing import SigningKey
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.lockstep.observer import Delivery

F = TypeVar("F", bound=FaultRecord)
NO_MAGIC = bytes(set(range(256)) - {0xFD, 0xFE})
"""Bytes that begin no frame."""


class FaultEffect(ABC, Generic[F]):
    """One fault, in one direction where it has one.

    Args:
        end_s: When it is over, on the caller's clock.
        key: Signs changed frames anew; None where nothing is signed.
    """

    def __init__(
        self,
        fault: F,
        rng: np.random.Generator,
        end_s: float = math.inf,
        key: SigningKey | None = None,
    ) -> None:
        self._fault = fault
        self._rng = rng
        self._end_s = end_s
        self._key = key

    @abstractmethod
    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """What becomes of what would arrive of one datagram that is sent at `now_s`."""

    def watch(self, data: bytes) -> None:
        """A datagram passes while the fault does not act yet, or not any more."""

    def _happens(self, share: float) -> bool:
        return float(self._rng.random()) < share


class Loss(FaultEffect[faults.LinkLoss]):
    """Independent loss."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Lose some."""
        return [each for each in deliveries if not self._happens(self._fault.share)]


class Blackout(FaultEffect[faults.LinkBlackout]):
    """Nothing arrives."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Lose all."""
        return []


class Bursts(FaultEffect[faults.LinkBursts]):
    """A two-state Markov process in continuous time."""

    _is_bad = False
    _until_s: float | None = None

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Lose what falls into a bad time."""
        fault = self._fault
        if self._until_s is None:
            self._until_s = now_s + float(self._rng.exponential(fault.mean_good_s))
        while self._until_s <= now_s:
            self._is_bad = not self._is_bad
            mean_s = fault.mean_bad_s if self._is_bad else fault.mean_good_s
            self._until_s += float(self._rng.exponential(mean_s))
        share = fault.loss_bad if self._is_bad else fault.loss_good
        return [each for each in deliveries if not self._happens(share)]


class Delay(FaultEffect[faults.LinkDelay]):
    """A constant delay."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Make it late."""
        return [(due_s + self._fault.delay_s, data) for due_s, data in deliveries]


class Jitter(FaultEffect[faults.LinkJitter]):
    """A random delay, so that frames overtake each other."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Make some late."""
        return [(due_s + self._late_s(), data) for due_s, data in deliveries]

    def _late_s(self) -> float:
        hit, late = self._rng.random(2).tolist()
        return float(late) * self._fault.jitter_s if hit < self._fault.share else 0.0


class Duplicates(FaultEffect[faults.LinkDuplicates]):
    """Copies of some frames, a little later."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Copy some."""
        copies: list[Delivery] = []
        for due_s, data in deliveries:
            if self._happens(self._fault.share):
                late = self._rng.uniform(0.0, self._fault.spread_s, self._fault.copies)
                copies += [(due_s + each, data) for each in late.tolist()]
        return deliveries + copies


class Damage(FaultEffect[faults.LinkBitFlips | faults.LinkTruncation | faults.LinkGarbage]):
    """A share of the datagrams comes damaged."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Damage some."""
        return [
            (due_s, self._damage(data) if self._happens(self._fault.share) else data)
            for due_s, data in deliveries
        ]

    def _damage(self, data: bytes) -> bytes:
        match self._fault:
            case faults.LinkBitFlips(bits=bits):
                flipped = bytearray(data)
                for place in self._rng.integers(0, 8 * len(data), bits).tolist():
                    flipped[place // 8] ^= 1 << place % 8
                return bytes(flipped)
            case faults.LinkTruncation():
                return data[: int(self._rng.integers(1, max(2, len(data))))]
            case faults.LinkGarbage(most_bytes=most):
                count = int(self._rng.integers(1, most + 1))
                junk = self._rng.integers(0, len(NO_MAGIC), count).tolist()
                return bytes(NO_MAGIC[each] for each in junk) + data


class RateCap(FaultEffect[faults.LinkRateCap]):
    """A serial line's rate: what is sent waits for what went before."""

    _free_s = 0.0

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Queue it, or lose it where the queue is full."""
        bytes_per_s = self._fault.bits_per_s / 8.0
        through: list[Delivery] = []
        for due_s, data in deliveries:
            begin_s = max(now_s, self._free_s)
            if begin_s - now_s > self._fault.queue_bytes / bytes_per_s:
                continue
            self._free_s = begin_s + len(data) / bytes_per_s
            through.append((max(due_s, self._free_s), data))
        return through


class Hold(FaultEffect[faults.LinkHold]):
    """Everything waits for the end of the fault."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Keep it until then."""
        return [(max(due_s, self._end_s), data) for due_s, data in deliveries]


LINK_EFFECTS: dict[type[FaultRecord], type[FaultEffect[Any]]] = {
    faults.LinkBlackout: Blackout,
    faults.LinkLoss: Loss,
    faults.LinkBursts: Bursts,
    faults.LinkBitFlips: Damage,
    faults.LinkTruncation: Damage,
    faults.LinkGarbage: Damage,
    faults.LinkDuplicates: Duplicates,
    faults.LinkDelay: Delay,
    faults.LinkJitter: Jitter,
    faults.LinkRateCap: RateCap,
    faults.LinkHold: Hold,
}
"""By fault, in the order in which they act on one datagram."""
