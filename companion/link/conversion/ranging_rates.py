"""Rates of MAVLink ranging: so many measurements a second go on, of an emitter and of a sender.

A measurement costs the flight computer a fraction of a millisecond before it is fused, so that a
sender at 1 kHz would take half of a core. What is beyond the rate is left out as it arrives, which
keeps the newest at a steady rate, is counted, and is announced. Rates go by our own clock: stamps
are the sender's to choose.
"""

from __future__ import annotations

from companion.guidance.commands import Announce, Severity
from companion.link.intake import RateLimit
from companion.link.texts import CAUSE_PERIOD_S

RATE_MAX_HZ = 20.0
"""Measurements a second of one emitter, as of radios with formats of their own (`rate_max_hz`)."""
MAX_EMITTERS = 16
"""Emitters of one sender that have rates of their own: as many as `emitters.most` allows."""
MANY_LEFT_OUT = 10
"""Measurements left out since the last text, before there is another one: half a second's worth, so
that a burst of a link is none."""


class SenderRate:
    """Rates of one sender: of all that it sends, and of each emitter."""

    def __init__(self) -> None:
        most_hz = RATE_MAX_HZ * MAX_EMITTERS
        self._all = RateLimit(most_hz, burst=int(most_hz))
        self._by_emitter: dict[int, RateLimit] = {}
        self.left_out = 0
        """Measurements since the last text."""
        self._texts = RateLimit(1.0 / CAUSE_PERIOD_S)

    def acquire(self, emitter_id: int, now_s: float) -> bool:
        """Return True if a measurement of an emitter may go on; otherwise it is counted."""
        limit = self._by_emitter.get(emitter_id)
        if limit is None:
            if len(self._by_emitter) >= MAX_EMITTERS:
                del self._by_emitter[next(iter(self._by_emitter))]
            limit = self._by_emitter[emitter_id] = RateLimit(RATE_MAX_HZ, burst=int(RATE_MAX_HZ))
        is_due = limit.acquire(now_s) and self._all.acquire(now_s)
        self.left_out += not is_due
        return is_due

    def text(self, sender: tuple[int, int], now_s: float) -> Announce | None:
        """Return the warning that is due about what was left out, or None."""
        if self.left_out < MANY_LEFT_OUT or not self._texts.acquire(now_s):
            return None
        count, self.left_out = self.left_out, 0
        system, component = sender
        return Announce(
            Severity.WARNING,
            f"ranging of {system}/{component}: {count} left out, "
            f"over {RATE_MAX_HZ:.0f} Hz an emitter; lower its rate",
        )
