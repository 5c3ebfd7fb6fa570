"""The clock of a shell: monotonic seconds from zero, faster than the wall where asked."""

from __future__ import annotations

import math
import time


class Clock:
    """Monotonic seconds since construction, times `speed`.

    Args:
        speed: Seconds of this clock per wall second.

    Raises:
        ValueError: The speed is not a positive finite number.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise ValueError(f"speed must be positive and finite, not {speed}")
        self.speed = speed
        self._started_s = time.monotonic()

    def now_s(self) -> float:
        """Seconds of this clock since it was made; never goes back."""
        return (time.monotonic() - self._started_s) * self.speed

    def delay_s(self, until_s: float) -> float:
        """Wall seconds until this clock shows `until_s`; 0 if it already does."""
        return max(0.0, (until_s - self.now_s()) / self.speed)
