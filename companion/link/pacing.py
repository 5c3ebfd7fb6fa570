"""How often the control tick comes: 20 times a second, and 50 where frames get lost.

At 30 % loss the longest gap in ten hours between two setpoints that arrive is over half a second
at 20 Hz, and under 0.4 s at 50 Hz; PX4 gives up after 1 s. The loss is that of the autopilot's own
frames: what is lost on the way to it nobody tells us, and radios lose both ways.

A tick that comes late is not made up for. One that comes very late is a stall: what is known is of
the past, and what was to be sent, too.
"""

from __future__ import annotations

from companion.link.params import LinkParams

CALM_SHARE = 0.5
"""Calm is a loss below this share of what counts as lossy."""
CALM_S = 5.0
"""The line must be calm for this long before the rate goes down again."""


STALL_S = 0.5
"""A tick later than this finds a vehicle that may be anywhere, in any mode."""


class TickWatch:
    """Notes how punctual the control tick is."""

    def __init__(self) -> None:
        self.missed = 0
        """Ticks that were due and never came, because one was late."""
        self.stalls = 0
        self._last_s: float | None = None

    def tick(self, period_s: float, now_s: float) -> float | None:
        """Note a tick; how long it stood still before, if that is a stall."""
        last_s, self._last_s = self._last_s, now_s
        if last_s is None:
            return None
        gap_s = now_s - last_s
        self.missed += max(0, round(gap_s / period_s) - 1)
        if gap_s <= STALL_S:
            return None
        self.stalls += 1
        return gap_s


class Pacing:
    """The period of the control tick.

    Args:
        params: The two rates, and what counts as lossy.
    """

    def __init__(self, params: LinkParams) -> None:
        self._params = params
        self._calm_since_s: float | None = None
        self.is_lossy = False

    @property
    def period_s(self) -> float:
        """From one tick to the next."""
        return 1.0 / (self._params.lossy_rate_hz if self.is_lossy else self._params.rate_hz)

    def observe(self, loss: float | None, now_s: float) -> None:
        """Take in the measured loss, 0 to 1; None, unknown, changes nothing."""
        if loss is None:
            return
        if loss > self._params.lossy_share:
            self.is_lossy = True
        if loss >= CALM_SHARE * self._params.lossy_share:
            self._calm_since_s = None
        elif self._calm_since_s is None:
            self._calm_since_s = now_s
        elif now_s - self._calm_since_s >= CALM_S:
            self.is_lossy = False
