"""The clock of one sender, also when it restarted while nobody listened."""

from __future__ import annotations

from companion.mav.timebase import StampReading, Timebase

MAX_LATE_S = 5.0
"""No link delivers later than this for long; what looks like it is a clock that started anew."""
LATE_CONFIRM_S = 1.0
"""A burst of delayed frames is shorter than this."""


class SenderClock:
    """Converts one sender's stamps to local time.

    `Timebase` knows a restart by a stamp that goes back. After a silence longer than the sender's
    former uptime the stamps of the new clock are ahead of the old ones, and every reading would
    be late, for good: that is a restart too.
    """

    def __init__(self) -> None:
        self._timebase = Timebase()
        self._late_since_s: float | None = None

    @property
    def offset_s(self) -> float | None:
        """Local minus remote time, with the shortest delay seen in it; None before any stamp."""
        return self._timebase.offset_s

    def read(self, remote_s: float, now_s: float) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds."""
        reading = self._timebase.read(remote_s, now_s)
        if now_s - reading.time_s <= MAX_LATE_S:
            self._late_since_s = None
            return reading
        if self._late_since_s is None:
            self._late_since_s = now_s
        if now_s - self._late_since_s < LATE_CONFIRM_S:
            return reading
        self._late_since_s = None
        self._timebase = Timebase()
        return StampReading(self._timebase.read(remote_s, now_s).time_s, is_reboot=True)
