"""The clock of one sender, also when it restarted while nobody listened, or runs wild."""

from __future__ import annotations

from collections import deque

from companion.mav.timebase import StampReading, Timebase

MAX_LATE_S = 5.0
"""Few links deliver later than this for long; what looks like it is a clock that started anew."""
LATE_CONFIRM_S = 1.0
"""A burst of delayed frames is shorter than this."""
RUN_WINDOW_S = 2.0
MAX_GAIN_S = 1.0
"""A clock that gains more than this on ours within the window is no clock.

Every gain also looks like a link that has become faster than ever before, so it must be more than
a delay; a clock at twice the speed is found out after a second.
"""


class SenderClock:
    """Converts one sender's stamps to local time.

    `Timebase` knows a restart by a stamp that goes back. After a silence longer than the sender's
    former uptime the stamps of the new clock are ahead of the old ones, and every reading would
    be late, for good: that is a restart too, unless the link itself is as late.
    """

    def __init__(self) -> None:
        self._timebase = Timebase()
        self._late_since_s: float | None = None
        self._gains: deque[tuple[float, float]] = deque()
        """When the clock gained on ours, and how much."""

    @property
    def offset_s(self) -> float | None:
        """Local minus remote time, with the shortest delay seen in it; None before any stamp."""
        return self._timebase.offset_s

    @property
    def is_wild(self) -> bool:
        """Whether it runs so fast that its stamps say nothing about the present."""
        return sum(gain_s for _, gain_s in self._gains) > MAX_GAIN_S

    def read(
        self, remote_s: float, now_s: float, *, late_confirm_s: float = LATE_CONFIRM_S
    ) -> StampReading:
        """Local time of a remote stamp that arrived at `now_s`, both in seconds.

        Args:
            remote_s: The stamp.
            now_s: The present.
            late_confirm_s: How long stamps must be late before they are those of a new clock.
        """
        before_s = self._timebase.offset_s
        reading = self._timebase.read(remote_s, now_s)
        if reading.is_reboot:
            self._gains.clear()
        else:
            self._note_gain(before_s, now_s)
        if now_s - reading.time_s <= MAX_LATE_S:
            self._late_since_s = None
            return reading
        if self._late_since_s is None:
            self._late_since_s = now_s
        if now_s - self._late_since_s < late_confirm_s:
            return reading
        self._late_since_s = None
        self._timebase = Timebase()
        self._gains.clear()
        return StampReading(self._timebase.read(remote_s, now_s).time_s, is_reboot=True)

    def _note_gain(self, before_s: float | None, now_s: float) -> None:
        after_s = self._timebase.offset_s
        if before_s is not None and after_s is not None and after_s < before_s:
            self._gains.append((now_s, before_s - after_s))
        while self._gains and self._gains[0][0] <= now_s - RUN_WINDOW_S:
            self._gains.popleft()
