"""Why a vehicle is not guided yet, told once for each reason."""

from __future__ import annotations

from companion.guidance.authority import Authority
from companion.guidance.fencing import Fencing
from companion.guidance.vehicle import VehicleView

PATIENCE_S = 10.0
"""What is missing for less than this is simply not there yet."""


class WaitingReason:
    """Finds the words for waiting.

    Args:
        vehicle: What is known of it.
        authority: Whether it is ours to guide.
        fencing: Whether there is a fence.
    """

    def __init__(self, vehicle: VehicleView, authority: Authority, fencing: Fencing) -> None:
        self._vehicle = vehicle
        self._authority = authority
        self._fencing = fencing
        self._missing_since_s: float | None = None
        self._said: str | None = None

    def news(self, now_s: float) -> str | None:
        """A text if there is something to say that was not said before."""
        text = self._text(now_s)
        if text is None or text == self._said:
            return None
        self._said = text
        return text

    def _text(self, now_s: float) -> str | None:
        if self._authority.has_twin(now_s):
            return "not offered: someone else sends under our ids; stop one of the two"
        missing = self._vehicle.missing(now_s)
        missing += [part for part in self._fencing.missing if part not in missing]
        if self._vehicle.heartbeat is None or not missing:
            self._missing_since_s = None
        if not missing:
            if self._authority.may_begin:
                return None
            mode = self._vehicle.name_of(self._vehicle.mode)
            return f"left alone: in {mode}, not given; switch to another mode"
        if self._vehicle.heartbeat is None:
            return None
        if self._missing_since_s is None:
            self._missing_since_s = now_s
        if now_s - self._missing_since_s < PATIENCE_S:
            return None
        return f"still waiting for {' and '.join(missing)}"
