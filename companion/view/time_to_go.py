"""When the target will be reported, as far as the shrinking radius tells."""

from __future__ import annotations

import math
from collections import deque

WINDOW_S = 15.0
"""The radius shrinks in steps, crossing by crossing: a shorter window jumps, a longer one lags."""
MIN_WINDOW_S = 5.0
MAX_S = 600.0
"""A longer time to go is no better than none."""


class TimeToGo:
    """Extrapolates R95, which shrinks about exponentially, to the radius of the report.

    Args:
        stop_radius_m: Reported once R95 stays under this.
        confirm_s: For this long.
    """

    def __init__(self, stop_radius_m: float, confirm_s: float) -> None:
        self._stop_radius_m = stop_radius_m
        self._confirm_s = confirm_s
        self._radii: deque[tuple[float, float]] = deque()
        self._under_since_s: float | None = None

    def aim(self, stop_radius_m: float, confirm_s: float) -> None:
        """Another end from now on: ground stations may change it."""
        self._stop_radius_m, self._confirm_s = stop_radius_m, confirm_s

    def observe(self, now_s: float, r95_m: float | None) -> float | None:
        """The seconds to go, or None where nothing can be said.

        Args:
            now_s: The present.
            r95_m: None without an estimate.
        """
        if r95_m is None or not r95_m > 0.0:
            self._radii.clear()
            self._under_since_s = None
            return None
        if r95_m <= self._stop_radius_m:
            since_s = now_s if self._under_since_s is None else self._under_since_s
            self._under_since_s = since_s
            return max(0.0, self._confirm_s - (now_s - since_s))
        self._under_since_s = None
        self._radii.append((now_s, math.log(r95_m)))
        while now_s - self._radii[0][0] > WINDOW_S:
            self._radii.popleft()
        return self._extrapolated(now_s, math.log(r95_m))

    def _extrapolated(self, now_s: float, log_r95: float) -> float | None:
        first_s, first = self._radii[0]
        if now_s - first_s < MIN_WINDOW_S:
            return None
        rate = (first - log_r95) / (now_s - first_s)
        if rate <= 0.0:
            return None
        to_go_s = (log_r95 - math.log(self._stop_radius_m)) / rate + self._confirm_s
        return to_go_s if to_go_s <= MAX_S else None
