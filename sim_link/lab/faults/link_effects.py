"""What each link fault does to a datagram that is sent while it acts: lost, late, damaged, copied.

Every effect owns its generator, so that adding one fault never changes what another one draws.
"""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

import numpy as np

from companion.mav.signing import SigningKey
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.lockstep.observer import Delivery

F = TypeVar("F", bound=FaultRecord)
NO_MAGIC = bytes(set(range(256)) - {0xFD, 0xFE})
"""Bytes that begin no frame."""


class FaultEffect(Generic[F]):
    """One fault, in one direction where it has one, until its end on the caller's clock.

    Its record says what it does. A key signs changed frames anew; None where nothing is signed.
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

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """What becomes of what would arrive of one datagram that is sent at `now_s`."""
        return [each for due_s, data in deliveries for each in self._pass(data, due_s)]

    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        """What becomes of one of them; by default nothing arrives."""
        del data, due_s
        return []

    def watch(self, data: bytes) -> None:
        """A datagram passes while the fault does not act yet, or not any more."""

    def _happens(self, share: float) -> bool:
        return float(self._rng.random()) < share


class _Loss(FaultEffect[faults.LinkLoss]):
    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        return [] if self._happens(self._fault.share) else [(due_s, data)]


class _Blackout(FaultEffect[faults.LinkBlackout]):
    pass


class _Bursts(FaultEffect[faults.LinkBursts]):
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


class _Delay(FaultEffect[faults.LinkDelay]):
    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        return [(due_s + self._fault.delay_s, data)]


class _Jitter(FaultEffect[faults.LinkJitter]):
    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        hit, late = self._rng.random(2).tolist()
        late_s = float(late) * self._fault.jitter_s if hit < self._fault.share else 0.0
        return [(due_s + late_s, data)]


class _Duplicates(FaultEffect[faults.LinkDuplicates]):
    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """All of them, and then the copies."""
        return deliveries + super().apply(deliveries, now_s)

    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        if not self._happens(self._fault.share):
            return []
        late = self._rng.uniform(0.0, self._fault.spread_s, self._fault.copies)
        return [(due_s + each, data) for each in late.tolist()]


class _Damage(FaultEffect[faults.LinkBitFlips | faults.LinkTruncation | faults.LinkGarbage]):
    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        return [(due_s, self._damage(data) if self._happens(self._fault.share) else data)]

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


class _RateCap(FaultEffect[faults.LinkRateCap]):
    _free_s = 0.0

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Each waits for what was sent before, and is lost where the queue is full."""
        bytes_per_s = self._fault.bits_per_s / 8.0
        through: list[Delivery] = []
        for due_s, data in deliveries:
            begin_s = max(now_s, self._free_s)
            if begin_s - now_s > self._fault.queue_bytes / bytes_per_s:
                continue
            self._free_s = begin_s + len(data) / bytes_per_s
            through.append((max(due_s, self._free_s), data))
        return through


class _Hold(FaultEffect[faults.LinkHold]):
    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        return [(max(due_s, self._end_s), data)]


LINK_EFFECTS: dict[type[FaultRecord], type[FaultEffect[Any]]] = {
    faults.LinkBlackout: _Blackout,
    faults.LinkLoss: _Loss,
    faults.LinkBursts: _Bursts,
    faults.LinkBitFlips: _Damage,
    faults.LinkTruncation: _Damage,
    faults.LinkGarbage: _Damage,
    faults.LinkDuplicates: _Duplicates,
    faults.LinkDelay: _Delay,
    faults.LinkJitter: _Jitter,
    faults.LinkRateCap: _RateCap,
    faults.LinkHold: _Hold,
}
"""By fault, in the order in which they act on one datagram."""
