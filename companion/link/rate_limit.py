"""So often and no more: a token bucket on passed-in time."""

from __future__ import annotations

import math


class RateLimit:
    """Lets `burst` things through at once and then `per_s` a second; what it refuses is counted.

    Args:
        per_s: How fast what was used comes back.
        burst: How much there is at most.
    """

    def __init__(self, per_s: float, burst: int = 1) -> None:
        self.refused = 0
        self._per_s = per_s
        self._burst = float(burst)
        self._left = float(burst)
        self._seen_s = -math.inf

    def allows(self, now_s: float) -> bool:
        """Whether one more may pass now."""
        if now_s > self._seen_s:
            self._left = min(self._burst, self._left + (now_s - self._seen_s) * self._per_s)
            self._seen_s = now_s
        if self._left < 1.0:
            self.refused += 1
            return False
        self._left -= 1.0
        return True
