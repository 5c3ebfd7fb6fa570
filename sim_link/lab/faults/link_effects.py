"""Effects of faults on datagrams: lost, late, damaged or sent twice.

What a fault does to the datagrams that are sent while it acts.

What each link fault does to a datagram, one small class per kind.

Every effect owns its generator, so that adding one fault never changes what another one draws.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults.fault_models import (
    LinkBitFlips,
    LinkBlackout,
    LinkBursts,
    LinkDelay,
    LinkDuplicates,
    LinkGarbage,
    LinkHold,
    LinkJitter,
    LinkLoss,
    LinkRateCap,
    LinkTruncation,
)
from sim_link.lab.lockstep.observer import Delivery


class Effect(ABC):
    """One fault, in one direction where it has one."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    @abstractmethod
    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """What becomes of what would arrive of one datagram that is sent at `now_s`."""

    def watch(self, data: bytes) -> None:  # noqa: B027  most faults need not know
        """A datagram passes while the fault does not act yet, or not any more."""

    def _happens(self, share: float) -> bool:
        return float(self._rng.random()) < share


NO_MAGIC = bytes(set(range(256)) - {0xFD, 0xFE})
"""Bytes that begin no frame."""


class Loss(Effect):
    """Independent loss; with a share of one, a blackout."""

    def __init__(self, fault: LinkLoss | LinkBlackout, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._share = fault.share if isinstance(fault, LinkLoss) else 1.0

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Lose some."""
        return [each for each in deliveries if not self._happens(self._share)]


class Bursts(Effect):
    """A two-state Markov process in continuous time."""

    def __init__(self, fault: LinkBursts, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._fault = fault
        self._is_bad = False
        self._until_s: float | None = None

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


class Delay(Effect):
    """A constant delay."""

    def __init__(self, fault: LinkDelay, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._delay_s = fault.delay_s

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Make it late."""
        return [(due_s + self._delay_s, data) for due_s, data in deliveries]


class Jitter(Effect):
    """A random delay, so that frames overtake each other."""

    def __init__(self, fault: LinkJitter, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._fault = fault

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Make some late."""
        return [(due_s + self._late_s(), data) for due_s, data in deliveries]

    def _late_s(self) -> float:
        hit, late = self._rng.random(2).tolist()
        return float(late) * self._fault.jitter_s if hit < self._fault.share else 0.0


class Duplicates(Effect):
    """Copies of some frames, a little later."""

    def __init__(self, fault: LinkDuplicates, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._fault = fault

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Copy some."""
        copies: list[Delivery] = []
        for due_s, data in deliveries:
            if self._happens(self._fault.share):
                late = self._rng.uniform(0.0, self._fault.spread_s, self._fault.copies)
                copies += [(due_s + each, data) for each in late.tolist()]
        return deliveries + copies


class Damage(Effect):
    """A share of the datagrams comes damaged."""

    def __init__(
        self, fault: LinkBitFlips | LinkTruncation | LinkGarbage, rng: np.random.Generator
    ) -> None:
        super().__init__(rng)
        self._fault = fault

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Damage some."""
        return [
            (due_s, self._damaged(data) if self._happens(self._fault.share) else data)
            for due_s, data in deliveries
        ]

    def _damaged(self, data: bytes) -> bytes:
        match self._fault:
            case LinkBitFlips(bits=bits):
                flipped = bytearray(data)
                for place in self._rng.integers(0, 8 * len(data), bits).tolist():
                    flipped[place // 8] ^= 1 << place % 8
                return bytes(flipped)
            case LinkTruncation():
                return data[: int(self._rng.integers(1, max(2, len(data))))]
            case LinkGarbage(most_bytes=most):
                count = int(self._rng.integers(1, most + 1))
                junk = self._rng.integers(0, len(NO_MAGIC), count).tolist()
                return bytes(NO_MAGIC[each] for each in junk) + data


class RateCap(Effect):
    """A serial line's rate: what is sent waits for what went before."""

    def __init__(self, fault: LinkRateCap, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._bytes_per_s = fault.bits_per_s / 8.0
        self._queue_s = fault.queue_bytes / self._bytes_per_s
        self._free_s = 0.0

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Queue it, or lose it where the queue is full."""
        through: list[Delivery] = []
        for due_s, data in deliveries:
            begin_s = max(now_s, self._free_s)
            if begin_s - now_s > self._queue_s:
                continue
            self._free_s = begin_s + len(data) / self._bytes_per_s
            through.append((max(due_s, self._free_s), data))
        return through


class Hold(Effect):
    """Everything waits for the end of the fault."""

    def __init__(self, end_s: float, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._end_s = end_s

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Keep it until then."""
        return [(max(due_s, self._end_s), data) for due_s, data in deliveries]


def link_effect(fault: FaultRecord, end_s: float, rng: np.random.Generator) -> Effect | None:
    """The effect of a link fault; None for any other fault.

    Args:
        end_s: When it is over, on the caller's clock.
    """
    match fault:
        case LinkLoss() | LinkBlackout():
            return Loss(fault, rng)
        case LinkBursts():
            return Bursts(fault, rng)
        case LinkBitFlips() | LinkTruncation() | LinkGarbage():
            return Damage(fault, rng)
        case LinkDuplicates():
            return Duplicates(fault, rng)
        case LinkDelay():
            return Delay(fault, rng)
        case LinkJitter():
            return Jitter(fault, rng)
        case LinkRateCap():
            return RateCap(fault, rng)
        case LinkHold():
            return Hold(end_s, rng)
    return None
