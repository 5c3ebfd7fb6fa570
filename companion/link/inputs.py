"""Everything the endpoint is told, for a log from which the flight can be run again."""

from __future__ import annotations

from typing import Protocol

from companion.guidance.events import Wish
from companion.guidance.memory import SessionMemory
from companion.mav.endpoint import Address


class InputRecorder(Protocol):
    """Takes the inputs in their order; never raises and never waits."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """A valid frame that was not our own."""

    def tick(self, now_s: float) -> None:
        """The timer fired."""

    def stop(self, now_s: float) -> None:
        """The process was asked to end."""

    def wish(self, wish: Wish, now_s: float) -> None:
        """The operator asked for something."""

    def earlier_run(self, now_s: float) -> None:
        """An earlier process did not end in order."""

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """What that process knew is taken up."""


class NoRecorder:
    """Keeps nothing."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Forget a frame."""

    def tick(self, now_s: float) -> None:
        """Forget a tick."""

    def stop(self, now_s: float) -> None:
        """Forget a stop."""

    def wish(self, wish: Wish, now_s: float) -> None:
        """Forget a wish."""

    def earlier_run(self, now_s: float) -> None:
        """Forget an earlier run."""

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """Forget a memory."""
