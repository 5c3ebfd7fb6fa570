"""Rate limits of MAVLink ranging, by emitter and by sender.

A measurement costs the flight computer a fraction of a millisecond before it is fused, so that a
sender at 1 kHz would take half of a core. Measurements beyond the rate are dropped as they arrive,
which passes the newest at a steady rate, are counted, and are announced. Rates go by our own clock:
stamps are under the sender's control.
"""

from __future__ import annotations

from companion.guidance.commands import Announce, Severity
from companion.link.intake import RateLimit
from companion.link.texts import CAUSE_PERIOD_S

RATE_MAX_HZ = 20.0
"""Measurements per second of one emitter, as for radios with formats of their own
(`rate_max_hz`)."""
MAX_EMITTERS = 16
"""Emitters of one sender with separate rates: as many as `emitters.most` allows."""
MANY_LEFT_OUT = 10
"""Dropped measurements since the last text before the next one: half a second's worth, more than a
burst of a link."""


class SenderRate:
    """Rates of one sender: of all its measurements, and of each emitter."""

    def __init__(self) -> None:
        most_hz = RATE_MAX_HZ * MAX_EMITTERS
        self._all = RateLimit(most_hz, burst=int(most_hz))
        self._by_emitter: dict[int, RateLimit] = {}
        self.left_out = 0
        """Dropped measurements since the last text."""
        self._texts = RateLimit(1.0 / CAUSE_PERIOD_S)

    def acquire(self, emitter_id: int, now_s: float) -> bool:
        """Return True if a measurement of an emitter may pass; otherwise it is counted."""
        limit = self._by_emitter.get(emitter_id)
        if limit is None:
            if len(self._by_emitter) >= MAX_EMITTERS:
                del self._by_emitter[next(iter(self._by_emitter))]
            limit = self._by_emitter[emitter_id] = RateLimit(RATE_MAX_HZ, burst=int(RATE_MAX_HZ))
        is_due = limit.acquire(now_s) and self._all.acquire(now_s)
        self.left_out += not is_due
        return is_due

    def text(self, sender: tuple[int, int], now_s: float) -> Announce | None:
        """Return the warning that is due about dropped measurements, or None."""
        if self.left_out < MANY_LEFT_OUT or not self._texts.acquire(now_s):
            return None
        count, self.left_out = self.left_out, 0
        system, component = sender
        return Announce(
            Severity.WARNING,
            f"ranging of {system}/{component}: {count} left out, "
            f"over {RATE_MAX_HZ:.0f} Hz an emitter; lower its rate",
        )
