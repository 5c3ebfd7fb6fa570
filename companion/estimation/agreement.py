"""Whether the measurements of the last seconds agree with the estimate at all."""

from __future__ import annotations

from collections import deque

WINDOW_S = 2.0
WINDOW_COUNT = 10
"""The window holds at least so much time and so many measurements."""
PROVEN_COUNT = 40
"""An estimate that agreed with so many measurements has a say in which are outliers."""
LOST_SHARE, FOUND_SHARE = 0.2, 0.5
"""With less of the window agreeing than the first there is no agreement, until it is the second."""
HOPELESS_S, HOPELESS_COUNT = 5.0, 20
"""Without agreement for so long and so many measurements, the target is no longer where it was."""


class Agreement:
    """Counts which of the last measurements agreed."""

    def __init__(self) -> None:
        self._window: deque[tuple[float, bool]] = deque()
        self._agreed = 0
        self._lost_s = 0.0
        self._since_lost = 0
        self.is_lost = False
        """Whether next to nothing that is measured agrees with the estimate."""
        self.is_hopeless = False
        """Whether that has lasted so long that the estimate should be given up."""

    def clear(self) -> None:
        """Forget everything, because the estimate is another one."""
        self._window.clear()
        self._agreed = 0
        self.is_lost = self.is_hopeless = False

    @property
    def is_proven(self) -> bool:
        """Whether enough measurements agreed since the estimate began."""
        return self._agreed >= PROVEN_COUNT

    def add(self, time_s: float, *, agrees: bool) -> None:
        """Take in a measurement."""
        self._agreed += agrees
        self._window.append((time_s, agrees))
        while len(self._window) > WINDOW_COUNT and self._window[0][0] < time_s - WINDOW_S:
            self._window.popleft()
        if len(self._window) < WINDOW_COUNT:
            return
        share = sum(agreed for _, agreed in self._window) / len(self._window)
        was_lost = self.is_lost
        self.is_lost = share < (FOUND_SHARE if was_lost else LOST_SHARE)
        if not was_lost:
            self._lost_s, self._since_lost = time_s, 0
        self._since_lost += 1
        has_lasted = time_s - self._lost_s >= HOPELESS_S and self._since_lost >= HOPELESS_COUNT
        self.is_hopeless = self.is_lost and has_lasted
