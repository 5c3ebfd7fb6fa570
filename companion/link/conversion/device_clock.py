"""Clock of a radio with a format of its own, whose stamps wrap or restart."""

from __future__ import annotations

from companion.link.conversion.sender_clock import ClockStep, SenderClock


class DeviceClock:
    """Radio's own clock on ours: unwrapped, and then converted like a sender's clock."""

    def __init__(self, wrap_s: float | None = None) -> None:
        self.restarts = 0
        self._wrap_s = wrap_s
        self._clock = SenderClock()
        self._last: tuple[float, float] | None = None
        """Newest unwrapped stamp, and its arrival."""

    @property
    def is_heard(self) -> bool:
        """True if there ever was a stamp."""
        return self._clock.timebase.offset_at_s(0.0) is not None

    @property
    def is_usable(self) -> bool:
        """True if its stamps are usable."""
        return not self._clock.is_wild

    def read(self, stamp_s: float, now_s: float) -> float:
        """Return the time of a stamp on our clock."""
        if self._wrap_s is not None:
            stamp_s = self._unwrapped(stamp_s, self._wrap_s, now_s)
        reading = self._clock.read(stamp_s, now_s)
        self.restarts += reading.step is not ClockStep.NONE
        return reading.time_s if self.is_usable else now_s

    def _unwrapped(self, stamp_s: float, wrap_s: float, now_s: float) -> float:
        """Return the stamp in the turn of the counter that is nearest to the elapsed time."""
        if self._last is not None:
            last_s, heard_s = self._last
            stamp_s += wrap_s * round((last_s + now_s - heard_s - stamp_s) / wrap_s)
        self._last = (stamp_s, now_s)
        return stamp_s
