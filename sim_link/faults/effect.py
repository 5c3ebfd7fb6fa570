"""What a fault does to the datagrams that are sent while it acts."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sim_link.lockstep.wire import Delivery


class Effect(ABC):
    """One fault, in one direction where it has one.

    Args:
        rng: Of this effect alone.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    @abstractmethod
    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """What becomes of what would arrive of one datagram that is sent at `now_s`."""

    def watch(self, data: bytes) -> None:  # noqa: B027  most faults need not know
        """A datagram passes while the fault does not act yet, or not any more."""

    def _happens(self, share: float) -> bool:
        return float(self._rng.random()) < share
